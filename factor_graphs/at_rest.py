"""When an IMU, and the vehicle that it is on, is at rest: by its own scatter, by its means, and by the fixes."""

import numpy as np
from scipy.spatial.transform import Rotation

from factor_graphs.arrays import Array, Mask, Rows
from factor_graphs.chi_square import BEYOND_DOUBT, NEVER_ZERO
from factor_graphs.errors import MeasurementError
from factor_graphs.intervals import ImuIntervals
from factor_graphs.measurements import GnssFixes, ImuSamples
from factor_graphs.stamps import gaps

# What scatters no more than so many times as in the quietest parts may stand: those are a share of all, in a drive and
# in a record at rest. Windows of a slow IMU are longer: the scatter of fewer samples is twice as large by chance.
QUIET, QUIETEST_OF_DRIVE, QUIETEST, FEWEST_IN_WINDOW = 2.0, 0.1, 0.02, 50
# A vehicle that stands is slower than the first, m/s; slower than the second, it may stand or creep. Fixes of one that
# stands wander a little, m/s.
STANDING_SPEED, CREEPING_SPEED, CREEP = 0.3, 0.6, 0.05
# It turns on the spot when it turns faster than this, rad/s, which no left-over bias does, and by more than noise.
TURNING_RATE = 1e-3
# A record at rest is this long, s, or longer. Over so many parts of it, mean specific force, m/s², and angular rate,
# rad/s, stay within these: a bias that warms up does, a vehicle, whose road has slopes, does not.
LEAST_SPAN_S, PARTS = 60.0, 10
STEADY_FORCE, STEADY_RATE = 0.1, 0.01
# Gravity on Earth is within this share of 9.81 m/s², any accelerometer's bias included.
GRAVITY, OFF_GRAVITY = 9.81, 0.1
# The middle nine tenths of the steps of the stamps differ by less than this share of a step.
STEADY_STEPS = 0.5


def windows(imu: ImuSamples, length_s: float = 1.0) -> Rows:
    """The window (n,) of each sample, from the first stamp on."""
    return np.asarray((imu.stamps - imu.stamps[0]) / length_s, np.intp)


def means_of(part: Rows, values: Array) -> Array:
    """Means (p, c) of values (n, c) by the part (n,) that each belongs to; zero of one without any."""
    sums = np.column_stack([np.bincount(part, column) for column in values.T])
    return np.asarray(sums / np.maximum(np.bincount(part), 1)[:, None])


def are_quiet(part: Rows, force: Array, rate: Array, share: float, usable: Mask | None = None) -> Mask:
    """The parts (p,) in which both sensors (n, 3) scatter little against that share of all.

    `part` (n,) is that of each sample. By default, parts that are half as long as the longest are usable. Values
    scatter by their resolution at least.
    """
    count = np.bincount(part)
    usable = count > count.max() / 2 if usable is None else usable
    quiet = usable.copy()
    for values in (force, rate):
        off = values - means_of(part, values)[part]
        scatter = np.sqrt(means_of(part, off**2).sum(axis=1) + _resolution(values) ** 2)
        quiet &= scatter <= QUIET * np.quantile(scatter[usable], share)
    return np.asarray(quiet)


def quiet_intervals(intervals: ImuIntervals) -> Mask:
    """The intervals (k - 1,) between keyframes in which the IMU is as quiet as in a vehicle that stands."""
    part = np.repeat(np.arange(len(intervals.blind)), np.diff(intervals.bounds))
    return are_quiet(
        part, intervals.specific_force, intervals.angular_rate, QUIETEST_OF_DRIVE, ~intervals.blind
    )


def _resolution(values: Array) -> float:
    """The smallest change from one sample to the next; zero of a constant."""
    changes = np.abs(np.diff(values, axis=0))
    return float(changes.min(where=changes > 0, initial=np.inf)) if changes.any() else 0.0


def standing(quiet: Mask, velocities: Array, speed_mps: float = STANDING_SPEED) -> Mask:
    """The keyframes at which the vehicle stands, (k,): slow there, and the IMU quiet on both sides."""
    slow = np.linalg.norm(velocities, axis=1) < speed_mps
    still: Mask = slow & np.append(quiet, True) & np.append(True, quiet)
    return still


def creeping(slow: Mask, fixes: GnssFixes, at: Rows) -> Mask:
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
        creeps |= np.abs(speed) > CREEP + BEYOND_DOUBT / np.sqrt(spread)
    creeps[0] = False
    crept: Mask = creeps[which]
    return crept


def resting(stands: Mask, R_map_imu: Array, stamps: Array, gyroscope_noise_density: float) -> Mask:
    """The intervals (k - 1,) between keyframes of one stop in which the vehicle does not turn on the spot either.

    A robot or a tripod that turns at one rate is as quiet as one that stands, so the whole stop must not turn.
    """
    begins = stands & ~np.append(False, stands[:-1])
    stop = np.cumsum(begins) * stands
    first = np.append(0, np.flatnonzero(begins))[stop]
    turned = np.swapaxes(R_map_imu[first], 1, 2) @ R_map_imu
    angles, lasted = Rotation.from_matrix(turned).magnitude(), stamps - stamps[first]
    turns = stands & (
        angles > TURNING_RATE * lasted + BEYOND_DOUBT * gyroscope_noise_density * np.sqrt(3 * lasted)
    )
    rests = stands & (np.bincount(stop, turns) == 0)[stop]
    within: Mask = rests[1:] & rests[:-1]
    return within


def _sums(which: Rows, values: Array, n: int) -> Array:
    """Sums of values by group, (n,), never zero: they are divided by."""
    return np.maximum(np.bincount(which, values, n), NEVER_ZERO)


def span_at_rest(imu: ImuSamples) -> ImuSamples:
    """The longest part of samples in which the IMU is at rest, without gaps and evenly sampled.

    Raises MeasurementError where there is none of a minute: for what moves, for gaps, and for stamps that vary.
    """
    least, most = np.quantile(np.diff(imu.stamps), (0.05, 0.95))
    if most - least > STEADY_STEPS * (step := float(np.median(np.diff(imu.stamps)))):
        raise MeasurementError(
            f"sampling varies: steps of {1e3 * least:.2f} to {1e3 * most:.2f} ms, usually {1e3 * step:.2f}; expected"
            " even ones: are these times of arrival, or of a sensor that changed its rate?"
        )
    samples = _longest_run(imu)
    span = float(np.ptp(samples.stamps))
    if span < LEAST_SPAN_S:
        raise MeasurementError(
            f"the IMU is at rest, without gaps, for {span:.0f} s at most of {np.ptp(imu.stamps):.0f} s, expected"
            f" {LEAST_SPAN_S:.0f} s or more (an hour is usual): record it while nothing moves it"
        )
    if moved := _moved(samples):
        raise MeasurementError(f"the IMU moves: {moved}; record it while nothing moves it, best for an hour")
    force = float(np.linalg.norm(samples.specific_force.mean(axis=0)))
    if abs(force - GRAVITY) > OFF_GRAVITY * GRAVITY:
        raise MeasurementError(
            f"the specific force at rest is {force:.3g} m/s², expected gravity, {GRAVITY}: set its unit (force_unit)"
        )
    return samples


def _longest_run(imu: ImuSamples) -> ImuSamples:
    """The samples of the longest run of quiet windows that no gap interrupts."""
    length_s = max(1.0, FEWEST_IN_WINDOW * float(np.median(np.diff(imu.stamps))))
    window = windows(imu, length_s)
    breaks = np.searchsorted(imu.stamps, gaps(imu.stamps)[:, 1])
    after_gap = np.zeros(len(imu), np.intp)
    after_gap[breaks] = 1
    good = are_quiet(window, imu.specific_force, imu.angular_rate, QUIETEST)[window]
    run = np.cumsum(after_gap + np.append(False, good[1:] != good[:-1]))
    sizes = np.bincount(run, good)
    return imu[run == sizes.argmax()]


def _moved(samples: ImuSamples) -> str:
    """How it moves, in words; empty at rest."""
    for what, unit, values, steady in (
        ("mean specific force", "m/s²", samples.specific_force, STEADY_FORCE),
        ("mean angular rate", "rad/s", samples.angular_rate, STEADY_RATE),
    ):
        means = np.array([part.mean(axis=0) for part in np.array_split(values, PARTS)])
        noise = values.std(axis=0).max() / np.sqrt(len(samples) / PARTS)
        if (change := float(np.ptp(means, axis=0).max())) > steady + BEYOND_DOUBT * noise:
            return f"its {what} changes by {change:.2g} {unit} within {np.ptp(samples.stamps):.0f} s"
    return ""
