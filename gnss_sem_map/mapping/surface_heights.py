"""How high the surface lies in every voxel, finer than the voxel is: the mean of the points in it."""

from __future__ import annotations

import os

import numpy as np
from numpy.typing import NDArray

from factor_graphs.errors import MeasurementError
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.config import Settings
from gnss_sem_map.errors import DataError
from gnss_sem_map.mapping.labelled_scans import map_points
from gnss_sem_map.scans.prefetch import prefetch
from gnss_sem_map.sensor_log import Scan, SensorLog
from gnss_sem_map.voxels.voxel_map import SemanticMap, keys_of

ENOUGH_SCANS = 50
"""Of a drive with more than `EVERY` times as many, every `EVERY`th tells the heights as well as all do."""
EVERY = 4


def surface_heights(
    log: SensorLog,
    trajectory: Trajectory,
    settings: Settings,
    semantic_map: SemanticMap,
    wanted: NDArray[np.bool_],
) -> NDArray[np.float64]:
    """Mean height of the points in every wanted voxel (v,) m, in the map frame; NaN elsewhere, and where none is."""
    voxels = np.flatnonzero(wanted)
    slots = np.full(len(wanted) + 1, -1, np.int64)  # the place -1 finds the last
    slots[voxels] = np.arange(len(voxels))

    def place(scan: Scan) -> tuple[NDArray[np.int64], NDArray[np.float64]] | None:
        try:
            p_map, _ = map_points(scan.read(), scan, trajectory, log, settings.mapping)
        except (DataError, MeasurementError):
            return None  # counted when the map was built
        slot = slots[semantic_map.voxels.indices_of(keys_of(p_map, settings.mapping.voxel_size_m))]
        return slot[slot >= 0], p_map[slot >= 0, 2]

    scans = log.scans if len(log.scans) < EVERY * ENOUGH_SCANS else log.scans[::EVERY]
    sums, counts = np.zeros(len(voxels)), np.zeros(len(voxels))
    for _, placed in prefetch(place, scans, threads=os.cpu_count() or 1):
        if placed is not None:
            slot, z = placed
            sums += np.bincount(slot, z, len(voxels))
            counts += np.bincount(slot, minlength=len(voxels))
    heights = np.full(len(wanted), np.nan)
    heights[voxels] = np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)
    return heights
