"""Returns of the vehicle that carries the LiDAR: while it drives, they alone stay in place in the LiDAR's axes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.voxels.voxel_map import keys_of, unpack

FARTHEST_M = 2.4
"""A vehicle does not reach farther from its LiDAR than KITTI's, which has returns of itself up to this."""
NEAREST_M = 0.5
"""Rows nearer than this are no returns, or of the LiDAR's own housing."""
CELL_M, LEAST_SHARE = 0.2, 0.7
"""Cells with returns in more of the scans than this are of the vehicle: parked cars, passed at the same distance again
and again, stay below half."""


def returns_of(points: NDArray[np.floating]) -> NDArray[np.float64]:
    """The returns (m, 3) m among the rows (n, 3) of a scan; drivers write NaN or zeros where nothing came back."""
    p_lidar = points.astype(np.float64)
    ranges = np.linalg.norm(p_lidar, axis=1)
    return np.asarray(p_lidar[(ranges >= NEAREST_M) & (ranges < np.inf)])


def reach_of_vehicle(scans: Sequence[NDArray[np.floating]]) -> float:
    """Range, m, up to which the points (n, 3) m of some scans of a drive may be of the vehicle.

    It is NEAREST_M to FARTHEST_M. The scans are from all of the drive; of a vehicle that stands, all around it counts.
    """
    cells = [np.empty(0, np.int64)]
    for points in scans:
        p_lidar = returns_of(points)
        cells.append(np.unique(keys_of(p_lidar[np.linalg.norm(p_lidar, axis=1) < FARTHEST_M], CELL_M)))
    keys, times = np.unique(np.concatenate(cells), return_counts=True)
    own = (unpack(keys[times > LEAST_SHARE * len(scans)]) + 0.5) * CELL_M
    ranges = np.linalg.norm(own, axis=1)
    # to the far corner of a cell, and of the next one: a return may lie a little beyond those that were looked at
    reach_m = float(ranges.max(initial=-np.inf)) + 1.5 * np.sqrt(3) * CELL_M
    return float(np.clip(reach_m, NEAREST_M, FARTHEST_M))
