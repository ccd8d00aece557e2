"""Voxel-grid downsampling: one point per cube. At 0.5 m a tenth of the points remains, enough for registration."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gnss_sem_map.voxels.hash_unique import distinct
from gnss_sem_map.voxels.kernels import pack_keys


def one_per_cube(points: NDArray[np.float64], edge_m: float) -> NDArray[np.float64]:
    """The mean (c, 3) m of the points (n, 3) m in each occupied cube of this edge length, in the order of the keys.

    Compiled, and releases the GIL: scans are prepared while others are matched.
    """
    keys = np.empty(len(points), np.int64)
    pack_keys(points, edge_m, keys)
    cubes, cube = distinct(keys)
    means = np.zeros((len(cubes), 3))
    _mean(points, cube, means)
    return means


@njit(cache=True, nogil=True)
def _mean(points, cube, means):
    counts = np.zeros(len(means))
    for i in range(len(points)):
        counts[cube[i]] += 1
        for axis in range(3):
            means[cube[i], axis] += points[i, axis]
    for c in range(len(means)):
        for axis in range(3):
            means[c, axis] /= counts[c]
