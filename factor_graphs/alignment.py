"""The first guess: where the vehicle was, how fast, and which way it looked, before any graph.

Position and velocity come from a smoothing spline through the fixes, roll and pitch from
the mean specific force, heading from the gyroscope tied to the course. A good start matters: from straight
lines between fixes the optimiser stays in a wrong valley after a long outage.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solveh_banded
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from factor_graphs.chi_square import BEYOND_DOUBT
from factor_graphs.errors import MeasurementError
from factor_graphs.intervals import ImuIntervals, nearest
from factor_graphs.measurements import GnssFixes

Array = NDArray[np.float64]

# Prior of the first keyframe's position m and speed m/s: finite, and no information.
START_POSITION_STDDEV, START_SPEED_STDDEV = 100.0, 20.0
# Random acceleration between the fixes, m/s²/√Hz: brisk driving.
CRUISE_NOISE_DENSITY = 1.5
# Course says nothing about heading below this speed, m/s, nor this far, s, from a fix.
MIN_COURSE_SPEED, MAX_COURSE_AGE = 1.5, 1.5
# The gyroscope's heading is tied to the course over this long, s.
HEADING_WINDOW_S = 20.0
# So far from the axis of the vehicle, rad, the imu looks aside.
LOOKING_ASIDE = np.pi / 4
# Over this long, s, a vehicle goes more forward than backward.
FORWARD_WINDOW_S = 100.0


@dataclass(frozen=True, eq=False)
class AttitudePrior:
    """What is known of the attitude at the IMU's first stamp: a rotation and its standard deviations.

    `R_map_imu` (3, 3); `stddevs` (3,) rad about the imu's x, y, z, or `in_map` about east, north, up. Raises
    MeasurementError when it is no rotation or a stddev is not positive.
    """

    R_map_imu: Array
    stddevs: Array
    in_map: bool = False

    def __post_init__(self) -> None:
        R, stddevs = np.asarray(self.R_map_imu, dtype=np.float64), np.asarray(self.stddevs, dtype=np.float64)
        if R.shape != (3, 3) or not np.allclose(R @ R.T, np.eye(3), atol=1e-6) or np.linalg.det(R) < 0:
            raise MeasurementError(f"AttitudePrior.R_map_imu is no rotation: {R.tolist()}")
        if stddevs.shape != (3,) or not np.all(stddevs > 0):
            raise MeasurementError(f"AttitudePrior.stddevs is {stddevs}; expected three positive values, rad")
        object.__setattr__(self, "R_map_imu", R)
        object.__setattr__(self, "stddevs", stddevs)

    @property
    def covariance(self) -> Array:
        """About the imu's x, y, z, (3, 3) rad²."""
        variances, R = np.diag(self.stddevs**2), self.R_map_imu
        return np.asarray(R.T @ variances @ R if self.in_map else variances)

    @property
    def heading_stddev(self) -> float:
        """About the map's up axis, rad, however the imu is mounted."""
        up = self.R_map_imu[2]
        return float(np.sqrt(up @ self.covariance @ up))


def first_guess(
    intervals: ImuIntervals, fixes: GnssFixes, p_imu_antenna: Array, attitude: AttitudePrior | None = None
) -> tuple[Array, Array]:
    """Poses (k, 4, 4) and velocities (k, 3) of the imu at the keyframes."""
    positions, velocities = spline_through(fixes, intervals)
    T = np.tile(np.eye(4), (len(positions), 1, 1))
    T[:, :3, :3] = attitudes(intervals, fixes, velocities, attitude)
    T[:, :3, 3] = positions - T[:, :3, :3] @ p_imu_antenna
    return T, velocities


def spline_through(fixes: GnssFixes, intervals: ImuIntervals) -> tuple[Array, Array]:
    """Positions and velocities of the antenna at the keyframes, (k, 3) each, under white random acceleration.

    The most probable motion is a cubic smoothing spline, with its knots at the fixes and at both ends.
    """
    at = intervals.keyframe_of(fixes.stamps)
    knots = np.unique([0, *at, len(intervals.keyframes) - 1])
    stamps, origin = intervals.keyframes[knots], fixes.positions[0]
    bands, weighted = _motion_bands(np.diff(stamps)), np.zeros((3, len(knots)))
    states = np.empty((len(knots), 2, 3))
    for axis in range(3):
        information, of_axis = 1 / fixes.stddevs[:, axis] ** 2, bands.copy()
        row = np.searchsorted(knots, at)
        np.add.at(of_axis[0], 2 * row, information)
        np.add.at(weighted[axis], row, information * (fixes.positions[:, axis] - origin[axis]))
        right = np.column_stack([weighted[axis], np.zeros(len(knots))]).ravel()
        states[:, :, axis] = solveh_banded(of_axis, right, lower=True).reshape(-1, 2)
    return _between(intervals.keyframes, stamps, states[:, 0] + origin, states[:, 1])


def _between(t: Array, knots: Array, p: Array, v: Array) -> tuple[Array, Array]:
    """Position and velocity on the cubics through knots; importing scipy's takes 0.2 s, 1 % of a run of 30 s."""
    i = np.clip(np.searchsorted(knots, t, side="right") - 1, 0, len(knots) - 2)
    h = np.diff(knots)[i, None]
    u, step, a, b = (t - knots[i])[:, None] / h, p[i + 1] - p[i], v[i] * h, v[i + 1] * h
    square, cube = 3 * step - 2 * a - b, a + b - 2 * step
    return p[i] + u * (a + u * (square + u * cube)), (a + u * (2 * square + 3 * u * cube)) / h


def _motion_bands(dt: Array) -> Array:
    """Information of position and velocity at n + 1 moments, (n, ) s apart: its four lower bands, (4, 2 n + 2)."""
    strength = 1 / CRUISE_NOISE_DENSITY**2
    positions, mixed, velocities = 12 * strength / dt**3, 6 * strength / dt**2, 4 * strength / dt
    bands = np.zeros((4, 2 * len(dt) + 2))
    bands[0, :2] = 1 / START_POSITION_STDDEV**2, 1 / START_SPEED_STDDEV**2
    for end, sign in ((slice(0, -2), 1), (slice(2, None), -1)):  # of every step its begin and its end
        bands[0, end][::2] += positions
        bands[0, end][1::2] += velocities
        bands[1, end][::2] += sign * mixed
    bands[1, 1:-2:2], bands[3, :-2:2] = -mixed, mixed
    bands[2, :-2:2], bands[2, 1:-2:2] = -positions, velocities / 2
    return bands


def attitudes(
    intervals: ImuIntervals, fixes: GnssFixes, velocities: Array, attitude: AttitudePrior | None = None
) -> Array:
    """Rotations R_map_imu (k, 3, 3) at the keyframes: level, and heading as gyroscope and course agree."""
    level = levelled(intervals) if attitude is None else _without_heading(attitude.R_map_imu)
    turn = (intervals.angular_rate @ level[2]) * intervals.durations
    turned = np.concatenate([[0.0], np.cumsum(turn)])[intervals.bounds]
    speed = np.hypot(velocities[:, 0], velocities[:, 1])
    age = np.abs(fixes.stamps[nearest(fixes.stamps, intervals.keyframes)] - intervals.keyframes)
    weight = np.where((speed > MIN_COURSE_SPEED) & (age < MAX_COURSE_AGE), np.minimum(speed, 10.0), 0.0)
    ahead = np.exp(1j * (np.arctan2(velocities[:, 1], velocities[:, 0]) - turned))
    if attitude is not None:
        weight[0] = 1 / attitude.heading_stddev
        ahead[0] = np.exp(1j * np.arctan2(attitude.R_map_imu[1, 0], attitude.R_map_imu[0, 0]))
    # the course is along the axis of the vehicle, whether it goes forward or reverses
    axis = _smooth(intervals.keyframes, ahead**2, weight, HEADING_WINDOW_S)
    axis = np.exp(0.5j * np.unwrap(np.angle(axis)))
    off = None if attitude else _off_axis(intervals, level, turned + np.angle(axis), velocities)
    if off is not None:
        return _headed(turned + np.angle(axis) + off, level)
    forward = _smooth(intervals.keyframes, ahead * axis.conj(), weight, FORWARD_WINDOW_S).real
    return _headed(turned + np.angle(np.where(forward < 0, -axis, axis)), level)


def _headed(heading: Array, level: Array) -> Array:
    return (Rotation.from_euler("z", heading[:, None]) * Rotation.from_matrix(level)).as_matrix()


def _off_axis(intervals: ImuIntervals, level: Array, axis: Array, velocities: Array) -> float | None:
    """How far, rad, the heading is off the axis (k,) along which it drives, by acceleration; None if that hides it.

    In a turn it is accelerated to the inside, at a stop it brakes: whether it drives forward or reverses, and however
    the imu is mounted. Forward is 0, reverse is pi; between, the imu looks aside.
    """
    force = np.add.reduceat(intervals.specific_force * intervals.durations[:, None], intervals.bounds[:-1])
    gained = (force @ level.T)[:, :2] @ [1, 1j] * np.exp(0.5j * (axis[1:] + axis[:-1]))
    products = np.diff(velocities[:, :2] @ [1, 1j]) * gained.conj()
    if abs(products.sum()) < BEYOND_DOUBT * np.linalg.norm(products):
        return None
    off = float(np.angle(products.sum()))
    straight = np.pi * round(off / np.pi)
    return straight if abs(off - straight) < LOOKING_ASIDE else off


def levelled(intervals: ImuIntervals) -> Array:
    """The rotation (3, 3), heading zero, that turns the mean specific force upwards."""
    mean = np.average(intervals.specific_force, axis=0, weights=intervals.durations)
    pitch, roll = np.arctan2(-mean[0], np.hypot(mean[1], mean[2])), np.arctan2(mean[1], mean[2])
    return Rotation.from_euler("ZYX", [0.0, pitch, roll]).as_matrix()


def _without_heading(R: Array) -> Array:
    return Rotation.from_euler("z", -np.arctan2(R[1, 0], R[0, 0])).as_matrix() @ R


def _smooth(
    stamps: Array, directions: NDArray[np.complex128], weights: Array, window_s: float
) -> NDArray[np.complex128]:
    """Weighted mean of unit numbers over a Gaussian window; the nearest known where the window is empty."""
    if not weights.any():
        return np.ones(len(stamps), dtype=complex)
    step = max(0.1, float(np.median(np.diff(stamps))))
    cell = ((stamps - stamps[0]) / step).astype(int)
    total = np.zeros((3, cell[-1] + 1))
    np.add.at(total.T, cell, np.column_stack([weights, weights * directions.real, weights * directions.imag]))
    total = gaussian_filter1d(total, window_s / step, axis=1, mode="constant", truncate=4.0)
    known = np.flatnonzero(total[0] > 1e-3 * total[0].max())
    used = known[nearest(known, np.arange(total.shape[1]))]
    smoothed: NDArray[np.complex128] = (total[1] + 1j * total[2])[used][cell]
    return smoothed
