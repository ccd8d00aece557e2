"""Is the IMU as good as was said? Its share of the squared residuals, against the share of the measurements.

With all standard deviations honest, the squared whitened residuals of a group of factors sum up to its redundancy: its
rows, less what the unknowns take from them, tr(P Aᵀ A) (variance component estimation; Förstner 1979). From all rows
together they take as many as they are. So the redundancy of the IMU follows from the other factors, each of which binds
one keyframe only. A total over all residuals hardly shows the IMU: most of them are fixes.
"""

import gtsam
import numpy as np
from numpy.typing import NDArray

from factor_graphs.chi_square import quantile
from factor_graphs.elimination import PLACES, SIZE, split_key
from factor_graphs.problem import Fit

Array = NDArray[np.float64]

# Within 99 % of what chance makes of it, the noise of the IMU is as expected; found, it is good enough when it would
# change by less than this.
CHANCE, ENOUGH = 0.99, 1.03


def missing_imu_noise(fit: Fit, covariances: Array, is_noisier: bool) -> float:
    """How many times more noise the IMU has than the fit believes, by its state covariances (k, 15, 15); at least 1.

    Chance is no reason to change it; once the IMU `is_noisier` for sure, the best estimate is wanted. For a graph
    without relative poses: each of its other factors binds one keyframe, beside what all share.
    """
    squares, redundancy = _squares(fit, len(covariances)), _redundancy(fit, covariances)
    if redundancy < 1 or (not is_noisier and squares <= quantile(CHANCE, redundancy)):
        return 1.0
    missing = float(np.sqrt(squares / redundancy))
    return missing if missing > ENOUGH else 1.0


def _squares(fit: Fit, k: int) -> float:
    """The squared whitened residuals of the IMU between k keyframes; priors follow it in the graph."""
    of_priors = sum(fit.motion.at(n).error(fit.values) for n in range(k - 1, fit.motion.size()))
    return float(2 * (fit.motion.error(fit.values) - of_priors))


def _redundancy(fit: Fit, covariances: Array) -> float:
    """Rows of the IMU, less what the unknowns take from them: all unknowns, less what they take from other factors."""
    k, others, total = len(covariances), gtsam.NonlinearFactorGraph(), 0.0
    for n in range(k - 1, fit.graph.size()):
        others.push_back(fit.graph.at(n))
    linear = others.linearize(fit.values)
    for n in range(linear.size()):
        factor = linear.at(n)
        assert isinstance(factor, gtsam.JacobianFactor)
        A, begin = factor.jacobian()[0], 0
        rows, i = np.zeros((len(A), covariances.shape[1])), -1
        for letter, index in map(split_key, factor.keys()):
            place = PLACES[letter]
            end = begin + len(place)
            if index < k:
                rows[:, place], i = A[:, begin:end], index
            begin = end
        if i >= 0:
            total += float(np.sum(rows @ covariances[i] * rows))
    return total - SIZE
