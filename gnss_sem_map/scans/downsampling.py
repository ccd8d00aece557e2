"""A scan with one point per cube: half a metre apart is near enough to find a wall, and a tenth of the points."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gnss_sem_map.voxels.hash_unique import distinct
from gnss_sem_map.voxels.kernels import pack_keys


def one_per_cube(points: NDArray[np.float64], edge_m: float) -> NDArray[np.float64]:
    """The mean of the points (n, 3) m in each cube of this edge that holds any, (c, 3) m, in the order of their keys.

    Compiled and without Python's lock, so that scans are prepared while others are matched.
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
