"""Places in WGS 84 as GeoJSON and GeoParquet want them where longitudes jump, at the 180 degree meridian."""

from __future__ import annotations

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray

DEGREE_DIGITS, HEIGHT_DIGITS = 9, 3
"""0.1 mm of latitude, 1 mm of height."""


def near(lon_deg: ArrayLike, about_deg: float) -> NDArray[np.float64]:
    """The same longitudes in degrees, within 180 of `about_deg`: there without a jump, but maybe beyond 180."""
    lon_deg = np.asarray(lon_deg, np.float64)
    return np.asarray(lon_deg - 360 * np.round((lon_deg - about_deg) / 360))


def line_through(
    lon_deg: NDArray[np.float64], lat_deg: NDArray[np.float64], alt_m: NDArray[np.float64]
) -> shapely.Geometry:
    """The line through places, each (n,), cut into several at the 180 degree meridian (RFC 7946, 3.1.9).

    One place is a point, as a line needs two.
    """
    places = np.column_stack(
        [lon_deg.round(DEGREE_DIGITS), lat_deg.round(DEGREE_DIGITS), alt_m.round(HEIGHT_DIGITS)]
    )
    if len(places) == 1:
        return shapely.Point(places[0])
    jumps = np.flatnonzero(np.abs(np.diff(places[:, 0])) > 180)
    if not len(jumps):
        return shapely.LineString(places)
    cuts = [_cut(places[k], places[k + 1]) for k in jumps]
    nothing = np.empty((0, 3))
    begins = [nothing, *(cut[1:] for cut in cuts)]
    ends = [*(cut[:1] for cut in cuts), nothing]
    parts = np.split(places, jumps + 1)
    return shapely.MultiLineString([np.vstack(part) for part in zip(begins, parts, ends, strict=True)])


def _cut(before: NDArray[np.float64], after: NDArray[np.float64]) -> NDArray[np.float64]:
    """Where the way between two places (3,) meets the 180 degree meridian, (2, 3): on the side of each."""
    side = np.copysign(180.0, before[0])
    ends = np.abs([before[0], near(after[0], side)])
    lat_deg, alt_m = (np.interp(180.0, ends, [before[axis], after[axis]]) for axis in (1, 2))
    lat_deg, alt_m = lat_deg.round(DEGREE_DIGITS), alt_m.round(HEIGHT_DIGITS)
    return np.array([(side, lat_deg, alt_m), (-side, lat_deg, alt_m)])


def box_around(places: NDArray[np.float64]) -> list[float]:
    """West, south, lowest, east, north, highest of places (n, 3) of longitude, latitude and height.

    A box across the 180 degree meridian has its west greater than its east (RFC 7946, 5.2).
    """
    lon_deg = near(places[:, 0], places[0, 0])
    west, east = near([lon_deg.min(), lon_deg.max()], 0.0).tolist()
    return [west, *places[:, 1:].min(axis=0).tolist(), east, *places[:, 1:].max(axis=0).tolist()]
