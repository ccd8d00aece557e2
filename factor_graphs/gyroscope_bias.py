"""A gyroscope bias that is too large for a first guess of zero: found from standstill, or from the course.

A raw MEMS unit may turn by several degrees a second at rest. Integrated for a minute that is a wrong heading, and the
optimiser does not come back from it. So what exceeds any calibrated unit is taken out of the samples before.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import cumulative_trapezoid

from factor_graphs.at_rest import Windows
from factor_graphs.chi_square import BEYOND_DOUBT
from factor_graphs.measurements import GnssFixes, ImuSamples

Array = NDArray[np.float64]

# A bias below this, rad/s (0.6 deg/s), the graph finds by itself; above the second no gyroscope is of use.
NOTABLE, LARGEST = 0.01, 0.2
# Biases are tried in steps of so much, rad/s, then about the best of them: a window shows 1 / WINDOW_S.
COARSE, STEP = 2e-3, 5e-4
# The course is that of the way from one fix to another, so many s later, and at least so many rad off the heading;
# over so many s a bias hardly changes.
CHORD_S, LEAST_COURSE_STDDEV, WINDOW_S = 2.0, 0.05, 100.0
# A bias is better than another when its log-likelihood is so much larger, 5 standard deviations; and the gyroscope
# turns with the vehicle when at least this share of what the courses can tell agrees.
SURELY, AGREEING = BEYOND_DOUBT**2 / 2, 0.5
# A second of standstill: the IMU is about as quiet as in its quietest tenth, and the fixes stay within so many standard
# deviations. So many of them are believed, if half of them are within so many rad/s: what
# stands turns at one rate.
STAYING, LEAST_STANDING, STEADY = 3.0, 5, 3e-3
# A mean specific force beyond these, m/s², is no gravity, and does not tell what is up.
LEAST_FORCE, MOST_FORCE = 5.0, 20.0
TINY = 1e-12


def large_gyroscope_bias(imu: ImuSamples, fixes: GnssFixes) -> Array:
    """The bias (3,) rad/s about the imu's axes, or zero where it is no larger than usual, or the drive hides it.

    Of standstill, if what it says agrees with the course; else about the vertical the one with which the gyroscope
    follows the course best, and none in the mean about the horizontal axes: a vehicle keeps its wheels on the ground.
    """
    nothing, fixes = np.zeros(3), fixes[(fixes.stamps >= imu.stamps[0]) & (fixes.stamps <= imu.stamps[-1])]
    force = imu.specific_force.mean(axis=0)
    up = force / max(float(np.linalg.norm(force)), TINY)
    if len(fixes) < 3 or not LEAST_FORCE < np.linalg.norm(force) < MOST_FORCE:
        return nothing
    rest = _at_rest(imu, fixes)
    courses = _Courses.of(imu, fixes, up)
    best, bias = 0.0, 0.0
    for step, farthest in ((COARSE, LARGEST), (STEP, COARSE)):
        biases = bias + np.arange(-farthest, farthest + step, step)
        best, bias = max((courses.log_likelihood(one), one) for one in biases.tolist())
    if rest is not None and courses.log_likelihood(float(up @ rest)) > best - SURELY:
        return _if_large(rest)
    if best < max(AGREEING * courses.most, courses.log_likelihood(0.0) + SURELY):
        return nothing
    mean = imu.angular_rate.mean(axis=0)
    return _if_large(bias * up + mean - (up @ mean) * up)


@dataclass(frozen=True, eq=False)
class _Courses:
    """How far the course is from what the gyroscope turned, at `stamps` (n,) s, with the weight of each.

    As numbers of the complex plane, with twice the angle: so it is the same forward and in reverse.
    """

    stamps: Array
    doubled: NDArray[np.complex128]

    @classmethod
    def of(cls, imu: ImuSamples, fixes: GnssFixes, up: Array) -> "_Courses":
        """Of the fixes; `up` (3,) is the vertical in the axes of the imu."""
        stamps, ways, stddevs = _ways(fixes)
        turned = np.interp(
            stamps, imu.stamps, cumulative_trapezoid(imu.angular_rate @ up, imu.stamps, initial=0)
        )
        of_course = np.maximum(stddevs / np.maximum(np.abs(ways), TINY), LEAST_COURSE_STDDEV)
        # concentration of twice the angle (von Mises); one fix is in several ways
        weights = (
            1 / (4 * of_course**2) / max(len(ways) * CHORD_S / max(float(np.ptp(fixes.stamps)), TINY), 1.0)
        )
        return cls(stamps, weights * np.exp(2j * (np.angle(ways) - turned)))

    @property
    def most(self) -> float:
        """The log-likelihood, were all courses as the gyroscope says."""
        return float(np.abs(self.doubled).sum())

    def log_likelihood(self, bias: float) -> float:
        """Of a bias about the vertical, rad/s, at the best heading in every window."""
        if not len(self.stamps):
            return 0.0
        window = ((self.stamps - self.stamps[0]) / WINDOW_S).astype(int)
        turned = self.doubled * np.exp(2j * bias * self.stamps)
        return float(np.hypot(np.bincount(window, turned.real), np.bincount(window, turned.imag)).sum())


def _if_large(bias: Array) -> Array:
    return bias if NOTABLE < np.abs(bias).max() < LARGEST else np.zeros(3)


def _ways(fixes: GnssFixes) -> tuple[Array, NDArray[np.complex128], Array]:
    """From fix to fix: the middle of the time (n,) s, the way as a complex number, m, and its standard deviation, m."""
    first = np.arange(len(fixes))
    last = np.searchsorted(fixes.stamps, fixes.stamps + CHORD_S)
    first, last = first[last < len(fixes)], last[last < len(fixes)]
    near = fixes.stamps[last] - fixes.stamps[first] < 2 * CHORD_S
    first, last = first[near], last[near]
    way = fixes.positions[last] - fixes.positions[first]
    variances = (fixes.stddevs[:, :2] ** 2).mean(axis=1)
    stddevs = np.sqrt(variances[first] + variances[last])
    return (fixes.stamps[first] + fixes.stamps[last]) / 2, way[:, 0] + 1j * way[:, 1], stddevs


def _at_rest(imu: ImuSamples, fixes: GnssFixes) -> Array | None:
    """The median rate (3,) of the seconds in which the vehicle stands; None for less than a few of them."""
    seconds = Windows.of(imu)
    quiet, rates = seconds.quiet(0.1), seconds.rate
    stamps = np.arange(len(quiet)) + imu.stamps[0] + 0.5
    middles, ways, stddevs = _ways(fixes)
    if not len(ways):
        return None
    still = quiet & (np.interp(stamps, middles, np.abs(ways) / stddevs, left=np.inf, right=np.inf) < STAYING)
    if still.sum() < LEAST_STANDING:
        return None
    rate = np.median(rates[still], axis=0)
    is_one = np.median(np.abs(rates[still] - rate).max(axis=1)) < STEADY
    return np.asarray(rate) if is_one else None
