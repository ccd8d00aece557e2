"""Times of the points of a sweep, s after its stamp: tested, and what they probably are where they cannot be that."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.datasets.stamps import LONGEST_SWEEP_S
from gnss_sem_map.errors import PointTimesError
from gnss_sem_map.files.untrusted import refused

Array = NDArray[np.float64]

MOST_OUTSIDE = 0.1
"""Largest share of a sweep's returns without a valid time."""
UNITS = {1e3: "ms", 1e6: "µs", 1e9: "ns"}
SWEEPS_S = (0.01, 0.6)
"""Duration of most of a sweep: scanners have 2 to 50 revolutions per second."""


def are_returns(rows: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Which rows (n, 3 or more) are returns: where nothing came back drivers write zeros, or NaN, and any time."""
    with np.errstate(over="ignore"):
        size = np.abs(rows[:, 0]) + np.abs(rows[:, 1]) + np.abs(rows[:, 2])
    return np.asarray((size > 0) & (size < np.inf))


def leave_out_of_sweep(rows: NDArray[np.float32], after: Array, where: str) -> None:
    """Invalidate the points without a time in this sweep; raises DataError when too many of its returns are such."""
    outside = ~(np.abs(after) <= LONGEST_SWEEP_S)
    if outside.any():
        returned = are_returns(rows)
        count, of = int((outside & returned).sum()), int(returned.sum())
        if count > MOST_OUTSIDE * of:
            with np.errstate(invalid="ignore", over="ignore"):
                largest = float(np.nanmax(np.abs(after[returned]), initial=0.0))
            raise PointTimesError(
                f"{where}: {count} of {of} point times are none, or up to {largest:.4g} s off the scan's stamp;"
                f" expected seconds, at most {LONGEST_SWEEP_S:g}",
                _mistake_of(after[returned]),
            )
        rows[outside, :3], after[outside] = np.nan, 0.0
    if np.ptp(after) > LONGEST_SWEEP_S:
        raise refused(where, f"the sweep takes {np.ptp(after):.4g} s, expected at most {LONGEST_SWEEP_S:g}")


def _mistake_of(after: Array) -> str:
    """Probable unit or reference of point times that are not seconds after the stamp; robust to a few outliers."""
    known = after[np.isfinite(after)]
    if not len(known):
        return "point times are not numbers"
    low, middle, high = np.percentile(known, [5, 50, 95])
    unit = next(
        (unit for size, unit in UNITS.items() if SWEEPS_S[0] <= (high - low) / size <= SWEEPS_S[1]), None
    )
    # a float32 holds the time of day, or of the epoch, too coarsely to tell the points of a sweep apart
    if abs(middle) > LONGEST_SWEEP_S and high - low <= max(LONGEST_SWEEP_S, 1e-5 * abs(middle)):
        return "point times are absolute, or of another clock than the scan stamps"
    return f"point times are in {unit}" if unit else "point times are no seconds of one sweep"
