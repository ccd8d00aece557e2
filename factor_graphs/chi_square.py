"""What chance explains: the chi-square distribution, and the few bounds that all decisions of this package share.

By special functions: importing scipy.stats would take most of a second.
"""

from typing import Any

import numpy as np
from scipy.special import chdtr, gammaincinv

from factor_graphs.arrays import Array

BEYOND_DOUBT = 5.0
"""In standard deviations: chance shows as much in one of two million drives."""
GOOD, RARE = 0.99, 0.999
"""A measurement is good below the first share of all that fit, and is rejected beyond the second."""
HUBER = 0.8
"""Huber's loss begins where it leaves this share of good measurements: for one number at 1.28 standard deviations."""
NOTABLE = 1.2
"""Noise is taken as stated unless so many times as much is found: less does no harm."""
MOST_CHANGE = 4.0
"""A variance that is found anew grows by no more than this at once."""
ROUNDS = 10
"""So many rounds of estimates that improve each other, at most: they nearly always stand still after three."""
NEVER_ZERO = 1e-12
"""Sums and squares are at least this where they are divided by."""


def quantile(probability: float, dof: float) -> float:
    """The value that a sum of `dof` squared standard normal variables stays below with this probability."""
    return float(2 * gammaincinv(dof / 2, probability))


def probability_below(value: float, dof: int) -> float:
    """The probability that such a sum stays below a value."""
    return float(chdtr(dof, value))


def mean_below(value: float, dof: int) -> float:
    """The mean of such sums that stay below a value."""
    return dof * probability_below(value, dof + 2) / probability_below(value, dof)


def huber_weights(squares: Array, dof: int) -> Array:
    """Weights of squared whitened residuals under Huber's loss."""
    bound = quantile(HUBER, dof)
    return np.sqrt(bound / np.maximum(squares, bound))


def robust_stddev(values: Array, axis: int | None = None) -> Any:
    """The standard deviation about zero of normal values, whatever a few others are (median absolute deviation)."""
    return np.median(np.abs(values), axis=axis) / quantile(0.5, 1) ** 0.5
