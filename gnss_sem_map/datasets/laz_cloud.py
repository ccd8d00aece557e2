"""A point cloud in LAS or LAZ with a coordinate system, as a base that drives are held onto."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pyproj import CRS, Transformer
from pyproj.crs import CompoundCRS
from pyproj.exceptions import CRSError, ProjError

from factor_graphs.geodesy import LocalFrame
from gnss_sem_map.datasets.las_sizes import check_chunks, checked
from gnss_sem_map.errors import DataError, one_line
from gnss_sem_map.files.geoid import undulation
from gnss_sem_map.files.untrusted import open_file, refused
from gnss_sem_map.scans.base_cloud import BaseCloud
from gnss_sem_map.scans.downsampling import one_per_cube
from gnss_sem_map.scans.local_maps import CUBE_M

if TYPE_CHECKING:
    from laspy import LasHeader

WGS84_EPSG, WGS84_3D_EPSG = 4326, 4979
CHUNK_BYTES = 32 << 20
"""Of points read at a time; of each chunk the means of its cubes stay."""
VERTICAL_CRS, VERTICAL_UNIT = 4096, 4099
"""GeoTIFF keys of a LAS, which laspy does not read; the values of the second are EPSG codes of units."""
UNIT_M = {9001: 1.0, 9002: 0.3048, 9003: 1200 / 3937}
MOST_M = 100_000.0
"""Farther from the origin a cloud is of another place, or its coordinate system is wrong."""


def read_base(path: Path, frame: LocalFrame, geoid: Path | None = None) -> BaseCloud:
    """The points of a file that are not withheld, in the map frame.

    Heights are above the ellipsoid, or above what a compound coordinate system says, by a grid of PROJ or by `geoid`.
    Without an own unit they are in that of the coordinates. Raises DataError for a file that is no LAS, has no
    coordinate system, or lies far from the origin.
    """
    import laspy
    import lazrs

    parts, given = [np.empty((0, 3))], 0
    try:
        with (
            os.fdopen(open_file(path), "rb") as file,
            laspy.open(checked(file, path), closefd=False) as reader,
        ):
            check_chunks(file, reader.header, path)
            placing = _Placing.of(reader.header, path, frame, geoid)
            for points in reader.chunk_iterator(max(CHUNK_BYTES // reader.header.point_format.size, 1)):
                some = (
                    points[~np.asarray(points.withheld, np.bool_)] if hasattr(points, "withheld") else points
                )
                given += len(some)
                placed = placing.of_points(some.x, some.y, some.z)
                parts.append(one_per_cube(np.ascontiguousarray(placed[_is_near(placed)]), CUBE_M))
    except DataError:
        raise
    except (
        laspy.errors.LaspyException, lazrs.LazrsError, ProjError, OSError, ValueError, IndexError, struct.error,
    ) as error:  # fmt: skip
        reason = one_line(error)
        raise refused(
            path,
            f"cannot be read as LAS or LAZ ({reason}); pdal translate IN OUT.laz",
        ) from None
    points = np.concatenate(parts)
    if not given:
        raise refused(path, "holds no points, or all are withheld; expected a cloud of the place")
    if not len(points):
        raise refused(
            path,
            f"found no point within {MOST_M / 1000:g} km of the origin {frame.lat_deg:.4f},"
            f" {frame.lon_deg:.4f}; expected a cloud of the same place: is its coordinate system the one it is in, with"
            " eastings before northings?",
        )
    return BaseCloud(path.name, one_per_cube(points, CUBE_M))


@dataclass(frozen=True)
class _Placing:
    """From coordinates of a cloud to the map frame."""

    frame: LocalFrame
    to_wgs84: Transformer
    unit_m: float
    """Of the heights."""
    geoid: Path | None
    """Where heights are above it."""

    @classmethod
    def of(cls, header: LasHeader, path: Path, frame: LocalFrame, geoid: Path | None) -> _Placing:
        """Raises DataError for a file without a coordinate system, or heights above a geoid that PROJ has not."""
        crs, unit_m = _crs_of(header), None
        if crs is None:
            raise refused(
                path,
                "has no coordinate system; expected one, such as"
                " EPSG:25832: pdal translate IN.laz OUT.laz --writers.las.a_srs=EPSG:25832",
            )
        for key in _geo_keys(header):
            unit_m = UNIT_M.get(key.value_offset, unit_m) if key.id == VERTICAL_UNIT else unit_m
        if not crs.is_compound:
            axes = crs.axis_info
            if unit_m is None:  # none of its own: that of the coordinates
                unit_m = axes[0].unit_conversion_factor if crs.is_projected and len(axes) == 2 else 1.0
            return cls(frame, _to_wgs84(crs), unit_m, None)
        vertical = crs.sub_crs_list[-1]
        axis_m = vertical.axis_info[0].unit_conversion_factor
        unit_m = axis_m if unit_m is None else unit_m
        flat = _to_wgs84(crs.sub_crs_list[0])
        found = _by_grids(crs, flat, frame)
        if found is not None:
            return cls(frame, found, unit_m / axis_m, None)
        if geoid is None:
            raise refused(
                path,
                f"its heights are those of {vertical.name}, without a grid; give --geoid, or heights above the"
                " ellipsoid",
            )
        return cls(frame, flat, unit_m, geoid)

    def of_points(self, x: ArrayLike, y: ArrayLike, z: ArrayLike) -> NDArray[np.float64]:
        """(n, 3) m; infinite where it is not known."""
        lon_deg, lat_deg, alt_m = self.to_wgs84.transform(x, y, np.asarray(z) * self.unit_m)
        if self.geoid is not None:
            *_, alt_m = undulation(self.geoid).transform(lon_deg, lat_deg, alt_m, direction="INVERSE")
        return self.frame.to_map(lat_deg, lon_deg, alt_m)


def _to_wgs84(crs: CRS) -> Transformer:
    """Heights of a system of two axes stay: they are above no ellipsoid of it, which may be 50 m off."""
    return Transformer.from_crs(crs, WGS84_3D_EPSG if len(crs.axis_info) == 3 else WGS84_EPSG, always_xy=True)


def _by_grids(crs: CRS, flat: Transformer, frame: LocalFrame) -> Transformer | None:
    """With the grid of a geoid; None where PROJ has none: it would take such heights for ellipsoidal ones, 50 m off."""
    x, y, _ = flat.transform(frame.lon_deg, frame.lat_deg, frame.alt_m, direction="INVERSE")
    try:
        found = Transformer.from_crs(crs, WGS84_3D_EPSG, always_xy=True, allow_ballpark=False, only_best=True)
    except ProjError:
        return None
    return found if np.isfinite(found.transform(x, y, 0.0)).all() else None


def _crs_of(header: LasHeader) -> CRS | None:
    """The coordinate system, compound where a GeoTIFF key tells that of the heights."""
    crs: CRS | None = header.parse_crs()
    for key in _geo_keys(header):
        if crs is not None and key.id == VERTICAL_CRS and 1024 <= key.value_offset <= 32766:
            try:
                vertical = CRS.from_epsg(key.value_offset)
            except CRSError:
                continue
            if vertical.is_vertical and not crs.is_compound and len(crs.axis_info) == 2:
                crs = CompoundCRS(f"{crs.name} + {vertical.name}", [crs, vertical])
    return crs


def _geo_keys(header: LasHeader) -> Iterator[Any]:
    for record in header.vlrs.get("GeoKeyDirectoryVlr"):
        yield from record.geo_keys


def _is_near(placed: NDArray[np.float64]) -> NDArray[np.bool_]:
    return np.asarray(np.isfinite(placed).all(axis=1) & (np.abs(placed) < MOST_M).all(axis=1))
