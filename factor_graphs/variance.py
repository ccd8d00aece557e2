"""Is the IMU as good as was said? Its share of the squared residuals, against the share of the measurements.

With all standard deviations honest, the squared whitened residuals of a group of factors sum up to its redundancy: its
rows, less what the unknowns take from them, tr(P Aᵀ A) (variance component estimation; Förstner 1979). The rows of the
IMU and the priors are as many as the unknowns, so their redundancy is what the unknowns take from all other rows. A
total over all residuals hardly shows the IMU: most of them are fixes.
"""

import gtsam
import numpy as np
from numpy.typing import NDArray

from factor_graphs.chi_square import quantile
from factor_graphs.covariances import PLACES, split_key
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
    squares, redundancy = 2 * fit.motion.error(fit.values), _leverage(fit, covariances)
    if redundancy < 1 or (not is_noisier and squares <= quantile(CHANCE, redundancy)):
        return 1.0
    missing = float(np.sqrt(squares / redundancy))
    return missing if missing > ENOUGH else 1.0


def _leverage(fit: Fit, covariances: Array) -> float:
    """What the unknowns take from the rows of fixes and constraints: tr(P Aᵀ A), summed over them."""
    linear = fit.graph.linearize(fit.values)
    total = 0.0
    for n in range(fit.motion.size(), linear.size()):
        factor = linear.at(n)
        assert isinstance(factor, gtsam.JacobianFactor)
        A, begin = factor.jacobian()[0], 0
        rows, i = np.zeros((len(A), covariances.shape[1])), -1
        for letter, index in map(split_key, factor.keys()):
            place = PLACES[letter]
            end = begin + place.stop - place.start
            if index < len(covariances):
                rows[:, place], i = A[:, begin:end], index
            begin = end
        if i >= 0:
            total += float(np.sum(rows @ covariances[i] * rows))
    return total
