"""What is left of a velocity when the part that is explained is taken away: its variance, and how long it lasts."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from factor_graphs.chi_square import probability_below

Array = NDArray[np.float64]

# At first, slip is not believed to be less, m/s, for as long, s: a fifth of what a car on a road shows sideways. Once
# the constraint is held, its residuals say more (`slip_variance.py`).
LEAST_SLIP, LEAST_LASTING_S = 0.02, 1.0
# Means over this time, s, show how long slip lasts: several times as long as it lasts, and dozens in a drive.
BLOCK_S = 10.0
# Keyframes are as far apart as this, s, in an outage: slip that changes faster is seen there as it is sampled.
SPARSE_S = 1.0
# The heading of a solution drifts, and looks like slip; over this time, s, it does not.
DRIFT_S = 20.0
# Huber's loss of the fit, and where squares are cut, in standard deviations; what a cut leaves of a normal variance.
HUBER, CUT, ROUNDS = 1.345, 2.5, 10
LEFT = probability_below(CUT**2, 3) + CUT**2 * (1 - probability_below(CUT**2, 1))


@dataclass(frozen=True, eq=False)
class Slip:
    """Velocity that nothing explains: it is random, grows, and lasts for a while.

    `parts` (3,) of its variance: m²/s², by squared speed, by squared lateral acceleration; `typical` m/s is its root
    mean square. `lasting_s` is the time in which it tells as much as one independent value does: the integral of its
    autocorrelation. That is less than the time between values where slip swings to and fro, as a suspension does.
    """

    parts: Array
    lasting_s: float
    typical: float

    def stddevs(self, grows_with: Array, spacing: Array) -> Array:
        """What to believe of one value among others `spacing` (k,) s apart, (k,) m/s; `grows_with` (k, 3)."""
        # what it is over a long time counts: from moment to moment the imu knows the motion far better
        together = self.lasting_s / np.minimum(spacing, max(self.lasting_s, SPARSE_S))
        return np.asarray(np.sqrt(grows_with @ self.parts * together), np.float64)


def explain(
    y: Array,
    by: Array,
    stddevs: Array,
    ahead: Array,
    grows_with: Array,
    spacing: Array,
) -> tuple[Array, Slip, Array]:
    """The x (n,) of y = by x + slip, and the slip: each from the other in turn (iteratively reweighted least squares).

    Third, what is neither (k,) m/s: a skid, zero where there is none. The mean slope of every `DRIFT_S` s is taken for
    drift of heading. Where the constraint holds the heading, slip that lasts longer hides in it; counted as slip, it
    would loosen the constraint wherever clock or axes are a little wrong: 5.1 m in place of 4.1 m in the outages of a
    real log.

    `y` (k,) m/s; `by` (k, n); `stddevs` (n,) is what x may be at all; `ahead` (k,) m/s is the speed; `grows_with`
    (k, 3) and `spacing` (k,) s as in `Slip.stddevs`.
    """
    from scipy.optimize import nnls  # takes 0.2 s to import; a drive with LiDAR does without

    x: Array = np.zeros(len(stddevs))
    window = (np.cumsum(spacing) / DRIFT_S).astype(int)
    left, drift, parts = y, np.zeros(window[-1] + 1), np.zeros(3)
    variance: Array = np.full(len(y), max(robust_stddev(y), LEAST_SLIP) ** 2)
    for _ in range(ROUNDS):
        weights = spacing * _huber(y - by @ x, variance)
        information = (by.T * weights) @ by + np.diag(stddevs**-2)
        x = np.linalg.inv(information) @ (by.T * weights) @ y
        left = y - by @ x - drift[window] * ahead
        weights = _huber(left, variance)
        lever = np.bincount(window, weights * ahead**2)
        drift = drift + np.bincount(window, weights * left * ahead) / np.maximum(lever, 1e-12)
        left, most = y - by @ x - drift[window] * ahead, CUT * np.sqrt(variance)
        scale = np.sqrt(spacing) / variance
        parts = nnls(grows_with * scale[:, None], np.clip(left, -most, most) ** 2 / LEFT * scale)[0]
        parts[0] = max(parts[0], LEAST_SLIP**2)
        variance = grows_with @ parts
    typical = float(np.sqrt(np.average(variance, weights=spacing)))
    off = left / np.sqrt(variance)
    lasting = max(_lasting(np.clip(off, -CUT, CUT), spacing), LEAST_LASTING_S * (LEAST_SLIP / typical) ** 2)
    slip = Slip(parts, lasting, typical)
    return x, slip, np.where(np.abs(off) > CUT, left, 0.0)


def _huber(off: Array, variance: Array) -> Array:
    """Weights of values under Huber's loss."""
    weights: Array = np.minimum(1.0, HUBER * np.sqrt(variance) / np.maximum(np.abs(off), 1e-12)) / variance
    return weights


def robust_stddev(values: Array) -> float:
    """The standard deviation about zero of normal values, whatever a few others are (median absolute deviation)."""
    return 1.4826 * float(np.median(np.abs(values)))


def _lasting(values: Array, spacing: Array) -> float:
    """Integral of the autocovariance of whitened values, both sides, s, from the means of blocks (batch means)."""
    middle = np.cumsum(spacing) - spacing / 2
    sparse = np.diff(middle // SPARSE_S, prepend=-1.0) > 0
    values, each = values[sparse], np.maximum(spacing[sparse], SPARSE_S)
    sums = np.bincount((np.cumsum(each) // BLOCK_S).astype(int), values * each)
    return float(sums @ sums / each.sum())
