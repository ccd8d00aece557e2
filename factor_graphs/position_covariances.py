"""Covariances of positions as receivers report them: standard deviations, and how the errors are correlated.

Both apart, so that what makes a fix weigh less (a floor, a crowd of fixes, a receiver that promises too much) changes
its standard deviations, and leaves a covariance that is positive definite.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Rows and columns of the correlations east-north, east-up, north-up.
_PAIRS = np.array([0, 0, 1]), np.array([1, 2, 2])
# An eigenvalue of a correlation matrix below this is zero by the rounding of the numbers that receivers write.
LEAST_EIGENVALUE = 1e-4
# Both halves of a symmetric matrix agree to this share of its variances.
ASYMMETRY = 1e-6


def matrices_of(correlations: Array) -> Array:
    """Correlation matrices (m, 3, 3) of correlations (m, 3) east-north, east-up, north-up."""
    matrices = np.tile(np.eye(3), (len(correlations), 1, 1))
    matrices[:, *_PAIRS] = matrices[:, *_PAIRS[::-1]] = correlations
    return matrices


def are_correlations(correlations: Array) -> NDArray[np.bool_]:
    """Which rows (m,) are of a positive definite matrix; correlations (m, 3) finite."""
    return np.asarray(np.linalg.eigvalsh(matrices_of(correlations))[:, 0] >= LEAST_EIGENVALUE)


def covariances_of(stddevs: Array, correlations: Array | None) -> Array:
    """Covariances (m, 3, 3) m² of standard deviations (m, 3) m and correlations (m, 3), None: of zero."""
    matrices = matrices_of(np.zeros_like(stddevs) if correlations is None else correlations)
    return np.asarray(matrices * stddevs[:, :, None] * stddevs[:, None])


def split_covariances(covariances: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Standard deviations (m, 3) m, correlations (m, 3), and which rows (m,) are no covariance: covariances (m, 3, 3).

    A matrix that is not symmetric and positive definite is no covariance. Its correlations become zero: what is left of
    it are its variances, of which those below zero give NaN.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        stddevs = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
        scales = stddevs[:, :, None] * stddevs[:, None]
        matrices = covariances / scales
        skew = np.abs(covariances - covariances.swapaxes(1, 2)) > ASYMMETRY * scales
    correlations = matrices[:, *_PAIRS]
    good = np.isfinite(matrices).all(axis=(1, 2)) & ~skew.any(axis=(1, 2))
    good[good] = are_correlations(correlations[good])
    return stddevs, np.where(good[:, None], correlations, 0.0), ~good
