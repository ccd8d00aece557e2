"""Heights of the surfaces in the voxels of a map, from the scans that made it."""

from __future__ import annotations

import os

import numpy as np
from numpy.typing import NDArray

from factor_graphs.errors import MeasurementError
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.config import Settings
from gnss_sem_map.errors import DataError
from gnss_sem_map.mapping.labelled_scans import map_points
from gnss_sem_map.refinement.surface_heights import SurfaceHeights
from gnss_sem_map.scans.prefetch import prefetch
from gnss_sem_map.sensor_log import Scan, SensorLog
from gnss_sem_map.voxels.voxel_map import VoxelMap, keys_of

ENOUGH_SCANS = 50
"""Of a drive with more than `EVERY` times as many scans, only every `EVERY`th is used: the heights are as accurate."""
EVERY = 4


def measure_surface_heights(
    log: SensorLog, trajectory: Trajectory, settings: Settings, voxels: VoxelMap
) -> SurfaceHeights:
    """Heights of the points in every voxel of the map, in the map frame."""

    def place(scan: Scan) -> tuple[NDArray[np.int64], NDArray[np.float64]] | None:
        try:
            p_map, _ = map_points(scan.read(), scan, trajectory, log, settings.mapping)
        except (DataError, MeasurementError):
            return None  # was reported when the map was built
        row = voxels.indices_of(keys_of(p_map, settings.mapping.voxel_size_m))
        return row[row >= 0], p_map[row >= 0, 2]

    scans = log.scans if len(log.scans) < EVERY * ENOUGH_SCANS else log.scans[::EVERY]
    sums, counts = np.zeros(len(voxels)), np.zeros(len(voxels), np.int64)
    for _, placed in prefetch(place, scans, threads=os.cpu_count() or 1):
        if placed is not None:
            row, z = placed
            sums += np.bincount(row, z, len(voxels))
            counts += np.bincount(row, minlength=len(voxels))
    known = counts > 0
    return SurfaceHeights(voxels.keys[known], sums[known], counts[known])
