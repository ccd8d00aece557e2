"""Local maps: the surfaces around some places of a track, each out of a few sweeps, in the imu frame at that place."""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path

import numpy as np
import small_gicp
from numpy.typing import NDArray

from factor_graphs.errors import MeasurementError
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.errors import DataError
from gnss_sem_map.scans.deskew import usable_points_in_map
from gnss_sem_map.scans.downsampling import one_per_cube, thinned
from gnss_sem_map.scans.thinned_sweeps import ThinnedSweeps
from gnss_sem_map.sensor_log import Points, SensorLog

Array = NDArray[np.float64]

CUBE_M, NEAREST_M, FARTHEST_M = 0.4, 2.5, 60.0
"""One point per cube of this edge; nearer and farther returns are left out."""
SWEEP_M, SWEEPS = 5.0, 5
"""Sweeps are so far apart along the track, and so many make a local map."""
NEIGHBOURS = 10
"""Of a point, for its plane."""
KEPT_SWEEPS, KEPT_MAPS = 16, 4
"""Neighbouring local maps have sweeps in common, and a place may be registered more than once."""


class LocalMaps:
    """The local maps of a drive, made when they are asked for; sweeps that cannot be read are left out.

    `sweeps` are those along its track; `stamps` (p,) s are of the places, in their span; `trajectory` deskews them.
    """

    def __init__(self, sweeps: ThinnedSweeps, trajectory: Trajectory, stamps: Array) -> None:
        self.sweeps, self._trajectory, self._stamps = sweeps, trajectory, stamps
        self._numbers = sorted(sweeps.numbers)
        self._nearest = nearest(np.array([sweeps.log.scans[n].stamp for n in self._numbers]), stamps)
        self._sweep = lru_cache(KEPT_SWEEPS)(self._read)
        self.at = lru_cache(KEPT_MAPS)(self._made)
        """The local map of a place: points, each with its plane, m; empty where no sweep can be read."""

    def forget(self) -> None:
        """Let go of the sweeps and maps that are kept, and of the sweeps on disk: 50 MB per km."""
        self.sweeps.forget()
        self._sweep.cache_clear()
        self.at.cache_clear()

    def _made(self, place: int) -> small_gicp.PointCloud:
        first = max(int(self._nearest[place]) - SWEEPS // 2, 0)
        there = [self._sweep(number) for number in self._numbers[first : first + SWEEPS]]
        T = np.linalg.inv(self._trajectory.at(self._stamps[place : place + 1])[0])
        points = np.concatenate(there) @ T[:3, :3].T + T[:3, 3]
        return cloud_of(one_per_cube(np.ascontiguousarray(points), CUBE_M))

    def _read(self, number: int) -> Array:
        """A thinned sweep in the map frame."""
        log = self.sweeps.log
        stamp, T_imu_lidar = log.scans[number].stamp, log.calibration.T_imu_lidar
        try:
            return usable_points_in_map(self.sweeps[number], stamp, self._trajectory, T_imu_lidar)[0]
        except (DataError, MeasurementError):  # reported when the map is built
            return np.empty((0, 3))


def sweeps_along(log: SensorLog, trajectory: Trajectory, folder: Path | None = None) -> ThinnedSweeps:
    """The sweeps of which local maps are made, SWEEP_M apart along the track."""
    way = way_along(trajectory, np.array([scan.stamp for scan in log.scans]))
    numbers = nearest(way, np.arange(0.0, way[-1] + SWEEP_M, SWEEP_M))
    return sweeps_of(log, numbers.tolist(), folder)


def sweeps_of(log: SensorLog, numbers: Iterable[int], folder: Path | None = None) -> ThinnedSweeps:
    """The sweeps of these numbers, as local maps need them."""
    return ThinnedSweeps(log, "surroundings", _thinned, frozenset(numbers), folder)


def _thinned(points: Points) -> Points:
    return thinned(points, CUBE_M, NEAREST_M, FARTHEST_M)


def nearest(values: Array, wanted: Array) -> NDArray[np.intp]:
    """The place of the value nearest to each wanted one, (w,): the first of equal ones.

    `values` (n,) do not decrease.
    """
    after = np.searchsorted(values, wanted).clip(max=len(values) - 1)
    before = np.maximum(after - 1, 0)
    is_after = np.abs(values[after] - wanted) < np.abs(values[before] - wanted)
    return np.searchsorted(values, values[np.where(is_after, after, before)])


def cloud_of(points: Array) -> small_gicp.PointCloud:
    """Points (n, 3) m, each with the plane of its neighbours; empty where there are too few."""
    if len(points) <= NEIGHBOURS:
        return small_gicp.PointCloud(np.empty((0, 3)))
    cloud = small_gicp.PointCloud(np.ascontiguousarray(points))
    small_gicp.estimate_covariances(cloud, small_gicp.KdTree(cloud), NEIGHBOURS)
    return cloud


def way_along(trajectory: Trajectory, stamps: Array) -> Array:
    """How far the imu has moved until each stamp, (n,) m; stamps beyond an end count as there."""
    inside = np.clip(stamps, trajectory.start, trajectory.end)
    steps = np.linalg.norm(np.diff(trajectory.at(inside)[:, :3, 3], axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def normals(cloud: small_gicp.PointCloud, every: int = 1) -> Array:
    """Unit normals (n, 3) of the planes of every so many of a cloud's points: the axis of least variance."""
    covariances = np.asarray(cloud.covs())[::every, :3, :3]
    return np.linalg.eigh(covariances)[1][:, :, 0].copy()  # a view would keep all three axes
