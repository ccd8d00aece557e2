"""The ground under the map, and how high every voxel stands over it."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy import ndimage

from gnss_sem_map.voxels.voxel_map import limits_of

CELL_M = 1.0
QUANTILE = 0.05
"""A cell's ground is this quantile of its heights: the lowest returns are often reflections from below."""
OPENING_CELLS = 7
STEP_M = 0.3
"""Ground may rise this much over its opening: more is a car, a hedge or a wall that hides the ground."""
SMOOTHING_CELLS = 3
"""Radius of the Gaussian of one cell's standard deviation."""
REACH_M = (1 + 1 + SMOOTHING_CELLS + OPENING_CELLS - 1) * CELL_M
"""Voxels farther away change nothing: in a cell, one beside it, smoothed, opened."""


def height_over_ground(centres: NDArray[np.float64]) -> NDArray[np.float32]:
    """Height of every voxel centre over the local ground: (v, 3) m -> (v,) m.

    The ground is a grid of 1 m cells: low quantile per cell, capped 0.3 m over its morphological opening, smoothed,
    bilinear between cell centres. Cells without a voxel have no say.
    """
    heights = np.empty(len(centres), np.float32)
    if len(centres):
        low, high = limits_of(centres[:, :2])
        origin = np.floor(low / CELL_M) - 1
        shape = np.floor(high / CELL_M) - origin + 2
        ground = np.full(shape.astype(np.int64), np.inf)
        _lowest(centres, origin, CELL_M, QUANTILE, ground)
        _heights(centres, origin, CELL_M, _smoothed(ground), heights)
    return heights


def _smoothed(ground: NDArray[np.float64]) -> NDArray[np.float64]:
    """The ground (m, n) without what stands on it; empty cells are infinite, before, and anything, after."""
    empty, size = np.isinf(ground), (OPENING_CELLS, OPENING_CELLS)
    eroded = ndimage.minimum_filter(ground, size, mode="constant", cval=np.inf)
    eroded[np.isinf(eroded)] = -np.inf
    opened = ndimage.maximum_filter(eroded, size, mode="constant", cval=-np.inf)
    ground = np.where(empty, 0.0, np.minimum(ground, opened + STEP_M))
    total, weight = (
        ndimage.gaussian_filter(of, sigma=1.0, truncate=SMOOTHING_CELLS, mode="constant")
        for of in (ground, (~empty).astype(np.float64))
    )
    return np.asarray(total / np.maximum(weight, 1e-12))


@njit(cache=True, nogil=True)
def _lowest(centres, origin, cell_m, quantile, ground):
    """The low quantile of z in every cell of the grid that has any."""
    count, columns = len(centres), ground.shape[1]
    flat, lowest = np.empty(count, np.int64), ground.reshape(-1)
    starts = np.zeros(len(lowest) + 1, np.int64)
    for i in range(count):
        x, y = np.floor(centres[i, 0] / cell_m) - origin[0], np.floor(centres[i, 1] / cell_m) - origin[1]
        flat[i] = int(x) * columns + int(y)
        starts[flat[i] + 1] += 1
    starts = np.cumsum(starts)
    filled, by_cell = starts[:-1].copy(), np.empty(count)
    for i in range(count):
        by_cell[filled[flat[i]]] = centres[i, 2]
        filled[flat[i]] += 1
    for cell in range(len(lowest)):
        here = by_cell[starts[cell] : starts[cell + 1]]
        if len(here):
            lowest[cell] = _low_of(here, int(quantile * (len(here) - 1)))


@njit(cache=True, nogil=True, inline="always")
def _low_of(values, rank):
    """The value of a rank, from 0; it is low, so that a sort of the lowest ones is enough."""
    for i in range(rank + 1):
        least = i
        for j in range(i + 1, len(values)):
            least = j if values[j] < values[least] else least
        values[i], values[least] = values[least], values[i]
    return values[rank]


@njit(cache=True, nogil=True)
def _heights(centres, origin, cell_m, ground, heights):
    """Heights over the ground, bilinear between the centres of four cells."""
    for i in range(len(centres)):
        x, y = centres[i, 0] / cell_m - 0.5, centres[i, 1] / cell_m - 0.5
        a, b = np.floor(x), np.floor(y)
        row, column = int(a - origin[0]), int(b - origin[1])
        a, b = x - a, y - b
        low = ground[row, column] * (1 - b) + ground[row, column + 1] * b
        high = ground[row + 1, column] * (1 - b) + ground[row + 1, column + 1] * b
        heights[i] = centres[i, 2] - (low * (1 - a) + high * a)
