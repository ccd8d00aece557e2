"""From the map frame (east, north, up) to the coordinates of a delivery: a projected CRS, and a surface for heights."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS, Transformer
from pyproj.crs import CompoundCRS, VerticalCRS
from pyproj.exceptions import CRSError

from factor_graphs.geodesy import LocalFrame
from gnss_sem_map.config import DeliverySettings
from gnss_sem_map.errors import ConfigError
from gnss_sem_map.files.geoid import undulation

WGS84_EPSG = 4326
RIGHT_TO_M = 1.0
"""What PROJ says of a datum that it holds for equal to WGS 84 but for the motion of plates, such as ETRS89."""
VERTICAL_EPSG = "target_crs_epsg_code"
"""Tag of PROJ's GeoTIFF grids: the vertical CRS that they lead to."""


@dataclass(frozen=True)
class Georeference:
    """Coordinates of the files of a map: easting and northing of `crs`, and the height above ellipsoid or geoid.

    Without `epsg`, the CRS is the UTM zone (WGS 84) of the map's origin. Without `geoid`, heights are above the WGS 84
    ellipsoid; with one, a grid of PROJ (GeoTIFF or GTX) of its undulations, they are orthometric. Raises ConfigError
    for a code that is no projected CRS in metres, for a file that PROJ cannot read, and where either does not cover
    the origin of the map, or a point that is asked for. A datum that PROJ holds for equal to WGS 84, such as ETRS89, is
    taken for equal.
    """

    frame: LocalFrame
    epsg: int | None = None
    geoid: Path | None = None

    @classmethod
    def of(cls, frame: LocalFrame, delivery: DeliverySettings) -> Georeference:
        """The coordinates that are set for the files of a map with this frame."""
        return cls(frame, delivery.crs, delivery.geoid)

    def __post_init__(self) -> None:
        origin = self.frame.lat_deg, self.frame.lon_deg
        if self.epsg is not None:
            area = projected_crs(self.epsg).area_of_use
            if area is not None and not _contains(area.bounds, *origin):
                raise ConfigError(
                    f"delivery.crs: EPSG:{self.epsg} is for {area.name[:80]}; found an origin at {_degrees(*origin)};"
                    " choose a CRS of that place"
                )
        if self.geoid is not None and not np.isfinite(
            undulation(self.geoid).transform(*origin[::-1], 0.0)[2]
        ):
            raise ConfigError(
                f"delivery.geoid: {self.geoid} does not cover the origin of the map at {_degrees(*origin)};"
                " choose a grid of that place"
            )

    def from_map(self, p_map: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points (n, 3) m of the map frame -> easting, northing, height (n, 3) m."""
        lat_deg, lon_deg, alt_m = self.frame.to_geodetic(p_map)
        if self.geoid is not None:
            *_, alt_m = undulation(self.geoid).transform(lon_deg, lat_deg, alt_m)
        placed = np.stack([*_projection(self.horizontal_epsg).transform(lon_deg, lat_deg), alt_m], axis=-1)
        self._refuse_outside(placed, lat_deg, lon_deg)
        return placed

    def to_map(self, p: NDArray[np.float64]) -> NDArray[np.float64]:
        """Inverse: easting, northing, height (n, 3) m -> points (n, 3) m of the map frame."""
        easting, northing, alt_m = np.moveaxis(np.asarray(p, np.float64), -1, 0)
        lon_deg, lat_deg = _projection(self.horizontal_epsg).transform(easting, northing, direction="INVERSE")
        if self.geoid is not None:
            *_, alt_m = undulation(self.geoid).transform(lon_deg, lat_deg, alt_m, direction="INVERSE")
        p_map = self.frame.to_map(lat_deg, lon_deg, alt_m)
        self._refuse_outside(p_map, lat_deg, lon_deg)
        return p_map

    def _refuse_outside(self, places: NDArray[np.float64], *degrees: NDArray[np.float64]) -> None:
        """Raise ConfigError for places (..., 3) that are not finite, with the first one's latitude and longitude."""
        outside = ~np.isfinite(places).all(axis=-1)
        if outside.any():
            what = f"geoid: {self.geoid}" if self.geoid else f"crs: EPSG:{self.horizontal_epsg}"
            raise ConfigError(
                f"delivery.{what} does not cover all of the map: found a place at"
                f" {_degrees(*(float(each[outside][0]) for each in degrees))}; choose one of the whole map"
            )

    @property
    def horizontal_epsg(self) -> int:
        """EPSG code of the projected CRS."""
        return self.epsg or self.frame.utm_epsg

    @property
    def crs(self) -> CRS:
        """The projected CRS; with a geoid the compound of it and a vertical one."""
        horizontal, vertical = projected_crs(self.horizontal_epsg), self._vertical
        return horizontal if vertical is None else CompoundCRS(self.name, [horizontal, vertical])

    @property
    def name(self) -> str:
        """Name of the CRS."""
        horizontal, vertical = projected_crs(self.horizontal_epsg), self._vertical
        return horizontal.name if vertical is None else f"{horizontal.name} + {vertical.name}"

    @property
    def heights(self) -> str:
        """What heights count from, in words."""
        if self.geoid is None or self._vertical is None:
            return "above the WGS 84 ellipsoid"
        return f"orthometric, {self._vertical.name}, with the geoid of {self.geoid.name}"

    @property
    def words(self) -> str:
        """CRS and heights in one line."""
        return f"EPSG:{self.horizontal_epsg} ({projected_crs(self.horizontal_epsg).name}), heights {self.heights}"

    @property
    def doubt(self) -> str:
        """How inaccurate the way from WGS 84 to the datum of the CRS is; empty where PROJ holds it for right to 1 m."""
        way = _projection(self.horizontal_epsg)
        way.transform(self.frame.lon_deg, self.frame.lat_deg)
        used = way.get_last_used_operation()
        if 0 <= used.accuracy <= RIGHT_TO_M:
            return ""
        how = f"right to {used.accuracy:g} m only" if used.accuracy > 0 else "not known to be right"
        return (
            f"delivery.crs: EPSG:{self.horizontal_epsg} has a datum of its own, and coordinates in it are {how} (PROJ:"
            f" {used.description}); a grid of that place may do better, see docs/formats.md"
        )

    def about(self) -> dict[str, Any]:
        """For run.json."""
        said = {"epsg": self.horizontal_epsg, "crs": self.name, "heights": self.heights}
        return said | ({"doubt": self.doubt} if self.doubt else {})

    @cached_property
    def _vertical(self) -> CRS | None:
        """The vertical CRS that the grid names, else one that is called after it; None without a geoid."""
        if self.geoid is None:
            return None
        named = _vertical_crs(self.geoid)
        if named is not None:
            return named
        return VerticalCRS(
            f"height above {self.geoid.stem}", datum=f'VDATUM["{self.geoid.stem.replace(chr(34), "_")}"]'
        )


def check_delivery(epsg: int | None, geoid: Path | None) -> None:
    """Raise ConfigError for a CRS or a geoid that no map can be delivered in."""
    if epsg is not None:
        projected_crs(epsg)
    if geoid is not None:
        undulation(geoid)


@lru_cache(maxsize=16)
def projected_crs(epsg: int) -> CRS:
    """A projected CRS in metres that WKT 1, and so LAZ and GeoPackage, can hold; raises ConfigError for other codes."""
    try:
        crs = CRS.from_epsg(epsg)
    except CRSError:
        raise ConfigError(f"delivery.crs: found {epsg}, which is no EPSG code of a CRS") from None
    units = {axis.unit_name for axis in crs.axis_info}
    if not crs.is_projected or len(crs.axis_info) != 2 or units != {"metre"}:
        raise ConfigError(
            f"delivery.crs: found EPSG:{epsg} ({crs.name}), expected a projected CRS in metres, such as 25832"
        )
    try:
        crs.to_wkt("WKT1_GDAL")
    except CRSError:
        raise ConfigError(
            f"delivery.crs: found EPSG:{epsg} ({crs.name}), whose projection WKT 1 has no name for, which LAZ and"
            " GeoPackage need; choose another CRS of that place"
        ) from None
    return crs


@lru_cache(maxsize=16)
def _projection(epsg: int) -> Transformer:
    return Transformer.from_crs(WGS84_EPSG, epsg, always_xy=True)


def _vertical_crs(geoid: Path) -> CRS | None:
    """The vertical CRS in metres that a GeoTIFF grid names; None where it names none, or something else."""
    import rasterio
    from rasterio.errors import RasterioError

    try:
        with rasterio.open(geoid) as grid:
            tags = {**grid.tags(), **grid.tags(1)}
        crs = CRS.from_epsg(int(tags[VERTICAL_EPSG]))
    except (RasterioError, CRSError, KeyError, ValueError):
        return None
    is_in_metres = {axis.unit_name for axis in crs.axis_info} == {"metre"}
    return crs if crs.is_vertical and not crs.is_compound and is_in_metres else None


def _contains(bounds: tuple[float, float, float, float], lat_deg: float, lon_deg: float) -> bool:
    west, south, east, north = bounds
    return south <= lat_deg <= north and (lon_deg - west) % 360 <= ((east - west) % 360 or 360)


def _degrees(lat_deg: float, lon_deg: float) -> str:
    return f"{lat_deg:.4f}, {lon_deg:.4f}"
