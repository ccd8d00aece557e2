"""From the map frame (east, north, up) to the UTM zone of its origin."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from pyproj import Transformer

from factor_graphs.geodesy import LocalFrame

WGS84_EPSG = 4326


def to_utm(frame: LocalFrame, p_map: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points (n, 3) m of the map frame -> easting, northing, height above the ellipsoid (n, 3) m (WGS 84)."""
    lat_deg, lon_deg, alt_m = frame.to_geodetic(p_map)
    return np.stack([*_utm(frame).transform(lon_deg, lat_deg), alt_m], axis=-1)


def from_utm(frame: LocalFrame, p_utm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Inverse: easting, northing, height (n, 3) m -> points (n, 3) m of the map frame."""
    easting, northing, alt_m = np.moveaxis(np.asarray(p_utm, np.float64), -1, 0)
    lon_deg, lat_deg = _utm(frame).transform(easting, northing, direction="INVERSE")
    return frame.to_map(lat_deg, lon_deg, alt_m)


@lru_cache(maxsize=16)
def _utm(frame: LocalFrame) -> Transformer:
    return Transformer.from_crs(WGS84_EPSG, frame.utm_epsg, always_xy=True)
