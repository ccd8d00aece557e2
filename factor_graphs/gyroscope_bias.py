"""A gyroscope bias that is too large for a first guess of zero: found from standstill, or from the course.

A raw MEMS unit may turn by several degrees a second at rest. Integrated for a minute that is a wrong heading, and the
optimiser does not come back from it. So what exceeds any calibrated unit is taken out of the samples before.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import cumulative_trapezoid

from factor_graphs.measurements import GnssFixes, ImuSamples

Array = NDArray[np.float64]

# A bias below this, rad/s (0.6 deg/s), the graph finds by itself; above the second no gyroscope is of use.
NOTABLE, LARGEST = 0.01, 0.2
STEP = 5e-4
# The course is that of the way from one fix to another, so many s later; over so many s a bias hardly changes.
CHORD_S, WINDOW_S = 2.0, 100.0
# Course and gyroscope are of one vehicle when this share of the course agrees; and another bias is better when it
# makes so many times as much agree.
AGREEING, BETTER = 0.5, 1.1
# Less way, m, shows no course.
LEAST_WAY_M = 100.0
# A second of standstill: the IMU scatters no more than so many times as in its quietest tenth, and the fixes stay
# within so many standard deviations. So many of them are believed.
QUIET, STAYING, LEAST_STANDING = 2.0, 3.0, 5
TINY = 1e-12


def large_gyroscope_bias(imu: ImuSamples, fixes: GnssFixes) -> Array:
    """The bias (3,) rad/s about the imu's axes, or zero where it is no larger than usual, or the drive hides it.

    Of standstill, if what it says agrees with the course; else about the vertical the one with which the gyroscope
    follows the course best, and none in the mean about the horizontal axes: a vehicle keeps its wheels on the ground.
    """
    nothing, fixes = np.zeros(3), fixes[(fixes.stamps >= imu.stamps[0]) & (fixes.stamps <= imu.stamps[-1])]
    if len(fixes) < 3:
        return nothing
    force = imu.specific_force.mean(axis=0)
    up = force / max(float(np.linalg.norm(force)), TINY)
    rest = _at_rest(imu, fixes)
    stamps, ways = _ways(fixes)
    if np.abs(ways).sum() < LEAST_WAY_M:
        return _if_large(nothing if rest is None else rest)
    turned = np.interp(stamps, imu.stamps, cumulative_trapezoid(imu.angular_rate @ up, imu.stamps, initial=0))
    # doubled, a course is the same whether the vehicle goes forward or reverses
    courses = np.abs(ways) * np.exp(2j * (np.angle(ways) - turned))
    biases = np.arange(-LARGEST, LARGEST + STEP, STEP)
    agreements = np.array([_agreement(stamps, courses, bias) for bias in biases])
    best = agreements.max()
    if rest is not None and BETTER * _agreement(stamps, courses, float(up @ rest)) > best:
        return _if_large(rest)
    if best < max(AGREEING, BETTER * _agreement(stamps, courses, 0.0)):
        return nothing
    mean = imu.angular_rate.mean(axis=0)
    return _if_large(biases[agreements.argmax()] * up + mean - (up @ mean) * up)


def _if_large(bias: Array) -> Array:
    return bias if NOTABLE < np.abs(bias).max() < LARGEST else np.zeros(3)


def _agreement(stamps: Array, courses: NDArray[np.complex128], bias: float) -> float:
    """Share of the way whose course the gyroscope follows, were this its bias about the vertical, rad/s."""
    window = ((stamps - stamps[0]) / WINDOW_S).astype(int)
    turned = courses * np.exp(2j * bias * stamps)
    sums = np.bincount(window, turned.real) + 1j * np.bincount(window, turned.imag)
    return float(np.abs(sums).sum() / np.abs(courses).sum())


def _ways(fixes: GnssFixes) -> tuple[Array, NDArray[np.complex128]]:
    """From fix to fix: the middle of the time (n,) s, and the way as a complex number, m."""
    first = np.arange(len(fixes))
    last = np.searchsorted(fixes.stamps, fixes.stamps + CHORD_S)
    first, last = first[last < len(fixes)], last[last < len(fixes)]
    near = fixes.stamps[last] - fixes.stamps[first] < 2 * CHORD_S
    first, last = first[near], last[near]
    way = fixes.positions[last] - fixes.positions[first]
    return (fixes.stamps[first] + fixes.stamps[last]) / 2, way[:, 0] + 1j * way[:, 1]


def _at_rest(imu: ImuSamples, fixes: GnssFixes) -> Array | None:
    """The median rate (3,) of the seconds in which the vehicle stands; None for less than a few of them."""
    second = (imu.stamps - imu.stamps[0]).astype(int)
    count = np.maximum(np.bincount(second), 1)
    quiet = count > count.max() / 2

    def means_of(columns: Array) -> Array:
        sums = np.column_stack([np.bincount(second, column) for column in columns.T])
        return np.asarray(sums / count[:, None])

    rates = means_of(imu.angular_rate)
    for samples, means in ((imu.specific_force, means_of(imu.specific_force)), (imu.angular_rate, rates)):
        scatter = np.sqrt(means_of((samples - means[second]) ** 2).sum(axis=1))
        quiet &= scatter <= QUIET * np.quantile(scatter[quiet], 0.1)
    stamps = np.arange(len(count)) + imu.stamps[0] + 0.5
    middles, ways = _ways(fixes)
    if not len(ways):
        return None
    limit = STAYING * np.sqrt(2) * np.hypot(*np.median(fixes.stddevs[:, :2], axis=0))
    stays = np.interp(stamps, middles, np.abs(ways), left=np.inf, right=np.inf) < limit
    still = quiet & stays
    return np.median(rates[still], axis=0) if still.sum() >= LEAST_STANDING else None
