"""Is it a wheeled vehicle? Mounting of the IMU, the axle that does not slide, and slip, seen in a solution.

A point on the axle moves along the vehicle and nowhere else (non-holonomic constraint). In the imu's axes
v_y = a v_x + l w_z + c |v_x| v_x w_z and v_z = b v_x, up to slip: a and b are the slopes of the direction of travel,
l is how far the IMU sits ahead of the axle, and c the angle at which tyres roll under lateral acceleration v_x w_z.
Going backwards changes the sign of v_x and nothing else.
"""

from dataclasses import dataclass, replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import M
from numpy.typing import NDArray
from scipy.optimize import nnls

from factor_graphs.chi_square import probability_below
from factor_graphs.graph import from_values
from factor_graphs.intervals import ImuIntervals
from factor_graphs.problem import Fit, Problem

Array = NDArray[np.float64]

# Before anything is seen: slopes (about rad) of the direction of travel, distance to the axle m, rad per m/s².
MOUNTING_STDDEVS = np.array([0.2, 0.2, 3.0, 0.01])
# Slower than this, m/s, the direction of travel is not seen; seen for less long, s, or less far, m, it is not known.
MOVING_SPEED, LEAST_TIME_S, LEAST_WAY_M = 2.0, 30.0, 200.0
# What slides more than this share of its speed, or looks farther off its course, is no vehicle with an IMU on it.
MOST_SLIP, MOST_SLOPE = 0.05, 0.3
# Slip is never believed to be less, m/s; where it was not seen, it may be this.
LEAST_SLIP, UNSEEN_SLIP = 0.03, 0.1
# Slip lasts so long, s.
SLIP_CORRELATION_S = 2.0
# Yaw rate is the mean over so long: a single sample is noise.
RATE_WINDOW_S = 0.1
# Huber's loss for mounting, and where the residuals of slip are cut, in standard deviations.
HUBER, CUT, ROUNDS = 1.345, 2.5, 10
KEPT_VARIANCE = probability_below(CUT**2, 3) + CUT**2 * (1 - probability_below(CUT**2, 1))


@dataclass(frozen=True, eq=False)
class BodyMotion:
    """Motion at keyframes, in the imu's axes: `velocity` (k, 3) m/s, `yaw_rate` (k,) rad/s.

    `R_imu_map` (k, 3, 3) turns to these axes; `spacing` (k,) s is the time that each keyframe stands for.
    """

    R_imu_map: Array
    velocity: Array
    yaw_rate: Array
    spacing: Array

    def __getitem__(self, rows: NDArray[np.bool_]) -> "BodyMotion":
        return BodyMotion(self.R_imu_map[rows], self.velocity[rows], self.yaw_rate[rows], self.spacing[rows])

    def sliding(self, mounting: Array) -> Array:
        """Velocity of the axle across the direction of travel: lateral and vertical, (k, 2) m/s."""
        across: Array = self.velocity[:, 1:] - self.by_mounting() @ mounting
        return across

    def by_velocity(self, mounting: Array) -> Array:
        """How `sliding` changes with the velocity in the imu's axes, (k, 2, 3)."""
        rows = np.tile([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], (len(self.velocity), 1, 1))
        rows[:, 0, 0] = -mounting[0] - 2 * mounting[3] * np.abs(self.velocity[:, 0]) * self.yaw_rate
        rows[:, 1, 0] = -mounting[1]
        return rows

    def by_mounting(self) -> Array:
        """Lateral and vertical velocity of a body that does not slide, by its mounting, (k, 2, 4)."""
        ahead, rows = self.velocity[:, 0], np.zeros((len(self.velocity), 2, 4))
        rows[:, 0, 0] = rows[:, 1, 1] = ahead
        rows[:, 0, 2], rows[:, 0, 3] = self.yaw_rate, np.abs(ahead) * ahead * self.yaw_rate
        return rows

    def grows_with(self) -> Array:
        """What the variance of slip is made of: a constant, speed squared, lateral acceleration squared, (k, 3)."""
        speed = self.velocity[:, 0]
        return np.column_stack([np.ones(len(speed)), speed**2, (speed * self.yaw_rate) ** 2])


@dataclass(frozen=True, eq=False)
class Vehicle:
    """How the IMU sits on the vehicle, and how much the axle slides.

    `mounting` (3,): slopes of the direction of travel in the imu's axes, to the left and upwards, and how far the IMU is
    ahead of the axle, m; `stddevs` (3,) are its standard deviations. `slip` (2, 3): variance of the lateral and the
    vertical velocity of the axle by `BodyMotion.grows_with`. `doubt` says why it is no such vehicle, or nothing.
    """

    mounting: Array
    slip: Array
    typical_slip: Array
    doubt: str = ""
    held: bool = False
    stddevs: Array | None = None

    def slip_stddevs(self, motion: BodyMotion) -> Array:
        """Standard deviation of the lateral and vertical row of every keyframe, (k, 2) m/s.

        Slip lasts, so keyframes closer than its correlation time share what one of them knows.
        """
        alike = np.maximum(1.0, SLIP_CORRELATION_S / motion.spacing)
        stddevs: Array = np.sqrt(motion.grows_with() @ self.slip.T * alike[:, None])
        return stddevs

    @property
    def yaw_pitch_deg(self) -> Array:
        """Yaw (to the left) and pitch (nose down) of the IMU against the direction of travel, (2,) degrees."""
        return np.degrees(np.arctan([-self.mounting[0], self.mounting[1]]))

    def __str__(self) -> str:
        (yaw, pitch), (lateral, vertical) = self.yaw_pitch_deg, self.typical_slip
        return (
            f"the axle slides {lateral:.2f} m/s sideways, {vertical:.2f} m/s vertically; the IMU looks {yaw:+.2f}° left, "
            f"{pitch:+.2f}° down, {self.mounting[2]:+.1f} m ahead of the axle"
        )


def body_motion(problem: Problem, fit: Fit) -> BodyMotion:
    """The motion at the keyframes of a solution."""
    stamps = problem.intervals.keyframes
    T, velocities, biases = from_values(fit.values, len(stamps))
    R_imu_map = np.swapaxes(T[:, :3, :3], 1, 2)
    return BodyMotion(
        R_imu_map=R_imu_map,
        velocity=(R_imu_map @ velocities[:, :, None])[:, :, 0],
        yaw_rate=_yaw_rate(problem.intervals) - biases[:, 5],
        spacing=np.gradient(stamps),
    )


def with_mounting(problem: Problem, fit: Fit, mounting: Array) -> Fit:
    """The same solution with the mounting (3,) among its values."""
    values, key = gtsam.Values(fit.values), M(len(problem.intervals.keyframes))
    if values.exists(key):
        values.update(key, mounting)
    else:
        values.insert(key, mounting)
    return replace(fit, values=values)


def observe(problem: Problem, fit: Fit, motion: BodyMotion) -> Vehicle:
    """The vehicle that a solution shows, where it is well determined: moving, and beside a fix that fits."""
    seen = _beside_fixes(problem, fit) & (np.linalg.norm(motion.velocity, axis=1) > MOVING_SPEED)
    motion = motion[seen]
    if doubt := _too_little(motion):
        return Vehicle(
            np.zeros(4), np.tile([UNSEEN_SLIP**2, 0.0, 0.0], (2, 1)), np.full(2, UNSEEN_SLIP), doubt
        )
    mounting, by_mounting, by_slip = np.zeros(4), motion.by_mounting(), motion.grows_with()
    slip = np.empty((2, 3))
    for row, of_row in enumerate(([0, 2, 3], [1])):
        mounting[of_row], slip[row] = _robust_fit(
            by_mounting[:, row, of_row], motion.velocity[:, 1 + row], by_slip, motion.spacing, MOUNTING_STDDEVS[of_row]
        )
    typical = np.sqrt(np.average(by_slip @ slip.T, axis=0, weights=motion.spacing))
    return Vehicle(mounting, slip, typical, _doubt(mounting[:2], typical, motion))


def _too_little(motion: BodyMotion) -> str:
    way = float(np.linalg.norm(motion.velocity, axis=1) @ motion.spacing)
    if motion.spacing.sum() < LEAST_TIME_S or way < LEAST_WAY_M:
        return f"it is seen to move for {motion.spacing.sum():.0f} s and {way:.0f} m only"
    return ""


def _doubt(slopes: Array, slip: Array, motion: BodyMotion) -> str:
    """Why what moves is not a vehicle that rolls forward on wheels; empty when it is."""
    speed = np.sqrt(np.mean(np.sum(motion.velocity**2, axis=1)))
    if np.sum(motion.velocity[:, 0] > 0) < 0.5 * len(motion.velocity) or np.abs(slopes).max() > MOST_SLOPE:
        return "the IMU does not look where it goes"
    if slip.max() > MOST_SLIP * speed:
        lateral, vertical = 100 * slip / speed
        return f"it slides {lateral:.0f} % of its speed sideways, {vertical:.0f} % vertically"
    return ""


def _robust_fit(A: Array, y: Array, by_slip: Array, weights: Array, stddevs: Array) -> tuple[Array, Array]:
    """Parameters x of y = A x + slip, and the parts of the variance of slip, each from the other in turn.

    `A` (k, n), `y` (k,), `by_slip` (k, 3), `weights` (k,); `stddevs` (n,) is what x may be at all.
    """
    x, slip = np.zeros(A.shape[1]), np.zeros(by_slip.shape[1])
    variance = np.full(len(y), max(_robust_stddev(y), LEAST_SLIP) ** 2)
    for _ in range(ROUNDS):
        off = (y - A @ x) / np.sqrt(variance)
        weight = weights / variance * np.minimum(1.0, HUBER / np.maximum(np.abs(off), 1e-12))
        x = np.linalg.solve((A.T * weight) @ A + np.diag(stddevs**-2), (A.T * weight) @ y)
        squares = np.minimum((y - A @ x) ** 2, CUT**2 * variance) / KEPT_VARIANCE
        scale = np.sqrt(weights) / variance
        slip = nnls(by_slip * scale[:, None], squares * scale)[0]
        slip[0] = max(slip[0], LEAST_SLIP**2)
        variance = by_slip @ slip
    return x, slip


def _robust_stddev(values: Array) -> float:
    return 1.4826 * float(np.median(np.abs(values - np.median(values))))


def _beside_fixes(problem: Problem, fit: Fit) -> NDArray[np.bool_]:
    """The keyframes (k,) beside a fix that fits, not in an outage: as far as fixes are usually apart."""
    stamps, good = problem.intervals.keyframes, problem.at[fit.weights > 0.5]
    if len(good) < 2:
        return np.zeros(len(stamps), dtype=bool)
    usual = 1.5 * max(float(np.median(np.diff(stamps[good]))), float(np.median(np.diff(stamps))))
    after = np.searchsorted(good, np.arange(len(stamps))).clip(max=len(good) - 1)
    nearest = np.minimum(
        np.abs(stamps[good[after]] - stamps), np.abs(stamps[good[np.maximum(after - 1, 0)]] - stamps)
    )
    return nearest <= usual


def _yaw_rate(intervals: ImuIntervals) -> Array:
    """What the gyroscope says about the imu's z axis around every keyframe, (k,) rad/s."""
    turned = np.concatenate([[0.0], np.cumsum(intervals.angular_rate[:, 2] * intervals.durations)])
    first = np.maximum(intervals.keyframes - RATE_WINDOW_S / 2, intervals.nodes[0])
    last = np.minimum(intervals.keyframes + RATE_WINDOW_S / 2, intervals.nodes[-1])
    return (np.interp(last, intervals.nodes, turned) - np.interp(first, intervals.nodes, turned)) / (
        last - first
    )
