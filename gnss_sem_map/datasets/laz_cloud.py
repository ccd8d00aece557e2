"""A point cloud in LAS or LAZ with a coordinate system, as a base that drives are held onto."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS, Transformer
from pyproj.exceptions import ProjError

from factor_graphs.geodesy import LocalFrame
from gnss_sem_map.errors import DataError, one_line
from gnss_sem_map.files.untrusted import shown
from gnss_sem_map.scans.base_cloud import BaseCloud
from gnss_sem_map.scans.downsampling import one_per_cube
from gnss_sem_map.scans.local_maps import CUBE_M

WGS84_3D_EPSG = 4979
CHUNK = 1_000_000
"""Points read at a time; of each chunk the means of its cubes stay."""
MOST_M = 100_000.0
"""Farther from the origin a cloud is of another place, or its coordinate system is wrong."""


def read_base(path: Path, frame: LocalFrame) -> BaseCloud:
    """The points of a file that are not withheld, in the map frame; heights are above the ellipsoid.

    Raises DataError for a file that is no LAS, has no coordinate system, or lies far from the origin.
    """
    import laspy
    import lazrs

    parts: list[NDArray[np.float64]] = [np.empty((0, 3))]
    try:
        with laspy.open(path) as reader:
            crs = reader.header.parse_crs()
            if crs is None:
                raise DataError(
                    f"{shown(path)}: has no coordinate system; expected a georeferenced LAS or LAZ"
                )
            to_wgs84 = _to_wgs84(crs, path)
            for points in reader.chunk_iterator(CHUNK):
                some = (
                    points[~np.asarray(points.withheld, np.bool_)] if hasattr(points, "withheld") else points
                )
                lon_deg, lat_deg, alt_m = to_wgs84.transform(some.x, some.y, some.z)
                placed = frame.to_map(lat_deg, lon_deg, alt_m)
                parts.append(one_per_cube(np.ascontiguousarray(placed[_is_near(placed)]), CUBE_M))
    except DataError:
        raise
    except (laspy.errors.LaspyException, lazrs.LazrsError, ProjError, OSError, ValueError) as error:
        reason = one_line(error)
        raise DataError(f"{shown(path)}: cannot be read as LAS or LAZ ({reason})") from None
    points = np.concatenate(parts)
    if not len(points):
        raise DataError(
            f"{shown(path)}: found no point within {MOST_M / 1000:g} km of the origin {frame.lat_deg:.4f},"
            f" {frame.lon_deg:.4f}; expected a cloud of the same place"
        )
    return BaseCloud(path.name, one_per_cube(points, CUBE_M))


def _to_wgs84(crs: CRS, path: Path) -> Transformer:
    """To degrees and heights above the ellipsoid; raises DataError for heights above a geoid that PROJ has not."""
    if not crs.is_compound:
        return Transformer.from_crs(crs.to_3d(), WGS84_3D_EPSG, always_xy=True)
    try:  # else PROJ would take such heights for ellipsoidal ones, 50 m off
        return Transformer.from_crs(crs, WGS84_3D_EPSG, always_xy=True, allow_ballpark=False, only_best=True)
    except ProjError:
        raise DataError(
            f"{shown(path)}: its heights are those of {crs.sub_crs_list[-1].name}, and PROJ has no grid for them;"
            " expected heights above the ellipsoid"
        ) from None


def _is_near(placed: NDArray[np.float64]) -> NDArray[np.bool_]:
    return np.asarray(np.isfinite(placed).all(axis=1) & (np.abs(placed) < MOST_M).all(axis=1))
