"""Plausibility of stamps, checked before memory is allocated for their span."""

from __future__ import annotations

from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from factor_graphs.stamps import far_off, unit_fault
from gnss_sem_map.files.untrusted import refused
from gnss_sem_map.sensor_log import Skip

LONGEST_SWEEP_S = 1.0
FAR_FROM_SWEEP_S = 0.5
"""A scan's stamp may lie this far outside its sweep."""
FIRST_YEAR, LAST_YEAR = 1980, 2200
"""Years of GPS, and of nanoseconds in 64 bits."""
LONGEST_FRAME_STEP_S = 20.0
"""Usual steps are far shorter; stamps in milliseconds instead of seconds make them longer."""


class Stamped(Protocol):
    """A measurement with a stamp."""

    @property
    def number(self) -> int:
        """Frame number."""
        ...

    @property
    def stamp(self) -> float:
        """s."""
        ...


T = TypeVar("T", bound=Stamped)


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
            f"{stamp:.10g} s after `epoch_ns: {epoch_ns}` of log.yaml, its Unix time in nanoseconds, is in {year:.0f}",
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
    for item, is_off in zip(items, alone, strict=True):
        if is_off:
            skips.append(
                Skip(what, f"frame {item.number}", f"stamp {item.stamp:.6g} s is far off all others")
            )
    kept: list[T] = []
    near = (item for item, is_off in zip(items, alone, strict=True) if not is_off)
    for item in sorted(near, key=lambda item: (item.stamp, item.number)):
        if kept and item.stamp == kept[-1].stamp:
            skips.append(Skip(what, f"frame {item.number}", "repeated stamp"))
        else:
            kept.append(item)
    return tuple(kept)
