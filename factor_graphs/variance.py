"""Is the IMU as good as was said? Its share of the squared residuals, against the share of the measurements.

With all standard deviations honest, the squared whitened residuals of a group of factors sum up to its redundancy: its
rows, less what the unknowns take from them, tr(A P Aᵀ) (variance component estimation; Förstner 1979). A total over all
residuals hardly shows the IMU: most of them are fixes.

Of the IMU, the steps of its biases are one component, and what is left given these, its white noise, the other: a unit
may be noisy and steady. From fix to fix white noise counts, in an outage of a minute the walk.
"""

import numpy as np
from gtsam.symbol_shorthand import B

from factor_graphs.arrays import Array, Rows
from factor_graphs.chi_square import GOOD, MOST_CHANGE, mean_below, quantile
from factor_graphs.elimination import SIZE, Places, keyframe_covariances
from factor_graphs.model import skew
from factor_graphs.problem import GATE, Fit, Problem

# Within 99 % of what chance makes of it, noise is as expected. Found, it is good enough when it would change by less
# than a share: a drive shows white noise to some 10 %, walk less well.
ENOUGH, ENOUGH_OF_WALK = 1.05, 1.1
# Errors of fixes are correlated where those of neighbours are, by so much: with so many fixes it is beyond chance. For
# so long, s, an IMU knows the way better than fixes.
CORRELATED, FEWEST_CORRELATED, KNOWN_WAY_S = 0.3, 60, 5.0
# A power of the ratio of variances that is changed by: one half if what unknowns take did not follow it.
POWER = 0.75


class ImuResiduals:
    """Squares and redundancy of the whitened residuals of the IMU in a fit: of all, and of the steps of its biases.

    And the covariances of the keyframes (k, 15, 15), and of what these share, which are found on the way.
    """

    def __init__(self, problem: Problem, fit: Fit) -> None:
        noise, k = problem.noise.scaled(1.0, fit.of_walk), len(problem.intervals.keyframes)
        density = np.repeat([noise.accelerometer_bias_walk, noise.gyroscope_bias_walk], 3)
        self._fit, self._walk = fit, density**2 * np.diff(problem.intervals.keyframes)[:, None]
        self.squares = sum(2 * fit.motion.at(n).error(fit.values) for n in range(k - 1))
        self.squares_of_walk = float(np.sum(np.diff(fit.states[2], axis=0) ** 2 / self._walk))
        self.redundancy, self.redundancy_of_walk = float(SIZE * (k - 1)), float(self._walk.size)
        self.covariances, self.of_shared = keyframe_covariances(fit.graph, fit.values, k, self)

    def add(self, i: int, W: Array, rows: Rows, joint: Array, known: Places) -> None:
        """What the unknowns take from the factor between keyframe i and the next."""
        if i == len(self._walk):
            return
        factor, own, following = self._fit.motion.at(i), known[B(i)], known[B(i + 1)]
        A = factor.linearize(self._fit.values).jacobian()[0]
        at = np.concatenate([known[key] for key in list(factor.keys())])
        self.redundancy -= float(np.sum((A @ joint[at[:, None], at]) * A))
        variances = joint[own, own] + joint[following, following] - 2 * joint[own, following]
        self.redundancy_of_walk -= float(np.sum(variances / self._walk[i]))


def imu_noise_shown(fit: Fit, shown: ImuResiduals) -> tuple[float, float]:
    """How many times more white noise and bias walk the IMU has than is expected, each at least 1; as fit if it fits.

    Chance is no reason to change it; once it is changed, the best estimate is wanted.
    """
    squares, redundancy = shown.squares_of_walk, shown.redundancy_of_walk
    return (
        _corrected(fit.inflation, shown.squares - squares, shown.redundancy - redundancy, ENOUGH),
        _corrected(fit.of_walk, squares, redundancy, ENOUGH_OF_WALK),
    )


def fix_noise_shown(problem: Problem, fit: Fit, covariances: Array) -> float:
    """How many times more noise the fixes have than they say, at least 1; as the problem has it if it fits.

    By the good ones, and the state covariances (k, 15, 15) of a fit: outliers are no noise. Where most look like
    outliers, they are noise, and the median tells how much; the next fits tell it better.
    """
    good = fit.squares < GATE
    if 2 * good.sum() < len(good):
        return problem.of_fixes * min(float(np.sqrt(np.median(fit.squares) / quantile(0.5, 3))), MOST_CHANGE)
    at = problem.at[good]
    R_map_imu = fit.states[0][at, :3, :3]
    by_pose = np.concatenate([-R_map_imu @ skew(problem.p_imu_antenna), R_map_imu], axis=2)
    rows = problem.fixes.whitening[good] @ by_pose
    taken = np.sum((rows @ covariances[at, :6, :6]) * rows)
    expected = mean_below(GATE, 3) / 3 * (3 * good.sum() - taken)
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
    if redundancy < 1 or (now == 1.0 and squares <= quantile(GOOD, redundancy)):
        return now
    better = max(1.0, now * min(float(squares / redundancy) ** POWER, MOST_CHANGE))
    return now if 1 / enough < better / now < enough else better
