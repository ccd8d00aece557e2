"""Every point to where it was in the map, at its own stamp (eq. 1).

A sweep takes 0.1 s. A vehicle at 50 km/h moves 1.4 m meanwhile, so one pose per scan smears every wall. Raw sweeps are
moved point by point; sweeps that are already motion-compensated with the one pose of their stamp.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from factor_graphs.trajectory import Trajectory
from gnss_sem_map import voxel_kernels
from gnss_sem_map.sensor_log import Points

KNOT_STEP_S = 1e-3
"""Poses are computed this densely and blended linearly between: at 1 rad/s the error of the blend is 1e-7."""
EXTRAPOLATE_S = 0.15
"""The first and last sweep may reach this far beyond the trajectory: no more than a sweep and a half."""


def points_in_map(
    points: Points, stamp: float, trajectory: Trajectory, T_imu_lidar: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The finite points of one sweep in the map frame, m; else as `usable_points_in_map`."""
    return usable_points_in_map(points, stamp, trajectory, T_imu_lidar)[0]


def usable_points_in_map(
    points: Points,
    stamp: float,
    trajectory: Trajectory,
    T_imu_lidar: NDArray[np.float64],
    nearest_m: float = 0.0,
    farthest_m: float = np.inf,
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """The points of one sweep that are finite and in range, in the map frame (m, 3) m, and which those are (n,).

    Raises MeasurementError when the sweep leaves the trajectory by more than 0.15 s.
    """
    stamps = np.empty(0) if points.stamps is None else points.stamps
    valid = np.empty(len(points.xyz), np.bool_)
    count, first, last = voxel_kernels.usable(points.xyz, stamps, nearest_m, farthest_m, valid)
    p_map = np.empty((count, 3))
    if count:
        first, last = (first, last) if len(stamps) else (stamp, stamp)
        step_s, poses = _poses(trajectory, T_imu_lidar, first, last)
        voxel_kernels.transform_along(points.xyz, stamps, valid, first, step_s, poses, p_map)
    return p_map, valid


def _poses(
    trajectory: Trajectory, T_imu_lidar: NDArray[np.float64], first: float, last: float
) -> tuple[float, NDArray[np.float64]]:
    """Poses of the lidar from the first stamp to the last (k, 3, 8), each with its difference to the next."""
    steps = max(1, int(np.ceil((last - first) / KNOT_STEP_S)))
    T_map_lidar = trajectory.at(np.linspace(first, last, steps + 1), EXTRAPOLATE_S) @ T_imu_lidar
    poses = np.concatenate([T_map_lidar[:-1, :3], np.diff(T_map_lidar[:, :3], axis=0)], axis=2)
    return (last - first) / steps or 1.0, poses
