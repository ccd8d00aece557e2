"""Measurements beside IMU and fixes, each looked at in a solution without it before it is held in the next one.

So a wrong unit, sign or place is found by what is known already, and said, and does not bend the trajectory.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from factor_graphs.chi_square import quantile
from factor_graphs.problem import CARRIED_S, Fit, Problem

Array = NDArray[np.float64]

# Seen so often, measurements show what they are.
FEWEST_SEEN = 10
# Noise is taken as stated unless it is so many times larger.
NOTABLE = 1.2
# Errors that last longer are not looked for: tracking loops and filters of receivers are far shorter.
LONGEST_ERROR_S = 20.0
# One good measurement of one number in twenty has Huber's loss.
HUBER = quantile(0.95, 1) ** 0.5


@dataclass(frozen=True, eq=False)
class Observed:
    """What a solution shows of a measurement beside the fixes: a verdict in words, and its factors at a solution.

    `factors` are None for what does not fit, or was not used. `doubtful`: the verdict is worth a note. `turn` rad:
    the solution does not know its heading, and is to be turned by so much about up before it is one to linearise
    at.
    """

    verdict: str
    factors: Callable[[Fit], list[gtsam.NonlinearFactor]] | None = None
    doubtful: bool = False
    turn: float = 0.0
    points: tuple[Any, NDArray[np.bool_]] | None = None
    """Surveyed points with the moments that were found, and which of them are held."""


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


def noise_scale(stamps: Array, off: Array, stddevs: Array, of_solution: Array | float = 0.0) -> float:
    """As if of how many times more noise than stated measurements count, at least 1.

    By residuals `off` (n, c) at stamps (n,), stddevs (n, c), and the variances (n, c) of the solution's part in
    these. By medians, so that outliers are none. Where errors last, several measurements say as much as one.
    """
    shown = float(np.median(np.sum(off**2, axis=1))) / quantile(0.5, off.shape[1])
    own, stated = float(np.median(of_solution)), float(np.median(stddevs**2))
    variance = max(shown - own, stated)
    scale = float(np.sqrt(_crowd(stamps, off, variance, own) * variance / stated))
    return scale if scale > NOTABLE else 1.0


def _crowd(stamps: Array, off: Array, variance: float, of_solution: float) -> float:
    """How many measurements say as much as one that is independent: 1 + 2 times the sum of their autocorrelation.

    `off` (n, c) are their residuals, of that variance; the solution's own error is taken for one that lasts. The sum
    ends where the correlation is no more than chance (two standard deviations of white noise).
    """
    off, dt = np.clip(off, -3 * variance**0.5, 3 * variance**0.5), float(np.median(np.diff(stamps)))
    crowd = 1.0
    for lag in range(1, max(2, int(LONGEST_ERROR_S / dt))):
        whole = stamps[lag:] - stamps[:-lag] < (lag + 0.5) * dt
        products = (off[lag:] * off[:-lag])[whole]
        if products.size < FEWEST_SEEN:
            break
        correlation = (float(products.mean()) - of_solution) / variance
        if correlation < 2 / products.size**0.5:
            break
        crowd += 2 * correlation
    return crowd
