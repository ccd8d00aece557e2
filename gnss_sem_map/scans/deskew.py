"""Deskewing: every point of a sweep is transformed into the map with the pose of its own stamp (eq. 1).

A sweep takes 0.1 s. A vehicle at 50 km/h moves 1.4 m meanwhile, so one pose per sweep would blur every wall. Raw sweeps
are transformed point by point; sweeps that are already motion-compensated with one pose, that of their stamp.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from factor_graphs.errors import MeasurementError
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.scans import kernels
from gnss_sem_map.sensor_log import Points

KNOTS_PER_S = 200.0
"""Poses are computed at whole multiples of 5 ms (knots) and interpolated linearly between them: at 1 rad/s, the error
of a point at 100 m is 0.3 mm. The position of a point depends on its own stamp only, not on the rest of the sweep."""
EXTRAPOLATE_S = 0.15
"""The first and last sweep may extend this far beyond the trajectory: a sweep and a half."""
LONGEST_SWEEP_S = 1.0
"""Longest sweep: stamps of usable points that are farther apart are an error. Other points may have any stamp."""


@dataclass(frozen=True, eq=False)
class Knots:
    """Poses of the LiDAR during one sweep."""

    first: int
    """Number of the first knot; knot 0 is at stamp 0."""
    poses: NDArray[np.float64]
    """(k, 3, 8): T_map_lidar (3, 4) at each knot, and beside it the difference to the next knot (3, 4)."""


def points_in_map(
    points: Points, stamp: float, trajectory: Trajectory, T_imu_lidar: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The usable points (m, 3) m of one sweep in the map frame; see `usable_points_in_map`."""
    return usable_points_in_map(points, stamp, trajectory, T_imu_lidar)[0]


def usable_points_in_map(
    points: Points,
    stamp: float,
    trajectory: Trajectory,
    T_imu_lidar: NDArray[np.float64],
    nearest_m: float = 0.0,
    farthest_m: float = np.inf,
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """The usable points of one sweep in the map frame (m, 3) m, and their mask (n,) (eq. 1); see `kernels.mark_usable`.

    Raises MeasurementError when the sweep leaves the trajectory by more than 0.15 s.
    """
    stamps, knots = knots_of(points, stamp, trajectory, T_imu_lidar, nearest_m, farthest_m)
    return _moved(points, stamps, knots, nearest_m, farthest_m)


def usable_points_at_stamp(
    points: Points,
    stamp: float,
    trajectory: Trajectory,
    T_imu_lidar: NDArray[np.float64],
    nearest_m: float = 0.0,
    farthest_m: float = np.inf,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The usable points of one sweep, deskewed to its stamp, (m, 3) m in the LiDAR frame, and T_map_lidar (4, 4).

    Raises MeasurementError when the sweep leaves the trajectory by more than 0.15 s.
    """
    T_map_lidar = trajectory.at([stamp], EXTRAPOLATE_S)[0] @ T_imu_lidar
    stamps, knots = knots_of(points, stamp, trajectory, T_imu_lidar, nearest_m, farthest_m)
    poses = knots.poses.copy()
    poses[:, :, 3] -= T_map_lidar[:3, 3]
    from_here = Knots(knots.first, T_map_lidar[:3, :3].T @ poses)
    return _moved(points, stamps, from_here, nearest_m, farthest_m)[0], T_map_lidar


def _moved(
    points: Points, stamps: NDArray[np.float64], knots: Knots, nearest_m: float, farthest_m: float
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """The usable points (m, 3), transformed with the poses at the knots, and their mask (n,)."""
    valid, moved = np.zeros(len(points.xyz), np.bool_), np.empty(3 * len(points.xyz))
    count = kernels.to_map(
        points.rows, stamps, nearest_m, farthest_m, KNOTS_PER_S, knots.first, knots.poses, valid, moved
    )
    return moved[: 3 * count].reshape(-1, 3), valid


def knots_of(
    points: Points,
    stamp: float,
    trajectory: Trajectory,
    T_imu_lidar: NDArray[np.float64],
    nearest_m: float,
    farthest_m: float,
) -> tuple[NDArray[np.float64], Knots]:
    """The stamps of one sweep (n,), empty where one pose holds for all points, and the poses that enclose them.

    Raises MeasurementError when the sweep leaves the trajectory by more than 0.15 s, or takes more than a second.
    """
    if points.stamps is None:
        T_map_lidar = trajectory.at([stamp], EXTRAPOLATE_S)[:, :3] @ T_imu_lidar
        return np.empty(0), Knots(0, np.concatenate([T_map_lidar, np.zeros_like(T_map_lidar)], axis=2))
    valid = np.empty(len(points.xyz), np.bool_)
    kernels.mark_usable(points.rows, points.stamps, nearest_m, farthest_m, valid)
    used = points.stamps[valid]
    first, last = used.min(initial=np.inf), used.max(initial=-np.inf)
    if last - first > LONGEST_SWEEP_S:
        raise MeasurementError(
            f"the sweep takes {last - first:.6g} s, expected at most {LONGEST_SWEEP_S:g}; are its times in s?"
        )
    if not len(used):  # no point is usable
        return points.stamps, Knots(0, np.zeros((1, 3, 8)))
    numbers = np.arange(np.floor(first * KNOTS_PER_S), np.floor(last * KNOTS_PER_S) + 2)
    T_map_lidar = trajectory.at(numbers / KNOTS_PER_S, EXTRAPOLATE_S + 1 / KNOTS_PER_S)[:, :3] @ T_imu_lidar
    return points.stamps, Knots(
        int(numbers[0]), np.concatenate([T_map_lidar[:-1], np.diff(T_map_lidar, axis=0)], axis=2)
    )
