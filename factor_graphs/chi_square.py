"""The chi-square distribution by its special functions: importing scipy.stats would take most of a second."""

from scipy.special import chdtr, gammaincinv

BEYOND_DOUBT = 5.0
"""In standard deviations: chance shows as much in one of two million drives."""


def quantile(probability: float, dof: float) -> float:
    """The value that a sum of `dof` squared standard normal variables stays below with this probability."""
    return float(2 * gammaincinv(dof / 2, probability))


def probability_below(value: float, dof: int) -> float:
    """The probability that such a sum stays below a value."""
    return float(chdtr(dof, value))
