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
    """Points (n, 3) of one sweep in the map frame, m.

    Raises MeasurementError when the sweep leaves the trajectory by more than 0.15 s.
    """
    n = len(points.xyz)
    stamps = points.stamps if points.stamps is not None else np.full(n, stamp)
    if n == 0:
        return np.empty((0, 3))
    first, last = float(stamps.min()), float(stamps.max())
    count = max(2, int(np.ceil((last - first) / KNOT_STEP_S)) + 1)
    step_s = (last - first) / (count - 1) or 1.0
    T_map_imu = trajectory.at(np.linspace(first, last, count), EXTRAPOLATE_S)
    T_map_lidar = T_map_imu @ T_imu_lidar
    p_map = np.empty((n, 3))
    voxel_kernels.transform_along(
        points.xyz, stamps, first, step_s, np.ascontiguousarray(T_map_lidar[:, :3]), p_map
    )
    return p_map
