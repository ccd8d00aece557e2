"""Exact motion of a ground vehicle, and what an IMU, a GNSS receiver and wheels on it would report.

Position is a quintic spline of the way driven, so velocity, acceleration and angular rate are its analytic
derivatives: nothing is integrated here, and nothing is shared with the estimator that this puts to the test.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import BSpline, PchipInterpolator, make_interp_spline
from scipy.spatial.transform import Rotation

from factor_graphs.errors import MeasurementError
from factor_graphs.geodesy import LocalFrame
from factor_graphs.measurements import (
    AntennaHeadings,
    GnssFixes,
    GnssVelocities,
    ImuNoise,
    ImuSamples,
    WheelSpeeds,
)
from factor_graphs.rigid_motion import Mounted, RigidMotion, turn_rates

Array = NDArray[np.float64]

# Suspension: the body rolls and pitches with the way driven, so that it is still when the vehicle is.
_WAVELENGTHS_M = np.array([[31.0, 13.0], [23.0, 9.0]])
_SHARES = np.array([[0.7, 0.3], [0.7, 0.3]])


@dataclass(frozen=True, eq=False)
class Motion(RigidMotion):
    """Exact motion: a path (spline of the way driven, m, to the map frame, m) driven at a speed over time.

    Heading follows the course and pitch the slope, both as functions of the way, so they are defined
    at a stop. `suspension` rad is the amplitude of the body's roll and pitch on top. Made by `follow`.
    """

    path: BSpline
    speed: PchipInterpolator
    suspension: float = 0.0

    @property
    def start(self) -> float:
        """First stamp, s."""
        return float(self.speed.x[0])

    @property
    def end(self) -> float:
        """Last stamp, s."""
        return float(self.speed.x[-1])

    def way(self, stamps: ArrayLike) -> Array:
        """Distance driven since the start, (k,) m; raises MeasurementError outside start..end."""
        t = np.asarray(stamps, dtype=np.float64)
        if t.size and (t.min() < self.start - 1e-9 or t.max() > self.end + 1e-9):
            raise MeasurementError(
                f"stamps {t.min():.3f}..{t.max():.3f} s leave the motion {self.start:.3f}..{self.end:.3f} s"
            )
        driven = np.asarray(self.speed.antiderivative()(np.clip(t, self.start, self.end)))
        return np.clip(driven, self.path.t[0], self.path.t[-1])

    def poses(self, stamps: ArrayLike) -> Array:
        """T_map_imu, (k, 4, 4)."""
        s = self.way(stamps)
        T = np.tile(np.eye(4), (len(s), 1, 1))
        T[:, :3, :3] = self._attitude(s).as_matrix()
        T[:, :3, 3] = self.path(s)
        return T

    def velocities(self, stamps: ArrayLike) -> Array:
        """Velocity in the map frame, (k, 3) m/s."""
        return self.path(self.way(stamps), 1) * self._speed(stamps)

    def accelerations(self, stamps: ArrayLike) -> Array:
        """Acceleration in the (rotating) map frame, (k, 3) m/s²."""
        s, v, a = self.way(stamps), self._speed(stamps), self._speed(stamps, 1)
        return self.path(s, 2) * v**2 + self.path(s, 1) * a

    def turn_rates(self, stamps: ArrayLike) -> Array:
        """How fast the body turns in the map frame, about its own axes, (k, 3) rad/s."""
        euler, by_way = (np.column_stack(angles) for angles in self._euler(self.way(stamps)))
        return turn_rates(euler, by_way) * self._speed(stamps)

    def _speed(self, stamps: ArrayLike, derivative: int = 0) -> Array:
        return np.asarray(self.speed(np.asarray(stamps, dtype=np.float64), derivative))[:, None]

    def _attitude(self, s: Array) -> Rotation:
        (yaw, pitch, roll), _ = self._euler(s)
        return Rotation.from_euler("ZYX", np.column_stack([yaw, pitch, roll]))

    def _euler(self, s: Array) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
        """Yaw, pitch, roll (positive pitch: nose down) and their derivatives by the way."""
        (dx, dy, dz), (ddx, ddy, ddz) = self.path(s, 1).T, self.path(s, 2).T
        level = np.hypot(dx, dy)
        dlevel = (dx * ddx + dy * ddy) / level
        yaw, yaw_rate = np.arctan2(dy, dx), (dx * ddy - dy * ddx) / level**2
        pitch, pitch_rate = -np.arctan2(dz, level), -(level * ddz - dz * dlevel) / (level**2 + dz**2)
        phase = 2 * np.pi * s[:, None, None] / _WAVELENGTHS_M
        sway = self.suspension * (_SHARES * np.sin(phase)).sum(axis=-1).T
        sway_rate = self.suspension * (_SHARES * np.cos(phase) * 2 * np.pi / _WAVELENGTHS_M).sum(axis=-1).T
        return (yaw, pitch + sway[0], sway[1]), (yaw_rate, pitch_rate + sway_rate[0], sway_rate[1])


def follow(waypoints: ArrayLike, stamps: ArrayLike, speeds: ArrayLike, suspension_deg: float = 0.0) -> Motion:
    """The motion along a smooth path through waypoints, at given speeds.

    `waypoints` (n, 3) m in the map frame, n >= 6, of the imu; `stamps` (m,) s; `speeds` (m,) m/s, at
    those stamps and without overshoot between them (PCHIP): two zeros in a row are a real stop, and below zero
    the vehicle goes back along the path. Raises MeasurementError for another shape and when the speeds drive
    beyond the first or last waypoint.
    """
    points, t, v = (np.asarray(a, dtype=np.float64) for a in (waypoints, stamps, speeds))
    if points.ndim != 2 or points.shape[1] != 3 or len(points) < 6 or not np.isfinite(points).all():
        raise MeasurementError(f"waypoints have shape {points.shape}; expected (n, 3), n >= 6, all finite")
    if t.ndim != 1 or t.shape != v.shape or len(t) < 2 or np.any(np.diff(t) <= 0):
        raise MeasurementError("stamps and speeds must be (m,), m >= 2, stamps increasing")
    by_chord = make_interp_spline(_chord_length(points), points, k=5)
    # once more with the length of that curve as the parameter: then the speeds are metres per second
    chord = np.linspace(by_chord.t[0], by_chord.t[-1], max(20, int(by_chord.t[-1]) * 2))
    way = by_chord.derivative()(chord)
    length = PchipInterpolator(chord, np.linalg.norm(way, axis=1)).antiderivative()(chord)
    motion = Motion(
        make_interp_spline(length, by_chord(chord), k=5), PchipInterpolator(t, v), np.radians(suspension_deg)
    )
    driven = motion.speed.antiderivative()(np.linspace(t[0], t[-1], 20 * len(t)))
    if driven.max() > length[-1] + 1e-6:
        raise MeasurementError(
            f"the speeds drive {driven.max():.1f} m but the path is {length[-1]:.1f} m long; add waypoints"
        )
    if driven.min() < -1e-6:
        raise MeasurementError(f"the speeds drive back {-driven.min():.1f} m beyond the first waypoint")
    return motion


def random_drive(seconds: float, rng: np.random.Generator) -> Motion:
    """A drive of at least `seconds` s through an imagined town: straights, turns, hills, and stops.

    Speed obeys 15 m/s, 2.5 m/s² in curves, 1.5 m/s² when gaining and 2 m/s² when losing speed.
    """
    curvature = _random_streets(int(15.0 * seconds) + 100, rng)
    headings = rng.uniform(-np.pi, np.pi) + np.cumsum(curvature)
    way = np.arange(len(curvature))
    hills = 4.0 * np.sin(way / 180 + rng.uniform(0, 6)) + 1.5 * np.sin(way / 70 + rng.uniform(0, 6))
    ground = np.column_stack([np.cumsum(np.cos(headings)), np.cumsum(np.sin(headings)), hills])
    cruise = np.repeat(rng.uniform(8.0, 15.0, len(way) // 200 + 1), 200)[: len(way)]
    limit = np.minimum(cruise, np.sqrt(2.5 / np.maximum(np.abs(curvature), 1e-6)))
    stops = np.cumsum(rng.integers(100, 500, len(way) // 100))
    limit[np.append(0, stops[stops < len(way)])] = 0.0
    for i in range(1, len(limit)):
        limit[i] = min(limit[i], np.sqrt(limit[i - 1] ** 2 + 2 * 1.5))
    for i in range(len(limit) - 2, -1, -1):
        limit[i] = min(limit[i], np.sqrt(limit[i + 1] ** 2 + 2 * 2.0))
    stamps = np.concatenate([[0.0], np.cumsum(2.0 / (limit[:-1] + limit[1:]))])
    halts = np.flatnonzero(limit == 0)
    waits = np.zeros(len(limit))
    waits[halts] = np.where(rng.random(len(halts)) < 0.5, rng.uniform(5.0, 25.0, len(halts)), 1.0)
    left = stamps + np.cumsum(waits)
    knots, at_halt = np.concatenate([left, left[halts] - waits[halts]]), np.zeros(len(halts))
    order = np.argsort(knots)
    knots, speeds = knots[order], np.concatenate([limit, at_halt])[order]
    enough = min(int(np.searchsorted(knots, seconds)) + 1, len(knots))
    return follow(ground[::4], knots[:enough], speeds[:enough], suspension_deg=0.3)


def _random_streets(length: int, rng: np.random.Generator) -> Array:
    """Curvature of a way through streets, metre by metre, (length,) 1/m."""
    curvature: list[float] = []
    while len(curvature) < length:
        radius, turn = rng.uniform(12.0, 40.0), rng.choice([-1, 1]) * rng.uniform(0.3, 1.7)
        curvature += [0.0] * int(rng.uniform(40, 150)) + [np.sign(turn) / radius] * int(radius * abs(turn))
    ramp = np.hanning(13) / np.hanning(13).sum()  # roads begin their curves gently
    smooth = np.convolve(curvature, ramp, mode="same")
    return np.asarray(smooth, dtype=np.float64)[:length]


def simulate_biases(stamps: ArrayLike, noise: ImuNoise, rng: np.random.Generator) -> Array:
    """Biases that start somewhere and walk: (n, 6), accelerometer m/s² then gyroscope rad/s."""
    t = np.asarray(stamps, dtype=np.float64)
    start = np.repeat([noise.accelerometer_bias_stddev, noise.gyroscope_bias_stddev], 3)
    walk = np.repeat([noise.accelerometer_bias_walk, noise.gyroscope_bias_walk], 3)
    steps = np.sqrt(np.diff(t, prepend=t[0]))[:, None] * walk * rng.standard_normal((len(t), 6))
    walked: Array = start * rng.standard_normal(6) + np.cumsum(steps, axis=0)
    return walked


def simulate_imu(
    motion: RigidMotion,
    stamps: ArrayLike,
    frame: LocalFrame,
    noise: ImuNoise | None = None,
    rng: np.random.Generator | None = None,
    *,
    biases: ArrayLike | None = None,
    force_matrix: ArrayLike | None = None,
    rate_matrix: ArrayLike | None = None,
) -> ImuSamples:
    """What an IMU on this motion reports, value by value at its stamps; exact when `noise` is None.

    `biases` (n, 6) as `simulate_biases` makes them (drawn from `noise` when None); `force_matrix` and
    `rate_matrix` (3, 3) are scale and misalignment, identity when None. Raises MeasurementError when noise
    is asked for without `rng`.
    """
    t = np.asarray(stamps, dtype=np.float64)
    force, rate = motion.specific_force(t, frame), motion.angular_rate(t, frame)
    if force_matrix is not None:
        force = force @ np.asarray(force_matrix).T
    if rate_matrix is not None:
        rate = rate @ np.asarray(rate_matrix).T
    if noise is not None:
        if rng is None:
            raise MeasurementError("simulate_imu with noise needs a random generator; give rng")
        bandwidth = 1 / np.sqrt(np.median(np.diff(t)))
        force = force + noise.accelerometer_noise_density * bandwidth * rng.standard_normal(force.shape)
        rate = rate + noise.gyroscope_noise_density * bandwidth * rng.standard_normal(rate.shape)
        biases = simulate_biases(t, noise, rng) if biases is None else biases
    if biases is not None:
        force, rate = force + np.asarray(biases)[:, :3], rate + np.asarray(biases)[:, 3:]
    return ImuSamples(t, force, rate)


def simulate_gnss(
    motion: RigidMotion,
    stamps: ArrayLike,
    stddevs: ArrayLike,
    p_imu_antenna: ArrayLike = (0.0, 0.0, 0.0),
    rng: np.random.Generator | None = None,
    *,
    correlated_stddevs: ArrayLike = (0.0, 0.0, 0.0),
    correlation_time_s: float = 60.0,
    time_offset_s: float = 0.0,
    outages: Sequence[tuple[float, float]] = (),
    outlier_share: float = 0.0,
    outlier_range_m: tuple[float, float] = (5.0, 20.0),
) -> GnssFixes:
    """What a GNSS receiver on this motion reports; exact when `rng` is None.

    `stddevs` (3,) m of white noise, also what the receiver claims; `correlated_stddevs` (3,) m of an error
    that fades over `correlation_time_s` (Gauss-Markov) and that the receiver does not claim. A fix stamped
    t is of the time t + `time_offset_s`. `outages`: (first, last) stamps without fixes. A share of the
    fixes is shifted horizontally by a distance in `outlier_range_m`.
    """
    t, claimed = np.asarray(stamps, dtype=np.float64), np.broadcast_to(np.asarray(stddevs, np.float64), (3,))
    true_stamps = np.clip(t + time_offset_s, motion.start, motion.end)
    T = motion.poses(true_stamps)
    positions = T[:, :3, 3] + T[:, :3, :3] @ np.asarray(p_imu_antenna, dtype=np.float64)
    if rng is not None:
        positions = positions + claimed * rng.standard_normal((len(t), 3))
        positions = positions + np.asarray(correlated_stddevs) * _gauss_markov(t, correlation_time_s, rng)
        azimuth, shift = rng.uniform(0, 2 * np.pi, len(t)), rng.uniform(*outlier_range_m, len(t))
        shift = np.where(rng.random(len(t)) < outlier_share, shift, 0.0)
        positions[:, :2] += shift[:, None] * np.column_stack([np.cos(azimuth), np.sin(azimuth)])
    seen = np.logical_and.reduce([(t < a) | (t > b) for a, b in outages], initial=True)
    seen = np.broadcast_to(seen, t.shape)
    return GnssFixes(t[seen], positions[seen], np.tile(claimed, (int(seen.sum()), 1)))


def simulate_velocities(
    motion: RigidMotion,
    stamps: ArrayLike,
    stddevs: ArrayLike,
    p_imu_antenna: ArrayLike = (0.0, 0.0, 0.0),
    rng: np.random.Generator | None = None,
) -> GnssVelocities:
    """What a GNSS receiver says of the velocity of its antenna, `stddevs` (3,) m/s; exact when `rng` is None."""
    t, claimed = np.asarray(stamps, np.float64), np.broadcast_to(np.asarray(stddevs, np.float64), (3,))
    step, lever = 1e-3, np.asarray(p_imu_antenna, np.float64)
    before, after = (
        T[:, :3, 3] + T[:, :3, :3] @ lever for T in (motion.poses(t - step), motion.poses(t + step))
    )
    velocities = (after - before) / (2 * step)
    if rng is not None:
        velocities = velocities + claimed * rng.standard_normal((len(t), 3))
    return GnssVelocities(t, velocities, np.tile(claimed, (len(t), 1)))


def simulate_headings(
    motion: RigidMotion,
    stamps: ArrayLike,
    stddev: float,
    baseline: ArrayLike = (1.0, 0.0, 0.0),
    rng: np.random.Generator | None = None,
) -> AntennaHeadings:
    """What a receiver says of the azimuth of a baseline (3,) m in the imu frame; exact when `rng` is None."""
    t, b = np.asarray(stamps, np.float64), np.asarray(baseline, np.float64)
    east, north, _ = (motion.poses(t)[:, :3, :3] @ b).T
    azimuths = np.arctan2(east, north) + (0.0 if rng is None else stddev * rng.standard_normal(len(t)))
    return AntennaHeadings(t, azimuths % (2 * np.pi), np.full(len(t), stddev), b)


def simulate_wheels(
    motion: RigidMotion,
    stamps: ArrayLike,
    rng: np.random.Generator | None = None,
    *,
    scale: float = 1.0,
    offset_mps: float = 0.0,
    latency_s: float = 0.0,
    stddev_mps: float = 0.0,
    quantum_mps: float = 0.0,
    signed: bool = True,
    slips: Sequence[tuple[float, float, float]] = (),
) -> WheelSpeeds:
    """What wheel speeds on this motion say; exact when nothing else is asked for.

    `motion` is the axle's; of a `Mounted` imu it is that of the body. A wheel that rolls says ±(|v| - `offset_mps`) /
    `scale` of the speed v at its stamp less `latency_s`, with white noise of `stddev_mps` (needs `rng`), rounded to
    `quantum_mps`, its sign lost unless `signed`; one at rest says zero. `slips`: (first, last, share) stamps s between
    which it spins so much faster, or is locked (-1).
    """
    t = np.asarray(stamps, dtype=np.float64)
    axle = motion.body if isinstance(motion, Mounted) else motion
    true_stamps = np.clip(t - latency_s, motion.start, motion.end)
    R_map_axle = axle.poses(true_stamps)[:, :3, :3]
    ahead = np.einsum("kij,ki->kj", R_map_axle, axle.velocities(true_stamps))[:, 0]
    speeds = np.maximum(np.abs(ahead) - offset_mps, 0.0) / scale
    for first, last, share in slips:
        speeds = np.where((t >= first) & (t <= last), speeds * (1 + share), speeds)
    if stddev_mps:
        if rng is None:
            raise MeasurementError("simulate_wheels with noise needs a random generator; give rng")
        speeds = np.where(speeds > 0, np.abs(speeds + stddev_mps * rng.standard_normal(len(t))), 0.0)
    if quantum_mps:
        speeds = np.round(speeds / quantum_mps) * quantum_mps
    return WheelSpeeds(t, speeds * np.sign(ahead) if signed else speeds)


def _gauss_markov(stamps: Array, correlation_time_s: float, rng: np.random.Generator) -> Array:
    """Unit-variance, exponentially correlated noise on three axes, (n, 3)."""
    keep = np.exp(-np.diff(stamps) / correlation_time_s)
    values = rng.standard_normal((len(stamps), 3))
    for i in range(1, len(stamps)):
        values[i] = keep[i - 1] * values[i - 1] + np.sqrt(1 - keep[i - 1] ** 2) * values[i]
    return values


def _chord_length(points: Array) -> Array:
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    if np.any(steps <= 0):
        raise MeasurementError(f"waypoint {int(np.argmin(steps)) + 1} repeats the one before; drop it")
    return np.concatenate([[0.0], np.cumsum(steps)])
