"""Valid fixes of a receiver: a position on Earth, an accuracy, and no jump that a vehicle cannot make."""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from factor_graphs.geodesy import FLATTENING, SEMI_MAJOR_AXIS

Array = NDArray[np.float64]

LEAST_STDDEV_M, LARGEST_STDDEV_M = 1e-4, 1e5
LARGEST_ALT_M = 1e5
JUMP_M, FASTEST_M_S = 20_000.0, 150.0
"""A fix is an outlier if it is farther from its neighbours than the fastest car drives, by this margin."""
NEIGHBOURS = 21


def valid_fixes(stamps: Array, geodetic: Array, stddevs: Array) -> tuple[NDArray[np.bool_], dict[str, int]]:
    """Mask (n,) of the rows that are valid fixes, and the number of invalid rows of each kind.

    `stamps` (n,) s, finite; `geodetic` (n, 3) degrees and m; `stddevs` (n, 3) m.
    """
    lat, lon, alt = geodetic.T
    # 0, 0 is what receivers write without a fix
    on_earth = (np.abs(lat) <= 90) & (np.abs(lon) <= 360) & ~((lat == 0) & (lon == 0))
    is_flat, is_high = on_earth & np.isnan(alt), on_earth & (np.abs(alt) > LARGEST_ALT_M)
    is_place = on_earth & ~is_flat & ~is_high
    has_accuracy = ((stddevs >= LEAST_STDDEV_M) & (stddevs <= LARGEST_STDDEV_M)).all(axis=1)
    usable = is_place & has_accuracy
    near = np.zeros(len(stamps), np.bool_)
    with np.errstate(over="ignore", invalid="ignore"):  # of stamps that are skipped later
        near[usable] = _near(stamps[usable], geodetic[usable])
    kinds = [
        (is_high, "no height on Earth; is the altitude in mm?"),
        (is_flat, "a place without height: fixes in two dimensions are not used"),
        (~on_earth, f"no place on Earth, or 0, 0{_other_angles(lat[~on_earth], lon[~on_earth])}"),
        (is_place & ~has_accuracy, "a standard deviation that is not above 0, or far too large"),
        (usable & ~near, "too far from the fixes around for any vehicle"),
    ]
    return near, {why: int(rows.sum()) for rows, why in kinds if rows.any()}


def _other_angles(lat: Array, lon: Array) -> str:
    """What latitudes and longitudes probably are that are no degrees; empty where nothing tells."""
    with np.errstate(all="ignore"):
        across, along = (np.abs(v[np.isfinite(v)]).max(initial=0.0) for v in (lat, lon))
    if across <= 90:
        return ""
    if across > 1e6:
        return "; are these degrees times 10^7? name the columns lat_dege7 and lon_dege7"
    is_nmea = across < 9060 and along < 18060
    return "; are these degrees and minutes, 4903.5 for 49° 3.5'? write degrees" if is_nmea else ""


def _near(stamps: Array, geodetic: Array) -> NDArray[np.bool_]:
    """Mask of the fixes close to their neighbours in time; of positions too far apart, the group with most fixes is
    kept.
    """
    near = np.ones(len(stamps), np.bool_)
    if len(stamps) < 3:
        return near
    order = np.argsort(stamps, kind="stable")
    t, p = stamps[order], _cartesian(geodetic[order])
    around = median_filter(p, size=(min(NEIGHBOURS, len(p)), 1), mode="reflect")
    half = NEIGHBOURS // 2
    rows = np.arange(len(t))
    span = t[np.minimum(rows + half, len(t) - 1)] - t[np.maximum(rows - half, 0)]
    kept = np.linalg.norm(p - around, axis=1) <= JUMP_M + FASTEST_M_S * span
    jumps = np.linalg.norm(np.diff(p[kept], axis=0), axis=1) > JUMP_M + FASTEST_M_S * np.diff(t[kept])
    place = np.concatenate([[0], np.cumsum(jumps)])[: int(kept.sum())]
    if len(place):
        kept[kept] = place == np.bincount(place).argmax()
    near[order] = kept
    return near


def _cartesian(geodetic: Array) -> Array:
    """Degrees and m -> (n, 3) m from the centre of the Earth."""
    lat, lon = np.radians(geodetic[:, :2].T)
    e2 = FLATTENING * (2 - FLATTENING)
    normal = SEMI_MAJOR_AXIS / np.sqrt(1 - e2 * np.sin(lat) ** 2)
    level = (normal + geodetic[:, 2]) * np.cos(lat)
    return np.column_stack(
        [level * np.cos(lon), level * np.sin(lon), (normal * (1 - e2) + geodetic[:, 2]) * np.sin(lat)]
    )
