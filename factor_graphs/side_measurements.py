"""Measurements beside IMU and fixes, each looked at in a solution without it before it is held in the next one.

So a wrong unit, sign or place is found by what is known already, and said, and does not bend the trajectory.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from factor_graphs.problem import CARRIED_S, Fit, Problem

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Observed:
    """What a solution shows of a measurement beside the fixes: a verdict in words, and its factors at a solution.

    `factors` are None for what does not fit, or was not used.
    """

    verdict: str
    factors: Callable[[Fit], list[gtsam.NonlinearFactor]] | None = None


def factors_of(beside: Sequence[Observed], fit: Fit) -> list[gtsam.NonlinearFactor]:
    """The factors of all measurements that are used, at a solution."""
    return [factor for one in beside if one.factors is not None for factor in one.factors(fit)]


@dataclass(frozen=True, eq=False)
class Placed:
    """Which of some stamps (n,) have a keyframe: `rows` (r,) of them, its number `at` (r,), and how `late` (r,) s."""

    rows: NDArray[np.intp]
    at: NDArray[np.intp]
    late: Array


def placed(problem: Problem, stamps: Array) -> Placed:
    """The keyframes of stamps (n,) s on the clock of the IMU; those without one, as outside its span, are left out."""
    at = problem.intervals.keyframe_of(stamps)
    late = stamps - problem.intervals.keyframes[at]
    rows = np.flatnonzero(np.abs(late) <= CARRIED_S)
    return Placed(rows, at[rows], late[rows])
