"""A street driven in 16 sweeps of exact motion, for scan matching."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import scenes
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from factor_graphs.relative_poses import RelativePoses
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.sensor_log import Points, SensorLog

Array = NDArray[np.float64]
SWEEPS = 16


@cache
def street(cars: tuple[scenes.Box, ...] = ()) -> tuple[SensorLog, Trajectory]:
    """A street driven for 1.6 s, with the exact trajectory as first guess."""
    motion = scenes.drive(SWEEPS * 0.1)
    boxes = scenes.street(cars)
    points = {k: scenes.sweep(motion, boxes, k) for k in range(SWEEPS)}
    truth = scenes.trajectory_of(motion, SWEEPS)
    return scenes.log_of(points, truth), truth


def errors(found: RelativePoses, truth: Trajectory) -> Array:
    """Tangent from found to true, (k, 6): rad and m."""
    T = np.linalg.inv(truth.at(found.stamps[:, 0])) @ truth.at(found.stamps[:, 1])
    off = np.linalg.inv(found.T_imu_imu) @ T
    return np.column_stack([Rotation.from_matrix(off[:, :3, :3]).as_rotvec(), off[:, :3, 3]])


def with_scan(log: SensorLog, number: int, points: Points) -> SensorLog:
    """The same drive with other points in one sweep."""
    scans = tuple(replace(s, read=lambda: points) if s.number == number else s for s in log.scans)
    return replace(log, scans=scans)
