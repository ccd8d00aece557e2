"""What a receiver says at one moment as one row of a table: position, and where it tells them velocity and heading.

Readers of all formats make these rows; here they become measurements in the map frame.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from factor_graphs.geodesy import LocalFrame
from factor_graphs.measurements import (
    AntennaHeadings,
    GnssFixes,
    GnssVelocities,
    Repairs,
    clean_gnss,
    clean_headings,
    clean_velocities,
)
from factor_graphs.position_covariances import are_correlations

Array = NDArray[np.float64]

GNSS_COLUMNS = ("stamp_s", "lat_deg", "lon_deg", "alt_m", "std_e_m", "std_n_m", "std_u_m")
CORRELATION_COLUMNS = ("corr_en", "corr_eu", "corr_nu")
VELOCITY_COLUMNS = ("ve_mps", "vn_mps", "vu_mps", "std_ve_mps", "std_vn_mps", "std_vu_mps")
HEADING_COLUMNS = ("heading_deg", "std_heading_deg")
MORE_COLUMNS = (*CORRELATION_COLUMNS, *VELOCITY_COLUMNS, *HEADING_COLUMNS)
"""What is not known is NaN."""
ROW_COLUMNS = (*GNSS_COLUMNS, *MORE_COLUMNS)
_CORRELATIONS, _VELOCITIES, _VELOCITY_STDDEVS = slice(7, 10), slice(10, 13), slice(13, 16)
_HEADINGS, _HEADING_STDDEVS = 16, 17
# Where a receiver does not tell how good its heading is: how well it knows the place of one antenna against the other.
# u-blox promises 0.4° for antennas 1 m apart (data sheet of the ZED-F9P).
OF_BASELINE_M = 0.007
# Where no row tells how good its velocity is, m/s: receivers of all makes promise 0.03 to 0.1. What the drive shows
# is larger where it is.
USUAL_VELOCITY_STDDEV = 0.1
FORWARD = (1.0, 0.0, 0.0)


def with_more(rows: Array, **more: Array) -> Array:
    """Rows (n, 7) of GNSS_COLUMNS as rows (n, 18) of ROW_COLUMNS; `more` are the keys of `places`."""
    places: dict[str, slice | int] = {
        "correlations": _CORRELATIONS, "velocities": _VELOCITIES, "velocity_stddevs": _VELOCITY_STDDEVS,
        "headings_deg": _HEADINGS, "heading_stddevs_deg": _HEADING_STDDEVS,
    }  # fmt: skip
    whole = np.full((len(rows), len(ROW_COLUMNS)), np.nan)
    whole[:, : len(GNSS_COLUMNS)] = rows
    for name, values in more.items():
        whole[:, places[name]] = values
    return whole


def fixes_of(rows: Array, frame: LocalFrame) -> tuple[GnssFixes, Repairs, int]:
    """Fixes of rows (n, 18) in the map frame, what was repaired, and how many correlations were of no covariance.

    Errors that cannot be correlated as a row says count as not correlated: their standard deviations are kept.
    """
    correlations = rows[:, _CORRELATIONS]
    known = np.isfinite(correlations).all(axis=1)
    possible = np.zeros(len(rows), np.bool_)
    possible[known] = are_correlations(correlations[known])
    given = np.where(possible[:, None], correlations, 0.0) if (correlations[possible] != 0).any() else None
    fixes, repairs = clean_gnss(rows[:, 0], frame.to_map(*rows[:, 1:4].T), rows[:, 4:7], given)
    return fixes, repairs, int((known & ~possible).sum())


def velocities_of(rows: Array, frame: LocalFrame) -> tuple[GnssVelocities | None, Repairs | None]:
    """Velocities of rows (n, 18) in the map's axes, and what was repaired; None where no row has one."""
    rows = rows[np.isfinite(rows[:, _VELOCITIES][:, :2]).all(axis=1)]
    if not len(rows):
        return None, None
    v = rows[:, _VELOCITIES]
    is_flat = np.isnan(v[:, 2])
    turned = np.einsum("nij,nj->ni", frame.axes_at(frame.to_map(*rows[:, 1:4].T)), np.nan_to_num(v))
    turned[is_flat, 2] = np.nan
    stated = rows[:, _VELOCITY_STDDEVS]
    stddevs = np.where(np.isnan(stated).all(axis=0), USUAL_VELOCITY_STDDEV, stated)
    velocities, repairs = clean_velocities(rows[:, 0], turned, stddevs)
    return (velocities if len(velocities) else None), repairs


def headings_of(
    rows: Array, frame: LocalFrame, baseline: ArrayLike | None
) -> tuple[AntennaHeadings | None, Repairs | None]:
    """Headings of rows (n, 18) against the map's north, and what was repaired; None where no row has one.

    `baseline` (3,) m is from the main antenna to the second one; None: the heading is that of the imu's x axis.
    """
    rows = rows[np.isfinite(rows[:, _HEADINGS])]
    if not len(rows):
        return None, None
    true = np.radians(rows[:, _HEADINGS])
    north = frame.axes_at(frame.to_map(*rows[:, 1:4].T))[:, :, 1]
    baseline = np.asarray(FORWARD if baseline is None else baseline, np.float64)
    usual = OF_BASELINE_M / max(float(np.linalg.norm(baseline)), OF_BASELINE_M)
    stated = np.radians(rows[:, _HEADING_STDDEVS])
    stddevs = np.where(np.isnan(stated), usual, stated)
    headings, repairs = clean_headings(rows[:, 0], true + np.arctan2(*north[:, :2].T), stddevs, baseline)
    return (headings if len(headings) else None), repairs
