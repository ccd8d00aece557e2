"""A georeferenced point cloud that stands: places of drives are registered to it, as to an earlier pass."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import small_gicp
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gnss_sem_map.scans.local_maps import FARTHEST_M, cloud_of

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class BaseCloud:
    """Points (n, 3) m in the map frame, about one per cube of `local_maps.CUBE_M`."""

    name: str
    points: Array

    def around(self, T_map_imu: Array) -> small_gicp.PointCloud:
        """The points within 60 m of a pose (4, 4), in its axes, each with its plane."""
        near = np.sort(self._tree.query_ball_point(T_map_imu[:3, 3], FARTHEST_M)).astype(np.intp)
        return cloud_of((self.points[near] - T_map_imu[:3, 3]) @ T_map_imu[:3, :3])

    def beside(self, track: Array) -> tuple[float, float]:
        """How far aside of a track (n, 3) it begins, and how far below the track its nearest points lie, median, m."""
        aside, nearest = cKDTree(self.points[:, :2]).query(track[:, :2])
        return float(np.min(aside)), float(np.median(track[:, 2] - self.points[nearest, 2]))

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.points)
