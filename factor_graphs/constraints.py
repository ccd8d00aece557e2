"""What a road vehicle cannot do: slide sideways, lift off, or move while it stands."""

from collections.abc import Iterator

import gtsam
import numpy as np
from gtsam.symbol_shorthand import M
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from factor_graphs.intervals import ImuIntervals
from factor_graphs.measurements import GnssFixes
from factor_graphs.model import BodyVelocities, body_velocity_factors
from factor_graphs.vehicle import MOUNTING_STDDEVS, BodyMotion

Array = NDArray[np.float64]

# A vehicle that stands: slower than this, m/s, and its IMU not much noisier than in its quietest tenth.
STANDING_SPEED, QUIET = 0.3, 2.0
# It creeps when its fixes go faster than the first, m/s, by so many standard deviations: fixes of a vehicle that stands
# wander a little. Slower than the last, m/s, it may stand or creep.
CREEP, SURELY, CREEPING_SPEED = 0.05, 4.0, 0.6
# It turns on the spot when it turns faster than this, rad/s, which no left-over bias does, and by more than noise.
TURNING_RATE = 1e-3


def non_holonomic_factors(
    values: gtsam.Values, motion: BodyMotion, stddevs: Array
) -> Iterator[gtsam.NonlinearFactor]:
    """The axle slides by `stddevs` (k, 2) m/s, lateral and vertical, linearised at `values`, which `motion` is of.

    The mounting, M(k), is one unknown of all rows, and has a prior.
    """
    k = len(stddevs)
    mounting = values.atVector(M(k))
    by_state = motion.by_state(motion.by_velocity(mounting))
    known = BodyVelocities(np.arange(k), motion.sliding(mounting), by_state, -motion.by_mounting(), stddevs)
    return body_velocity_factors(values, known, M(k), np.zeros(5), MOUNTING_STDDEVS)


def standing(
    quiet: NDArray[np.bool_], velocities: Array, speed_mps: float = STANDING_SPEED
) -> NDArray[np.bool_]:
    """The keyframes at which the vehicle stands, (k,): slow there, and the IMU quiet on both sides."""
    slow = np.linalg.norm(velocities, axis=1) < speed_mps
    still: NDArray[np.bool_] = slow & np.append(quiet, True) & np.append(True, quiet)
    return still


def creeping(slow: NDArray[np.bool_], fixes: GnssFixes, at: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Of the keyframes (k,) that may stand, those of a time in which the fixes, at keyframes `at` (m,), go on.

    A boat, a lift or a train may be as quiet while it moves. A straight line through the fixes of such a time tells how
    fast they go, and how surely.
    """
    which = np.cumsum(slow & ~np.append(False, slow[:-1])) * slow
    stand, k = which[at], which.max(initial=0) + 1
    creeps = np.zeros(k, dtype=bool)
    for place, stddev in zip(fixes.positions.T, fixes.stddevs.T, strict=True):
        w = stddev**-2
        t, y = (
            values - (np.bincount(stand, w * values, k) / _sums(stand, w, k))[stand]
            for values in (fixes.stamps, place)
        )
        spread = _sums(stand, w * t**2, k)
        speed = np.bincount(stand, w * t * y, k) / spread
        creeps |= np.abs(speed) > CREEP + SURELY / np.sqrt(spread)
    creeps[0] = False
    crept: NDArray[np.bool_] = creeps[which]
    return crept


def resting(
    stands: NDArray[np.bool_], R_map_imu: Array, stamps: Array, gyroscope_noise_density: float
) -> NDArray[np.bool_]:
    """The intervals (k - 1,) between keyframes of one stop in which the vehicle does not turn on the spot either.

    A robot or a tripod that turns at one rate is as quiet as one that stands, so the whole stop must not turn.
    """
    begins = stands & ~np.append(False, stands[:-1])
    stop = np.cumsum(begins) * stands
    first = np.append(0, np.flatnonzero(begins))[stop]
    turned = np.swapaxes(R_map_imu[first], 1, 2) @ R_map_imu
    angles, lasted = Rotation.from_matrix(turned).magnitude(), stamps - stamps[first]
    turns = stands & (angles > TURNING_RATE * lasted + SURELY * gyroscope_noise_density * np.sqrt(3 * lasted))
    rests = stands & (np.bincount(stop, turns) == 0)[stop]
    within: NDArray[np.bool_] = rests[1:] & rests[:-1]
    return within


def _sums(which: NDArray[np.intp], values: Array, n: int) -> Array:
    """Sums of values by group, (n,), never zero: they are divided by."""
    return np.maximum(np.bincount(which, values, n), 1e-12)


def quiet_intervals(intervals: ImuIntervals) -> NDArray[np.bool_]:
    """The intervals (k - 1,) in which the IMU is as quiet as in a vehicle that stands."""
    which = np.repeat(np.arange(len(intervals.keyframes) - 1), np.diff(intervals.bounds))
    quiet = ~intervals.blind
    for samples in (intervals.specific_force, intervals.angular_rate):
        scatter = _scatter(samples, which, len(quiet))
        quiet &= scatter <= QUIET * np.quantile(scatter, 0.1)
    return quiet


def _scatter(samples: Array, which: NDArray[np.intp], n: int) -> Array:
    """Standard deviation of the samples within every interval, all axes together, (n,)."""
    count = np.maximum(np.bincount(which, minlength=n), 1)
    variance = np.zeros(n)
    for column in samples.T:
        mean = np.bincount(which, column, n) / count
        variance += np.bincount(which, (column - mean[which]) ** 2, n) / count
    scatter: Array = np.sqrt(variance)
    return scatter
