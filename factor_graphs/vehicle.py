"""Is it a wheeled vehicle? How the IMU sits on it, and how much its axle slides, as a solution shows them.

A point on the axle moves along the vehicle and nowhere else (non-holonomic constraint). In the imu's axes
v_y = a v_x + l w_z - h w_x + c |v_x| v_x w_z and v_z = b v_x - l w_y, up to slip: a and b are the slopes of the
direction of travel, l and h how far the IMU sits ahead of the axle and above it (on a roof, the body's roll swings it),
and c the angle at which tyres roll under lateral acceleration v_x w_z.
Going backwards changes the sign of v_x and nothing else.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from factor_graphs.intervals import nearest
from factor_graphs.model import from_values
from factor_graphs.problem import Fit, Problem
from factor_graphs.slip import LEAST_LASTING_S, Slip, explain, robust_stddev

Array = NDArray[np.float64]

# Before anything is seen: slopes (about rad) of the direction of travel, distance to the axle m, rad per m/s², height m
MOUNTING_STDDEVS = np.array([0.2, 0.2, 3.0, 0.01, 2.0])
# What of the mounting is found by motion sideways, and what then by motion upwards.
SIDEWAYS, UPWARDS = [0, 2, 3, 4], [1]
# Slower than this, m/s, the direction of travel is not seen; seen for less long, s, or less far, m, it is not known.
MOVING_SPEED, LEAST_TIME_S, LEAST_WAY_M = 2.0, 30.0, 200.0
# What slides more than this share of its speed, or looks farther off its course, is no vehicle with an IMU on it.
MOST_SLIP, MOST_SLOPE = 0.04, 0.3
# Farther than this from a fix, s, a solution is too uncertain to show slip.
BESIDE_S = 2.0
# Slip, m/s, of what was not seen to slide.
UNSEEN_SLIP = 0.1
# A skid is so many times less certain than it is fast.
SKID = 3.0


@dataclass(frozen=True, eq=False)
class BodyMotion:
    """Motion at keyframes, in the imu's axes: `velocity` (k, 3) m/s, `rates` (k, 3) rad/s.

    `R_imu_map` (k, 3, 3) turns to these axes; `spacing` (k,) s is the time that each keyframe stands for.
    """

    R_imu_map: Array
    velocity: Array
    rates: Array
    spacing: Array

    @property
    def yaw_rate(self) -> Array:
        """About the imu's z axis, (k,) rad/s."""
        return np.asarray(self.rates[:, 2])

    def __getitem__(self, rows: NDArray[np.bool_]) -> "BodyMotion":
        return BodyMotion(self.R_imu_map[rows], self.velocity[rows], self.rates[rows], self.spacing[rows])

    def sliding(self, mounting: Array) -> Array:
        """Lateral and vertical velocity that the mounting (5,) does not explain, (k, 2) m/s."""
        left: Array = self.velocity[:, 1:] - self.by_mounting() @ mounting
        return left

    def by_mounting(self) -> Array:
        """Lateral and vertical velocity of an imu whose axle does not slide, by its mounting, (k, 2, 5)."""
        ahead, rows = self.velocity[:, 0], np.zeros((len(self.velocity), 2, 5))
        rows[:, 0, 0] = rows[:, 1, 1] = ahead
        rows[:, 0, 2], rows[:, 0, 3] = self.yaw_rate, np.abs(ahead) * ahead * self.yaw_rate
        rows[:, 0, 4], rows[:, 1, 2] = -self.rates[:, 0], -self.rates[:, 1]
        return rows

    def by_velocity(self, mounting: Array) -> Array:
        """Jacobian of `sliding` by the velocity in the imu's axes, (k, 2, 3)."""
        rows = np.tile([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], (len(self.velocity), 1, 1))
        rows[:, 0, 0] = -mounting[0] - 2 * mounting[3] * np.abs(self.velocity[:, 0]) * self.yaw_rate
        rows[:, 1, 0] = -mounting[1]
        return rows

    def by_state(self, by_velocity: Array) -> Array:
        """Jacobian (k, r, 9) by the tangent of the pose and the velocity in the map, of what has this one (k, r, 3).

        `by_velocity` is by the velocity in the imu's axes. With v_imu = Rᵀ v and R perturbed on the right,
        d v_imu = [v_imu]× dθ + Rᵀ dv.
        """
        rows = np.zeros((*by_velocity.shape[:2], 9))
        rows[:, :, :3] = np.cross(by_velocity, self.velocity[:, None])
        rows[:, :, 6:] = by_velocity @ self.R_imu_map
        return rows

    def ahead(self, mounting: Array) -> Array:
        """Forward speed of a point on the axle (k,) m/s: as the body pitches, an imu above it swings to and fro."""
        speed: Array = self.velocity @ direction(mounting) - mounting[4] * self.rates[:, 1]
        return speed

    def grows_with(self) -> Array:
        """What the variance of slip grows with: nothing, speed squared, lateral acceleration squared, (k, 3)."""
        speed = self.velocity[:, 0]
        return np.column_stack([np.ones(len(speed)), speed**2, (speed * self.yaw_rate) ** 2])


@dataclass(frozen=True, eq=False)
class Vehicle:
    """How the IMU sits on the vehicle, and how much the axle slides.

    `mounting` (5,): slopes of the direction of travel in the imu's axes, to the left and upwards; how far the IMU is
    ahead of the axle, m; angle of the tyres, rad per m/s²; how far it is above the axle, m. `mounting_stddevs` (5,)
    once it was part of a graph. `slip`: lateral and vertical; `skids` (k, 2) m/s: what does not fit it, zero where all
    fits. `doubt`: why it is no such vehicle, or nothing. `held`: the constraint is on.
    """

    mounting: Array
    slip: tuple[Slip, Slip]
    skids: Array
    doubt: str = ""
    held: bool = False
    mounting_stddevs: Array | None = None

    @property
    def yaw_pitch_deg(self) -> Array:
        """Yaw (to the left) and pitch (nose down) of the IMU against the direction of travel, (2,) degrees."""
        return np.asarray(np.degrees(np.arctan([-self.mounting[0], self.mounting[1]])), np.float64)

    @property
    def typical_slip(self) -> Array:
        """Lateral and vertical slip, (2,) m/s."""
        return np.array([one.typical for one in self.slip])

    @property
    def density(self) -> Array:
        """Density of lateral and vertical slip, (2,) m/s/√Hz: what counts over a time much longer than it lasts."""
        return self.typical_slip * np.sqrt([one.lasting_s for one in self.slip])

    @property
    def verdict(self) -> str:
        """Whether the constraint takes part, and why or how, in one line."""
        if not self.held:
            return f"vehicle constraint off: {self.doubt}"
        return f"vehicle constraint on: {self}" + (f"; in doubt, as {self.doubt}" if self.doubt else "")

    def slip_stddevs(self, motion: BodyMotion) -> Array:
        """Standard deviation of lateral and vertical slip at every keyframe, (k, 2) m/s."""
        usual = np.column_stack([one.stddevs(motion.grows_with(), motion.spacing) for one in self.slip])
        # where it skids it says nothing of its heading: so uncertain that it hardly counts
        return np.asarray(np.hypot(usual, SKID * self.skids), np.float64)

    def __str__(self) -> str:
        (yaw, pitch), (lateral, vertical) = self.yaw_pitch_deg, self.typical_slip
        unsure = [""] * 4
        if self.mounting_stddevs is not None:
            of_yaw, of_pitch = np.degrees(self.mounting_stddevs[:2] / (1 + self.mounting[:2] ** 2))
            of_place = self.mounting_stddevs[[2, 4]]
            unsure = [f" ± {of:.2f}" for of in (of_yaw, of_pitch)] + [f" ± {of:.1f}" for of in of_place]
        return (
            f"slip {lateral:.2f} m/s sideways, {vertical:.2f} m/s vertically; IMU mounted {yaw:+.2f}{unsure[0]}° in"
            f" yaw, {pitch:+.2f}{unsure[1]}° in pitch, {self.mounting[2]:+.1f}{unsure[2]} m ahead of the axle,"
            f" {self.mounting[4]:+.1f}{unsure[3]} m above it"
        )


def body_motion(problem: Problem, fit: Fit) -> BodyMotion:
    """The motion at the keyframes of a solution."""
    stamps = problem.intervals.keyframes
    T, velocities, biases = from_values(fit.values, len(stamps))
    R_imu_map = np.swapaxes(T[:, :3, :3], 1, 2)
    in_imu = (R_imu_map @ velocities[:, :, None])[:, :, 0]
    return BodyMotion(R_imu_map, in_imu, problem.intervals.rates - biases[:, 3:], np.gradient(stamps))


def observe(problem: Problem, fit: Fit, motion: BodyMotion) -> Vehicle:
    """The vehicle that a solution shows where it is well determined: moving, and beside a fix that fits."""
    where = where_seen(problem, fit, motion)
    seen, skids = motion[where], np.zeros((len(where), 2))
    time, way = seen.spacing.sum(), np.linalg.norm(seen.velocity, axis=1) @ seen.spacing
    if time < LEAST_TIME_S or way < LEAST_WAY_M:
        unseen = Slip(np.array([UNSEEN_SLIP**2, 0.0, 0.0]), LEAST_LASTING_S, UNSEEN_SLIP)
        doubt = f"it is seen to move faster than {MOVING_SPEED:g} m/s for {time:.0f} s and {way:.0f} m only"
        return Vehicle(np.zeros(5), (unseen, unseen), skids, doubt)
    mounting, by_mounting, slip = np.zeros(5), seen.by_mounting(), []
    for row, part in enumerate((SIDEWAYS, UPWARDS)):
        known = by_mounting[:, row] @ mounting
        mounting[part], its_slip, skids[where, row] = explain(
            seen.velocity[:, 1 + row] - known,
            by_mounting[:, row, part],
            MOUNTING_STDDEVS[part],
            seen.velocity[:, 0],
            seen.grows_with(),
            seen.spacing,
        )
        slip.append(its_slip)
    return Vehicle(mounting, (slip[0], slip[1]), skids, _doubt(mounting, seen))


def _doubt(mounting: Array, motion: BodyMotion) -> str:
    """Why what moves is no vehicle that rolls on wheels; empty when it is."""
    if np.abs(mounting[:2]).max() > MOST_SLOPE:
        return "the IMU looks neither where it goes nor where it comes from"
    speed = float(np.sqrt(np.mean(np.sum(motion.velocity**2, axis=1))))
    lateral, vertical = (robust_stddev(off) / speed for off in motion.sliding(mounting).T)
    if max(lateral, vertical) > MOST_SLIP:
        return f"it slides {100 * lateral:.0f} % of its speed sideways, {100 * vertical:.0f} % vertically"
    return ""


def where_seen(problem: Problem, fit: Fit, motion: BodyMotion) -> NDArray[np.bool_]:
    """The keyframes (k,) at which slip is seen: moving, and beside a fix that fits."""
    moving = np.linalg.norm(motion.velocity, axis=1) > MOVING_SPEED
    return np.asarray(moving & beside_fixes(problem, fit))


def beside_fixes(problem: Problem, fit: Fit) -> NDArray[np.bool_]:
    """The keyframes (k,) beside a fix that fits, not in an outage: no farther than fixes usually are apart."""
    stamps = problem.intervals.keyframes
    good = stamps[problem.at[fit.weights > 0.5]]
    if len(good) < 2:
        return np.zeros(len(stamps), dtype=bool)
    distance = np.abs(good[nearest(good, stamps)] - stamps)
    beside: NDArray[np.bool_] = distance <= min(1.5 * float(np.median(np.diff(good))), BESIDE_S)
    return beside


def direction(mounting: Array) -> Array:
    """The direction of travel in the imu's axes, (3,), by the slopes that the mounting (5,) begins with."""
    slopes = np.array([1.0, mounting[0], mounting[1]])
    return np.asarray(slopes / np.linalg.norm(slopes))
