"""Is the IMU as good as was said? Its share of the squared residuals, against the share of the measurements.

With all standard deviations honest, the squared whitened residuals of a group of factors sum up to its redundancy: its
rows, less what the unknowns take from them, tr(P Aᵀ A) (variance component estimation; Förstner 1979). From all rows
together they take as many as they are. So the redundancy of the IMU follows from the other factors, each of which binds
one keyframe only. A total over all residuals hardly shows the IMU: most of them are fixes.

Of the IMU, the steps of its biases are one component, and what is left given these, its white noise, the other: a unit
may be noisy and steady. From fix to fix white noise counts, in an outage of a minute the walk.
"""

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B
from numpy.typing import NDArray

from factor_graphs.chi_square import quantile
from factor_graphs.covariances import Places
from factor_graphs.elimination import PLACES, SIZE, split_key
from factor_graphs.model import from_values, motion_from
from factor_graphs.problem import GATE, GOOD_MEAN, Fit, Problem

Array = NDArray[np.float64]

# Within 99 % of what chance makes of it, noise is as expected. Found, it is good enough when it would change by less
# than a share: a drive shows white noise to some 10 %, walk less well.
CHANCE, ENOUGH, ENOUGH_OF_WALK = 0.99, 1.05, 1.1
# Errors of fixes are correlated where those of neighbours are, by so much: with so many fixes it is beyond chance. For
# so long, s, an IMU knows the way better than fixes.
CORRELATED, FEWEST_CORRELATED, KNOWN_WAY_S = 0.3, 60, 5.0
# Rows of the graph are looked at in blocks of so many, few enough for the cache.
BLOCK = 1_000
# A power of the ratio of variances that is changed by, one half if what unknowns take did not follow it; and the most.
POWER, MOST = 0.75, 4.0


class BiasSteps:
    """Variance of the step of the biases from each of k keyframes to the next, `variance` (k - 1, 6).

    Known once `keyframe_covariances` has gone through all of them.
    """

    def __init__(self, k: int) -> None:
        self.variance = np.zeros((k - 1, 6))

    def add(self, i: int, W: Array, rows: NDArray[np.intp], joint: Array, known: Places) -> None:
        if i < len(self.variance):
            own, following = known[B(i)], known[B(i + 1)]
            self.variance[i] = joint[own, own] + joint[following, following] - 2 * joint[own, following]


def imu_noise_shown(problem: Problem, fit: Fit, covariances: Array, steps: BiasSteps) -> tuple[float, float]:
    """How many times more white noise and bias walk the IMU has than is expected, each at least 1; as fit if it fits.

    By the state covariances (k, 15, 15) of a fit. Chance is no reason to change it; once it is changed, the best
    estimate is wanted. For a graph without relative poses: each of its other factors binds one keyframe, beside what
    all share.
    """
    squares, redundancy = _squares(fit, len(covariances)), _redundancy(fit, covariances)
    of_walk = _of_walk(problem, fit, steps)
    of_white = squares - of_walk[0], redundancy - of_walk[1]
    return (
        _corrected(fit.inflation, *of_white, ENOUGH),
        _corrected(fit.of_walk, *of_walk, ENOUGH_OF_WALK),
    )


def fix_noise_shown(problem: Problem, fit: Fit, covariances: Array) -> float:
    """How many times more noise the fixes have than they say, at least 1; as the problem has it if it fits.

    By the good ones, and the state covariances (k, 15, 15) of a fit: outliers are no noise. Where most look like
    outliers, they are noise, and the median tells how much; the next fits tell it better.
    """
    good = fit.squares < GATE
    if 2 * good.sum() < len(good):
        return problem.of_fixes * min(float(np.sqrt(np.median(fit.squares) / quantile(0.5, 3))), MOST)
    at, (x, y, z) = problem.at[good], problem.p_imu_antenna
    R_map_imu = motion_from(fit.values)[0][at, :3, :3]
    lever = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    rows = problem.fixes.whitening[good] @ np.concatenate([-R_map_imu @ lever, R_map_imu], axis=2)
    taken = np.sum((rows @ covariances[at, :6, :6]) * rows)
    expected = GOOD_MEAN / 3 * (3 * good.sum() - taken)
    return _corrected(problem.of_fixes, float(fit.squares[good].sum()), float(expected), ENOUGH)


def correlation_time_shown(stamps: Array, whitened: Array) -> float:
    """Within which time fixes weigh as one, s, by their whitened residuals (m, 3); 0 where they look independent.

    The IMU knows the way over some seconds: a smoother that follows errors of fixes hardly changes their steps there.
    Half the mean square of these is 1 less the correlation. If that is c exp(-t / τ), with white noise of 1 - c beside
    it, a mean over T has the variance of one fix times 2 c τ / T. Fixes that are better than they say have small steps,
    too, but are not like their neighbours. What lasts longer than the drive is a shift, which nothing shows.
    """
    if len(stamps) < FEWEST_CORRELATED:
        return 0.0
    dt = float(np.median(np.diff(stamps)))
    far = max(2, round(KNOWN_WAY_S / dt))
    (uncorrelated, of_near), (later, _) = (_steps(stamps, whitened, n, dt) for n in (1, far))
    if not 0 < uncorrelated < min(later, 1.0, (1 - CORRELATED) * of_near) or later >= 1:
        return 0.0
    time = (far - 1) * dt / float(np.log((1 - uncorrelated) / (1 - later)))
    return 2 * (1 - uncorrelated) * time if time < stamps[-1] - stamps[0] else 0.0


def _steps(stamps: Array, whitened: Array, n: int, dt: float) -> tuple[float, float]:
    """Half the mean square of steps from fixes to the n-th after them, without gaps, and the mean square of both."""
    whole = stamps[n:] - stamps[:-n] < (n + 0.5) * dt
    if not whole.any():
        return 0.0, 0.0
    first, second = whitened[:-n][whole], whitened[n:][whole]
    return float(np.mean((second - first) ** 2)) / 2, float(np.mean(first**2 + second**2)) / 2


def _corrected(now: float, squares: float, redundancy: float, enough: float) -> float:
    """The noise that squared residuals of a redundancy show, the same where it is good enough."""
    if redundancy < 1 or (now == 1.0 and squares <= quantile(CHANCE, redundancy)):
        return now
    better = max(1.0, now * min(float(squares / redundancy) ** POWER, MOST))
    return now if 1 / enough < better / now < enough else better


def _of_walk(problem: Problem, fit: Fit, steps: BiasSteps) -> tuple[float, float]:
    """The squared whitened steps of the biases, and their redundancy."""
    noise, k = problem.noise.scaled(1.0, fit.of_walk), len(problem.intervals.keyframes)
    density = np.repeat([noise.accelerometer_bias_walk, noise.gyroscope_bias_walk], 3)
    believed = density**2 * np.diff(problem.intervals.keyframes)[:, None]
    walked = np.diff(from_values(fit.values, k)[2], axis=0)
    return float(np.sum(walked**2 / believed)), float(np.sum(1 - steps.variance / believed))


def _squares(fit: Fit, k: int) -> float:
    """The squared whitened residuals of the IMU between k keyframes; priors follow it in the graph."""
    of_priors = sum(fit.motion.at(n).error(fit.values) for n in range(k - 1, fit.motion.size()))
    return float(2 * (fit.motion.error(fit.values) - of_priors))


def _redundancy(fit: Fit, covariances: Array) -> float:
    """Rows of the IMU, less what the unknowns take from them: all unknowns, less what they take from other factors."""
    k, others, total = len(covariances), gtsam.NonlinearFactorGraph(), 0.0
    for n in range(k - 1, fit.graph.size()):
        others.push_back(factor=fit.graph.at(n))
    # of every column of the Jacobian its keyframe and its place there; the right side is the last column
    columns = [(i, place) for letter, i in map(split_key, others.keyVector()) for place in PLACES[letter]]
    keyframe, place = np.array([*columns, (k, 0)]).T
    row, column, value = others.linearize(fit.values).sparseJacobian_()
    row, column = row.astype(int) - 1, column.astype(int) - 1
    of_state = keyframe[column] < k
    row, column, value = row[of_state], column[of_state], value[of_state]
    at, A = np.zeros(row.max() + 1, int), np.zeros((row.max() + 1, SIZE))
    at[row], A[row, place[column]] = keyframe[column], value
    for rows in np.array_split(np.arange(len(A)), len(A) // BLOCK + 1):
        total += float(np.einsum("ri,rij,rj->", A[rows], covariances[at[rows]], A[rows]))
    return total - SIZE
