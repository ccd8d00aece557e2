"""The ground under the map, and how high every voxel stands over it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

CELL_M = 1.0
BLOCK_M, MARGIN_M = 256.0, 32.0
REACH_M = BLOCK_M + MARGIN_M
"""Voxels farther away change nothing."""
QUANTILE = 0.05
"""A cell's ground is this quantile of its heights: the lowest returns are often reflections from below."""
OPENING_CELLS = 7
STEP_M = 0.3
"""Ground may rise this much over its opening: more is a car, a hedge or a wall that hides the ground."""


def height_over_ground(centres: NDArray[np.float64]) -> NDArray[np.float32]:
    """Height of every voxel centre over the local ground: (v, 3) m -> (v,) m.

    The ground is a grid of 1 m cells: low quantile per cell, gaps from the nearest cell, capped 0.3 m over its
    morphological opening, smoothed, bilinear between cell centres. It is made block by block, with a margin, so that
    memory grows with the voxels and not with the area that they span.
    """
    heights = np.empty(len(centres), np.float32)
    order = np.argsort(centres[:, 0], kind="stable")  # voxels of a map are in this order already
    x, y = centres[order, 0], centres[order, 1]
    for east in np.unique(np.floor(x / BLOCK_M)) * BLOCK_M:
        start, end = np.searchsorted(x, [east - MARGIN_M, east + BLOCK_M + MARGIN_M])
        slab, slab_y = order[start:end], y[start:end]
        inside = (x[start:end] >= east) & (x[start:end] < east + BLOCK_M)
        for north in np.unique(np.floor(slab_y[inside] / BLOCK_M)) * BLOCK_M:
            near = (slab_y >= north - MARGIN_M) & (slab_y < north + BLOCK_M + MARGIN_M)
            own = inside[near] & (slab_y[near] >= north) & (slab_y[near] < north + BLOCK_M)
            heights[slab[near][own]] = _height_in_block(centres[slab[near]])[own]
    return heights


def _height_in_block(centres: NDArray[np.float64]) -> NDArray[np.float64]:
    cells = np.floor(centres[:, :2] / CELL_M).astype(np.int64)
    origin = cells.min(axis=0)
    cells -= origin
    ground = _lowest(cells, centres[:, 2])
    nearest = ndimage.distance_transform_edt(np.isnan(ground), return_distances=False, return_indices=True)
    ground = ground[tuple(nearest)]
    opened = ndimage.grey_opening(ground, size=(OPENING_CELLS, OPENING_CELLS))
    ground = ndimage.gaussian_filter(np.minimum(ground, opened + STEP_M), sigma=1.0, mode="nearest")
    at = centres[:, :2] / CELL_M - origin - 0.5
    return np.asarray(centres[:, 2] - ndimage.map_coordinates(ground, at.T, order=1, mode="nearest"))


def _lowest(cells: NDArray[np.int64], z: NDArray[np.float64]) -> NDArray[np.float64]:
    """The low quantile of z in every cell of the grid, NaN in empty ones."""
    shape = cells.max(axis=0) + 1
    flat = cells[:, 0] * shape[1] + cells[:, 1]
    order = np.lexsort((z, flat))
    filled, starts, counts = np.unique(flat[order], return_index=True, return_counts=True)
    grid = np.full(int(shape[0] * shape[1]), np.nan)
    grid[filled] = z[order][starts + (QUANTILE * (counts - 1)).astype(np.int64)]
    return grid.reshape(int(shape[0]), int(shape[1]))
