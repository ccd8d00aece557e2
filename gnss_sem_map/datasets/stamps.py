"""Plausibility of stamps, and of the times of the points of a sweep, before memory is allocated for their span."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from factor_graphs.stamps import far_off, unit_fault
from gnss_sem_map.errors import PointTimesError
from gnss_sem_map.files.untrusted import refused
from gnss_sem_map.sensor_log import Image, Scan, Skip

LONGEST_SWEEP_S = 1.0
FAR_FROM_SWEEP_S = 0.5
"""A scan's stamp may lie this far outside its sweep."""
FIRST_YEAR, LAST_YEAR = 1980, 2200
"""Years of GPS, and of nanoseconds in 64 bits."""
LONGEST_FRAME_STEP_S = 20.0
"""Usual steps are far shorter; stamps in milliseconds instead of seconds make them longer."""
T = TypeVar("T", Scan, Image)
Array = NDArray[np.float64]
MOST_OUTSIDE = 0.1
"""Largest share of a sweep's returns without a valid time."""
UNITS = {1e3: "ms", 1e6: "µs", 1e9: "ns"}
SWEEPS_S = (0.01, 0.6)
"""Duration of most of a sweep: scanners have 2 to 50 revolutions per second."""


def check_unit(stamps: NDArray[np.float64], longest_step_s: float, where: str) -> None:
    """Raise DataError, with the likely unit, when the usual step between the stamps is longer than any sensor's."""
    if fault := unit_fault(stamps, longest_step_s):
        raise refused(where, f"{fault}")


def check_date(stamp: float, epoch_ns: int, where: str) -> None:
    """Raise DataError when a stamp, s after the epoch, is later than any drive, or as long before 1970.

    With an epoch it is a date; before the first of GPS the epoch is not in nanoseconds.
    """
    year = 1970 + (stamp + epoch_ns * 1e-9) / (365.2425 * 86400)
    if abs(year - 1970) > LAST_YEAR - 1970:
        raise refused(
            where,
            f"the stamp {stamp:.10g} s is of the year {year:.0f}, expected one up to {LAST_YEAR},"
            " in seconds since `epoch_ns` of log.yaml",
        )
    if epoch_ns and year < FIRST_YEAR:
        raise refused(
            where,
            f"with `epoch_ns: {epoch_ns}` {stamp:.10g} s is of the year {year:.0f}; it is Unix time in nanoseconds",
        )


def sweep_fault(stamp: float, start: float, end: float) -> str | None:
    """Why these are not the stamp, start and end of one sweep, s; None if they are plausible."""
    if not start < end:
        return "the sweep ends before it starts"
    if end - start > LONGEST_SWEEP_S:
        return f"the sweep takes {end - start:.6g} s, expected at most {LONGEST_SWEEP_S:g}"
    if not start - FAR_FROM_SWEEP_S <= stamp <= end + FAR_FROM_SWEEP_S:
        return f"its stamp is {stamp - start:.6g} s after the sweep began"
    return None


def in_order(what: str, items: list[T], skips: list[Skip]) -> tuple[T, ...]:
    """Sorted by stamp; of two with equal stamps the first is kept, and outliers in time are removed: see `skips`."""
    alone = far_off(np.array([item.stamp for item in items]))
    kept: list[T] = []
    for item, is_off in sorted(
        zip(items, alone.tolist(), strict=True), key=lambda one: (one[0].stamp, one[0].number)
    ):
        is_repeated = bool(kept) and item.stamp == kept[-1].stamp
        if is_off or is_repeated:
            why = f"stamp {item.stamp:.6g} s is far off all others" if is_off else "repeated stamp"
            skips.append(Skip(what, f"frame {item.number}", why))
        else:
            kept.append(item)
    return tuple(kept)


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
