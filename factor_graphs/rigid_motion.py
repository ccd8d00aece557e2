"""Exact motion of any rigid body, and what perfect sensors on it read; of an IMU that sits elsewhere on a vehicle,
and of what is no vehicle: something held in a hand, or a drone.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import BSpline, make_interp_spline
from scipy.spatial.transform import Rotation

from factor_graphs.geodesy import LocalFrame
from factor_graphs.trajectory import Trajectory

Array = NDArray[np.float64]

# Step of the one derivative that is numerical, s: central, so its error is 1e-8 of the third derivative.
STEP_S = 1e-4


class RigidMotion(ABC):
    """Where the imu is over time, and with what velocity, acceleration and turn rate, all exact."""

    @property
    @abstractmethod
    def start(self) -> float:
        """First stamp, s."""

    @property
    @abstractmethod
    def end(self) -> float:
        """Last stamp, s."""

    @abstractmethod
    def poses(self, stamps: ArrayLike) -> Array:
        """T_map_imu, (k, 4, 4)."""

    @abstractmethod
    def velocities(self, stamps: ArrayLike) -> Array:
        """Velocity in the map frame, (k, 3) m/s."""

    @abstractmethod
    def accelerations(self, stamps: ArrayLike) -> Array:
        """Acceleration in the (rotating) map frame, (k, 3) m/s²."""

    @abstractmethod
    def turn_rates(self, stamps: ArrayLike) -> Array:
        """How fast the imu turns in the map frame, about its own axes, (k, 3) rad/s."""

    def specific_force(self, stamps: ArrayLike, frame: LocalFrame) -> Array:
        """What a perfect accelerometer reads, (k, 3) m/s², gravity and Coriolis included (Groves 2013)."""
        coriolis = 2 * np.cross(frame.earth_rate, self.velocities(stamps))
        gravity = frame.gravity_at(self.poses(stamps)[:, :3, 3])
        return self._in_imu(stamps, self.accelerations(stamps) + coriolis - gravity)

    def angular_rate(self, stamps: ArrayLike, frame: LocalFrame) -> Array:
        """What a perfect gyroscope reads, (k, 3) rad/s, the rotation of the Earth included."""
        return self.turn_rates(stamps) + self._in_imu(stamps, frame.earth_rate)

    def trajectory(self, stamps: ArrayLike) -> Trajectory:
        """The exact trajectory at these stamps, with velocities."""
        return Trajectory(np.asarray(stamps, np.float64), self.poses(stamps), self.velocities(stamps))

    def _in_imu(self, stamps: ArrayLike, vectors: Array) -> Array:
        R_imu_map = np.swapaxes(self.poses(stamps)[:, :3, :3], 1, 2)
        turned: Array = (R_imu_map @ vectors[..., None])[..., 0]
        return turned


@dataclass(frozen=True, eq=False)
class Mounted(RigidMotion):
    """Motion of an IMU that sits on a moving body at `T_body_imu` (4, 4), constant."""

    body: RigidMotion
    T_body_imu: Array

    @property
    def start(self) -> float:
        """First stamp, s."""
        return self.body.start

    @property
    def end(self) -> float:
        """Last stamp, s."""
        return self.body.end

    def poses(self, stamps: ArrayLike) -> Array:
        """T_map_imu, (k, 4, 4)."""
        return self.body.poses(stamps) @ self.T_body_imu

    def velocities(self, stamps: ArrayLike) -> Array:
        """Velocity in the map frame, (k, 3) m/s: v + w × l."""
        return self.body.velocities(stamps) + self._in_map(
            stamps, np.cross(self.body.turn_rates(stamps), self._arm)
        )

    def accelerations(self, stamps: ArrayLike) -> Array:
        """Acceleration in the map frame, (k, 3) m/s²: a + dw/dt × l (Euler) + w × (w × l) (centripetal)."""
        t, w = np.asarray(stamps, dtype=np.float64), self.body.turn_rates(stamps)
        before, after = (np.clip(t + step, self.start, self.end) for step in (-STEP_S, STEP_S))
        change = (self.body.turn_rates(after) - self.body.turn_rates(before)) / (after - before)[:, None]
        in_body = np.cross(change, self._arm) + np.cross(w, np.cross(w, self._arm))
        return self.body.accelerations(stamps) + self._in_map(stamps, in_body)

    def turn_rates(self, stamps: ArrayLike) -> Array:
        """How fast the imu turns in the map frame, about its own axes, (k, 3) rad/s."""
        return self.body.turn_rates(stamps) @ self.T_body_imu[:3, :3]

    @property
    def _arm(self) -> Array:
        return self.T_body_imu[:3, 3]

    def _in_map(self, stamps: ArrayLike, vectors: Array) -> Array:
        turned: Array = (self.body.poses(stamps)[:, :3, :3] @ vectors[..., None])[..., 0]
        return turned


@dataclass(frozen=True, eq=False)
class FreeMotion(RigidMotion):
    """Motion of a body that may go where it does not look: splines over time, quintic.

    `position` m, to the map frame; `euler` rad: yaw, pitch, roll. Made by `hand_held` and `drone`.
    """

    position: BSpline
    euler: BSpline

    @property
    def start(self) -> float:
        """First stamp, s."""
        return float(self.position.t[0])

    @property
    def end(self) -> float:
        """Last stamp, s."""
        return float(self.position.t[-1])

    def poses(self, stamps: ArrayLike) -> Array:
        """T_map_imu, (k, 4, 4)."""
        T = np.tile(np.eye(4), (np.size(stamps), 1, 1))
        T[:, :3, :3] = Rotation.from_euler("ZYX", _at(self.euler, stamps)).as_matrix()
        T[:, :3, 3] = _at(self.position, stamps)
        return T

    def velocities(self, stamps: ArrayLike) -> Array:
        """Velocity in the map frame, (k, 3) m/s."""
        return _at(self.position, stamps, 1)

    def accelerations(self, stamps: ArrayLike) -> Array:
        """Acceleration in the (rotating) map frame, (k, 3) m/s²."""
        return _at(self.position, stamps, 2)

    def turn_rates(self, stamps: ArrayLike) -> Array:
        """How fast the imu turns in the map frame, about its own axes, (k, 3) rad/s."""
        return turn_rates(_at(self.euler, stamps), _at(self.euler, stamps, 1))


def _at(spline: BSpline, stamps: ArrayLike, derivative: int = 0) -> Array:
    return np.asarray(spline(np.asarray(stamps, dtype=np.float64), derivative))


def turn_rates(euler: Array, change: Array) -> Array:
    """Turn rate about the axes of the body, (k, 3), of yaw, pitch, roll (k, 3) and their derivatives (k, 3)."""
    (_, pitch, roll), (yaw_rate, pitch_rate, roll_rate) = euler.T, change.T
    return np.column_stack([
        roll_rate - yaw_rate * np.sin(pitch),
        pitch_rate * np.cos(roll) + yaw_rate * np.cos(pitch) * np.sin(roll),
        yaw_rate * np.cos(pitch) * np.cos(roll) - pitch_rate * np.sin(roll),
    ])  # fmt: skip


def hand_held(seconds: float, rng: np.random.Generator) -> FreeMotion:
    """Someone walks at 1.4 m/s, and looks around: 1 rad in yaw, 0.2 rad in pitch and roll, every 2 s."""
    return _wander(seconds, rng, 1.4, 0.3, 2.0, np.array([1.0, 0.2, 0.2]))


def drone(seconds: float, rng: np.random.Generator) -> FreeMotion:
    """A drone flies at about 8 m/s wherever it likes, and turns 1 rad in yaw, tilts 0.2 rad, every 5 s."""
    return _wander(seconds, rng, 8.0, 3.0, 5.0, np.array([1.0, 0.2, 0.2]))


def _wander(
    seconds: float, rng: np.random.Generator, speed: float, climb: float, every_s: float, turns: Array
) -> FreeMotion:
    """Every `every_s` s another course, climb (`climb` m/s) and attitude (`turns` rad: yaw changes, pitch, roll)."""
    t = np.arange(-3 * every_s, seconds + 4 * every_s, every_s)
    course = np.cumsum(rng.normal(0.0, 0.5, len(t)))
    steps = np.column_stack([np.cos(course), np.sin(course), climb / speed * rng.standard_normal(len(t))])
    way = np.cumsum(speed * every_s * steps, axis=0)
    yaw = np.cumsum(rng.normal(0.0, turns[0], len(t)))
    euler = np.column_stack([yaw, turns[1:] * rng.standard_normal((len(t), 2))])
    return FreeMotion(make_interp_spline(t, way, k=5), make_interp_spline(t, euler, k=5))
