"""Grid of one scan, seen from above: height over the ground, and distances to a position or to other points."""

from __future__ import annotations

import numpy as np
from numba import int32, njit
from numpy.typing import NDArray

GROUND_CELL_M = 1.0
FARTHEST_CELL = 2**31 - 1
"""Index of no cell, beyond all that are."""


def height_over_ground(p_map: NDArray[np.float64], cell_m: float = GROUND_CELL_M) -> NDArray[np.float64]:
    """Height (n,) m of every point (n, 3) m over the lowest point in its cell and the eight cells around it."""
    heights = np.empty(len(p_map))
    if len(p_map):
        _heights(p_map, cell_m, heights)
    return heights


def within_radius(
    p_map: NDArray[np.float64], centre: NDArray[np.float64], reach_m: float
) -> NDArray[np.bool_]:
    """Mask (n,) of the points (n, 3) m with a horizontal distance of at most `reach_m` from a centre (2,) m."""
    found = np.empty(len(p_map), np.bool_)
    _within_radius(p_map, centre[0], centre[1], reach_m * reach_m, found)
    return found


def in_cells_near(p_map: NDArray[np.float64], marked: NDArray[np.bool_], reach_m: float) -> NDArray[np.bool_]:
    """Mask (n,) of the points in a square cell of size `reach_m` that holds a marked point, or in a cell beside one."""
    if reach_m == 0 or not marked.any():
        return marked
    found = np.empty(len(p_map), np.bool_)
    _in_cells_near(p_map, marked, reach_m, found)
    return found


def closer_than(
    points: NDArray[np.floating], marked: NDArray[np.bool_], asked: NDArray[np.bool_], reach_m: float
) -> NDArray[np.bool_]:
    """Mask (n,) of the `asked` points (n, 2 or 3) m whose distance to a marked point is less than `reach_m`."""
    found = np.zeros(len(points), np.bool_)
    if reach_m > 0 and marked.any():
        _closer_than(np.ascontiguousarray(points), marked, asked, reach_m, found)
    return found


@njit(cache=True, nogil=True)
def _within_radius(p_map, x, y, square, found):
    for i in range(len(p_map)):
        east, north = p_map[i, 0] - x, p_map[i, 1] - y
        found[i] = east * east + north * north <= square


@njit(cache=True, nogil=True, error_model="numpy")
def _cells(p_map, size_m):
    """Index of the cell of every point (n, 3) in the flattened grid, and the length and width of the grid.

    The grid has a margin of one cell, so that every cell with a point has eight neighbours.
    """
    n = len(p_map)
    x, y = np.empty(n, np.int32), np.empty(n, np.int32)
    west = south = FARTHEST_CELL
    east = north = -FARTHEST_CELL
    for i in range(n):
        x[i], y[i] = _cell_of(p_map, i, size_m)
        west, south = min(west, x[i]), min(south, y[i])
        east, north = max(east, x[i]), max(north, y[i])
    length, width = east - west + 3, north - south + 3
    for i in range(n):
        x[i] = (x[i] - west + 1) * width + y[i] - south + 1
    return x, length, width


@njit(cache=True, nogil=True, error_model="numpy")
def _heights(p_map, size_m, heights):
    cells, length, width = _cells(p_map, size_m)
    lowest = np.full(length * width, np.inf)
    for i in range(len(cells)):
        lowest[cells[i]] = min(lowest[cells[i]], p_map[i, 2])
    # the minimum over 3 x 3 cells is separable: first along one axis, then along the other
    across = lowest.copy()
    for c in range(1, len(lowest) - 1):
        across[c] = min(lowest[c - 1], lowest[c], lowest[c + 1])
    for c in range(width, len(lowest) - width):
        lowest[c] = min(across[c - width], across[c], across[c + width])
    for i in range(len(cells)):
        heights[i] = p_map[i, 2] - lowest[cells[i]]


@njit(cache=True, nogil=True, error_model="numpy")
def _in_cells_near(p_map, marked, size_m, found):
    cells, length, width = _cells(p_map, size_m)
    reached = np.zeros(length * width, np.bool_)
    for i in range(len(cells)):
        if marked[i]:
            reached[cells[i]] = True
    for c in np.flatnonzero(reached):
        for row in range(c - width, c + width + 1, width):
            reached[row - 1 : row + 2] = True
    for i in range(len(cells)):
        found[i] = reached[cells[i]]


@njit(cache=True, nogil=True, error_model="numpy")
def _closer_than(points, marked, asked, reach_m, found):
    """Mark in `found` the asked points; the grid reaches no farther than the marked ones, which may be few."""
    ones = np.flatnonzero(marked)
    x, y = np.empty(len(ones), np.int32), np.empty(len(ones), np.int32)
    for k in range(len(ones)):
        x[k], y[k] = _cell_of(points, ones[k], reach_m)
    west, east, south, north = x.min(), x.max() + 1, y.min(), y.max() + 1
    latest, before = np.full((east - west, north - south), -1, np.int32), np.empty(len(ones), np.int32)
    for k in range(len(ones)):  # a linked list of the marked points of each cell
        before[k] = latest[x[k] - west, y[k] - south]
        latest[x[k] - west, y[k] - south] = k
    for i in np.flatnonzero(asked):
        column, row = _cell_of(points, i, reach_m)
        for c in range(max(column - 1, west), min(column + 2, east)):
            for r in range(max(row - 1, south), min(row + 2, north)):
                k = latest[c - west, r - south]
                while k >= 0 and not found[i]:
                    found[i] = _square(points, i, ones[k]) < reach_m * reach_m
                    k = before[k]


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _cell_of(points, i, size_m):
    return int32(np.floor(points[i, 0] / size_m)), int32(np.floor(points[i, 1] / size_m))


@njit(cache=True, nogil=True, inline="always")
def _square(points, i, j):
    square = 0.0
    for axis in range(points.shape[1]):
        square += (np.float64(points[i, axis]) - np.float64(points[j, axis])) ** 2
    return square
