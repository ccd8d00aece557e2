"""Stamps of a sensor, s: which are of another drive, whether they are seconds, and where they have gaps."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

UNITS = {"milliseconds": 1e-3, "microseconds": 1e-6, "nanoseconds": 1e-9}
# A longer step than so many usual ones is a gap: where one row is lost it is of two, with some jitter.
LONGEST_STEP = 2.5
# Rows farther than a break from all others are of the same drive when they are many, or within a day.
BREAK_S, DAY_S, FEW = 600.0, 86_400.0, 0.01


def far_off(stamps: Array) -> NDArray[np.bool_]:
    """Which stamps (n,) s, finite, in any order, are not of the same drive as most: (n,).

    Between groups are breaks of ten minutes. A group is far off the largest one when it has a hundredth of its
    stamps or less, or is but one, or when it lies more than a day away.
    """
    off = np.zeros(len(stamps), dtype=bool)
    if len(stamps) < 2:
        return off
    order = np.argsort(stamps, kind="stable")
    with np.errstate(over="ignore"):
        group = np.concatenate([[0], np.cumsum(np.diff(stamps[order]) > BREAK_S)])
        sizes = np.bincount(group)
        largest = int(sizes.argmax())
        few = (sizes <= FEW * sizes[largest]) | ((sizes == 1) & (sizes[largest] >= 3))
        centre = stamps[order][group == largest].mean()
        off[order] = few[group] | ((np.abs(stamps[order] - centre) > DAY_S) & (group != largest))
    return off


def unit_fault(stamps: Array, longest_step_s: float) -> str | None:
    """Why stamps (n,) are not seconds, by their usual step, and what they probably are; None if they may be."""
    step = _usual_step(stamps)
    if step <= longest_step_s:
        return None
    unit = unit_of_steps(stamps, longest_step_s)
    fault = f"the usual step between stamps is {step:.6g}, expected seconds, at most {longest_step_s:g}"
    return fault + (f"; are these {unit}?" if unit else "")


def unit_of_steps(stamps: Array, longest_step_s: float) -> str | None:
    """The unit of `UNITS` in which the usual step of stamps (n,) is short enough; None for seconds, or for none."""
    step = _usual_step(stamps)
    if step <= longest_step_s:
        return None
    return next((unit for unit, scale in UNITS.items() if step * scale <= longest_step_s), None)


def _usual_step(stamps: Array) -> float:
    """The median of the steps above zero; 0 where there are too few to tell."""
    with np.errstate(over="ignore"):
        steps = np.diff(np.sort(stamps[np.isfinite(stamps)]))
    steps = steps[steps > 0]
    return float(np.median(steps)) if len(steps) >= 2 else 0.0


def gaps(stamps: Array) -> Array:
    """First and last stamp, s, of every step longer than LONGEST_STEP usual (median) steps: (g, 2)."""
    steps = np.diff(stamps)
    wide = np.flatnonzero(steps > LONGEST_STEP * np.median(steps)) if len(steps) else np.empty(0, dtype=int)
    return np.column_stack([stamps[wide], stamps[wide + 1]])
