"""What every scan saw, and what it looked through: range images, and the evidence of free space in them.

A place that other scans look through was empty at their time. A place that they hit was not.
"""

from __future__ import annotations

import numpy as np
from numba import int64, njit
from numpy.typing import NDArray

ROWS, COLUMNS = 68, 900
LOWEST_DEG, ROW_DEG, COLUMN_DEG = -25.2, 0.42, 0.4
"""Elevation and azimuth of the pixels: the 64 beams of a HDL-64E, a little finer than it."""
NEAREST_M = 2.5
"""Returns nearer than this are the carrier itself."""
UNITS_PER_M = 100
EMPTY = np.uint16(65535)
LEAST_FILLED = 3
"""A 3 x 3 window with fewer returns says nothing: sky, glass, or the edge of the view."""


@njit(cache=True, nogil=True)
def _pixel(x, y, z, r):
    row = int64(np.floor((np.degrees(np.arcsin(z / r)) - LOWEST_DEG) / ROW_DEG))
    column = int64(np.floor((np.degrees(np.arctan2(y, x)) + 180.0) / COLUMN_DEG)) % COLUMNS
    return row, column


@njit(cache=True, nogil=True)
def draw(p_map, T_lidar_map, image):
    """Draw the points (n, 3) of a scan into its range image (68, 900) of cm: the nearest return of each pixel."""
    T = T_lidar_map
    for i in range(len(p_map)):
        x = T[0, 0] * p_map[i, 0] + T[0, 1] * p_map[i, 1] + T[0, 2] * p_map[i, 2] + T[0, 3]
        y = T[1, 0] * p_map[i, 0] + T[1, 1] * p_map[i, 1] + T[1, 2] * p_map[i, 2] + T[1, 3]
        z = T[2, 0] * p_map[i, 0] + T[2, 1] * p_map[i, 1] + T[2, 2] * p_map[i, 2] + T[2, 3]
        r = np.sqrt(x * x + y * y + z * z)
        if not NEAREST_M <= r < 650.0:
            continue
        row, column = _pixel(x, y, z, r)
        if 0 <= row < ROWS:
            image[row, column] = min(image[row, column], np.uint16(r * UNITS_PER_M))


@njit(cache=True, nogil=True)
def _look(image, row, column, r, margin_m):
    """What one scan says of a place at range r: 1 it was hit, -1 seen through, 0 hidden or unknown."""
    filled, rows = 0, 0
    nearer = False
    for dr in range(max(row - 1, 0), min(row + 2, ROWS)):
        for dc in range(column - 1, column + 2):
            seen = image[dr, dc % COLUMNS]
            if seen == EMPTY:
                continue
            filled += 1
            rows |= 1 << (dr - row + 1)
            difference = seen / UNITS_PER_M - r
            if abs(difference) <= margin_m:
                return 1
            nearer = nearer or difference < 0
    around = rows & 0b010 or rows == 0b101  # beams passed at its height, or both above and below
    return -1 if around and filled >= LEAST_FILLED and not nearer else 0


@njit(cache=True, nogil=True)
def hidden_sides(p_map, segments, T_lidar_map, image, count, margin_m):
    """Segments (count,) of a scan that go on behind something nearer, to the left or to the right.

    The sides of a segment are its outermost columns; something nearer in the next ones hides what is there.
    """
    n, T = len(segments), T_lidar_map
    rows, columns, ranges = np.empty(n, np.int64), np.empty(n, np.int64), np.empty(n)
    first = np.full(count, -1, np.int64)
    low, high = np.zeros(count, np.int64), np.zeros(count, np.int64)
    for i in range(n):
        s = segments[i]
        if s < 0:
            continue
        x, y, z = p_map[i, 0], p_map[i, 1], p_map[i, 2]
        xl = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
        yl = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
        zl = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
        ranges[i] = np.sqrt(xl * xl + yl * yl + zl * zl)
        rows[i], columns[i] = _pixel(xl, yl, zl, ranges[i])
        if first[s] < 0:
            first[s] = columns[i]
        columns[i] = (
            columns[i] - first[s] + COLUMNS // 2
        ) % COLUMNS - COLUMNS // 2  # across the seam at the rear
        low[s], high[s] = min(low[s], columns[i]), max(high[s], columns[i])
    looks, hidden = np.zeros((count, 2), np.int64), np.zeros((count, 2), np.int64)
    for i in range(n):
        s = segments[i]
        if s < 0 or not 0 <= rows[i] < ROWS:
            continue
        for side, edge, step in ((0, low[s], -1), (1, high[s], 1)):
            if abs(columns[i] - edge) > 1:
                continue
            looks[s, side] += 1
            for beyond in range(1, 4):
                seen = image[rows[i], (columns[i] + first[s] + step * beyond) % COLUMNS]
                if seen != EMPTY and seen / UNITS_PER_M < ranges[i] - margin_m:
                    hidden[s, side] += 1
                    break
    result = np.zeros(count, np.bool_)
    for s in range(count):
        result[s] = 3 * hidden[s, 0] > looks[s, 0] or 3 * hidden[s, 1] > looks[s, 1]
    return result


@njit(cache=True, nogil=True)
def look_at(places, images, T_lidar_map, nearest_m, farthest_m, margin_m, margin_ratio, hits, throughs):
    """Count for every place (m, 3) the scans that hit it and those that saw through it.

    `images` (k, 68, 900), `T_lidar_map` (k, 4, 4); only scans with the place in range count, with a margin that
    grows with range.
    """
    for i in range(len(places)):
        for k in range(len(images)):
            T = T_lidar_map[k]
            x = T[0, 0] * places[i, 0] + T[0, 1] * places[i, 1] + T[0, 2] * places[i, 2] + T[0, 3]
            y = T[1, 0] * places[i, 0] + T[1, 1] * places[i, 1] + T[1, 2] * places[i, 2] + T[1, 3]
            if x * x + y * y > farthest_m * farthest_m:
                continue
            z = T[2, 0] * places[i, 0] + T[2, 1] * places[i, 1] + T[2, 2] * places[i, 2] + T[2, 3]
            r = np.sqrt(x * x + y * y + z * z)
            if not nearest_m <= r <= farthest_m:
                continue
            row, column = _pixel(x, y, z, r)
            if not 0 <= row < ROWS:
                continue
            seen = _look(images[k], row, column, r, margin_m + margin_ratio * r)
            hits[i] += seen == 1
            throughs[i] += seen == -1


def empty_image() -> NDArray[np.uint16]:
    """A range image in which nothing was seen."""
    return np.full((ROWS, COLUMNS), EMPTY, np.uint16)
