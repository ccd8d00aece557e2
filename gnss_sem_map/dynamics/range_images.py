"""Range images of scans, and the visibility test for free-space evidence.

A position that a scan saw through was free at that time (a miss); a position that it hit was occupied. The test
compares the range of the position with the ranges in a 3 x 3 window of the range image, as in Kim and Kim, "Remove,
then Revert: Static Point Cloud Map Construction using Multiresolution Range Images" (IROS 2020), here with one
resolution. Points are processed in blocks, with arithmetic apart from table look-ups, so that the compiler can use SIMD
instructions.
"""

from __future__ import annotations

import numpy as np
from numba import int32, njit, uint16
from numpy.typing import NDArray

from gnss_sem_map.dynamics.image_rows import CELL_DEG, CELLS, LOWEST_DEG, Rows
from gnss_sem_map.scans.angles import atan2_deg

COLUMNS, COLUMN_DEG = 900, 0.4
WIDTH = COLUMNS + 2
"""An image has a margin of one pixel left and right, the column from the other side; its first row is empty."""
NEAREST_M, FARTHEST_M = 2.5, 650.0
"""Nearer returns are of the vehicle that carries the LiDAR; farther ones do not fit the 16 bits of a pixel."""
UNITS_PER_M = 100
EMPTY = np.uint16(65535)
SLENDER = 0.7
"""A sphere of more than this share of its distance as its radius is not asked whether it is hidden."""
LEAST_FILLED = 3
"""A 3 x 3 window with fewer returns is no evidence: sky, glass, or the edge of the view."""
BLOCK = 1024
CLUSTER = 128
"""Positions in a row that are hidden together: they should be neighbours, see `visibility.spatial_order`."""


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _cell(x, y, z):
    """Cell of elevation, see `image_rows`."""
    cell = int32(np.floor((atan2_deg(z, np.sqrt(x * x + y * y)) - LOWEST_DEG) / CELL_DEG))
    return cell if 0 <= cell < CELLS else 0  # straight up is in no row


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _column(x, y):
    """Column without the margin."""
    column = int32(np.floor((atan2_deg(y, x) + 180.0) / COLUMN_DEG))
    return column if 0 <= column < COLUMNS else 0


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _in_lidar(T, p_map, i):
    x, y, z = p_map[3 * i], p_map[3 * i + 1], p_map[3 * i + 2]
    return (
        T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3],
        T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3],
        T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3],
    )


@njit(cache=True, nogil=True, error_model="numpy")
def draw(p_map, T_lidar_map, row_of, image):
    """Draw the points (n, 3) of a scan into its range image of cm: the nearest return of each pixel.

    `row_of` (CELLS,) is the row of a return in each cell of elevation, 0 for none.
    """
    cells, columns = np.empty(BLOCK, np.int32), np.empty(BLOCK, np.int32)
    depths = np.empty(BLOCK, np.uint16)
    drawn = image.reshape(-1)
    for start in range(0, len(p_map), BLOCK):
        here = p_map[start : start + BLOCK].reshape(-1)
        for i in range(len(here) // 3):
            x, y, z = _in_lidar(T_lidar_map, here, i)
            cells[i], columns[i] = _cell(x, y, z), _column(x, y)
            r = np.sqrt(x * x + y * y + z * z)
            depths[i] = r * UNITS_PER_M if (r >= NEAREST_M) & (r < FARTHEST_M) else EMPTY
        for i in range(len(here) // 3):
            row = row_of[cells[i]]
            pixel = row * WIDTH + columns[i] + 1
            drawn[pixel] = min(drawn[pixel], depths[i] if row > 0 else EMPTY)
    for row in range(len(image)):
        image[row, 0], image[row, -1] = image[row, -2], image[row, 1]


@njit(cache=True, nogil=True, error_model="numpy")
def hidden_sides(p_map, segments, T_lidar_map, row_of, image, count, margin_m):
    """Mask (count,) of the segments of a scan that are seen in part, as something hides the left or the right of them.

    The sides of a segment are its outermost columns; nearer returns in the three columns beyond hide it. Where these
    hold no return at all, the view of the LiDAR ends.
    """
    members, flat = np.flatnonzero(segments >= 0), p_map.reshape(-1)
    segments, n = segments[members], len(members)
    columns, first = np.empty(n, np.int32), np.full(count, -1, np.int32)
    low, high = np.zeros(count, np.int32), np.zeros(count, np.int32)
    for i in range(n):
        x, y, _ = _in_lidar(T_lidar_map, flat, members[i])
        columns[i] = _column(x, y)
    for i in range(n):
        s = segments[i]
        if first[s] < 0:
            first[s] = columns[i]
        columns[i] -= first[s]
        if columns[i] >= COLUMNS // 2:  # across the seam at the rear
            columns[i] -= COLUMNS
        elif columns[i] < -(COLUMNS // 2):
            columns[i] += COLUMNS
        low[s], high[s] = min(low[s], columns[i]), max(high[s], columns[i])
    counts, hidden = np.zeros((count, 2), np.int64), np.zeros((count, 2), np.int64)
    is_blank = _without_returns(image)
    for i in range(n):
        s = segments[i]
        for side, edge, step in ((0, low[s], -1), (1, high[s], 1)):
            if abs(columns[i] - edge) > 1:
                continue
            x, y, z = _in_lidar(T_lidar_map, flat, members[i])
            row, nearest = row_of[_cell(x, y, z)], np.sqrt(x * x + y * y + z * z) - margin_m
            if row == 0:
                continue
            counts[s, side] += 1
            blank = 0
            for beyond in range(1, 4):
                column = (columns[i] + first[s] + step * beyond) % COLUMNS
                seen = image[row, column + 1]
                blank += is_blank[column]
                if blank == 3 or (seen != EMPTY and seen / UNITS_PER_M < nearest):
                    hidden[s, side] += 1
                    break
    result = np.zeros(count, np.bool_)
    for s in range(count):
        result[s] = 3 * hidden[s, 0] > counts[s, 0] or 3 * hidden[s, 1] > counts[s, 1]
    return result


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _without_returns(image):
    """Which columns of an image have no return in any row."""
    is_blank = np.ones(COLUMNS, np.bool_)
    for row in range(len(image)):
        for column in range(COLUMNS):
            is_blank[column] &= image[row, column + 1] == EMPTY
    return is_blank


@njit(cache=True, nogil=True, error_model="numpy")
def hidden_above_or_below(p_map, segments, T_lidar_map, row_of, elevations_rad, image, count, margin_m):
    """Mask (count,) of the segments of a scan that something nearer hides in part, above or below.

    At the points with no more of the segment in the next row it ends, or is hidden. What is nearer above them hides it.
    Below them the ground is nearer, too: only what is steep hides it. `elevations_rad` (h,) are those of the rows of
    the image.
    """
    members, flat = np.flatnonzero(segments >= 0), p_map.reshape(-1)
    counts, hidden = np.zeros((count, 2), np.int64), np.zeros((count, 2), np.int64)
    for i in members:
        x, y, z = _in_lidar(T_lidar_map, flat, i)
        r = np.sqrt(x * x + y * y + z * z)
        row, column, s = row_of[_cell(x, y, z)], _column(x, y), segments[i]
        for side, step in ((0, 1), (1, -1)):
            beyond = row + step
            if row == 0 or beyond < 1 or beyond >= len(image):
                continue
            seen = image[beyond, column + 1] / UNITS_PER_M
            if abs(seen - r) < margin_m:
                continue
            counts[s, side] += 1
            if seen < r and (side == 0 or _is_steep(image, elevations_rad, beyond, column + 1)):
                hidden[s, side] += 1
    result = np.zeros(count, np.bool_)
    for s in range(count):
        result[s] = 3 * hidden[s, 0] > counts[s, 0] or 3 * hidden[s, 1] > counts[s, 1]
    return result


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _is_steep(image, elevations_rad, row, column):
    """Whether a return and the one in the row below lie above each other, rather than behind each other."""
    if row < 2 or image[row - 1, column] == EMPTY:
        return False
    upper, lower = image[row, column], image[row - 1, column]
    e, f = elevations_rad[row], elevations_rad[row - 1]
    rise = upper * np.sin(e) - lower * np.sin(f)
    return rise > abs(upper * np.cos(e) - lower * np.cos(f))


@njit(cache=True, nogil=True, error_model="numpy")
def count_hits_and_misses(
    positions,
    images,
    T_lidar_map,
    around,
    chosen,
    nearest_m,
    farthest_m,
    margin_m,
    margin_ratio,
    hits,
    misses,
):
    """Count for every position (m, 3) m the scans that hit it and those that saw through it; adds to `hits`, `misses`.

    `images` (k, h, 902) cm, `T_lidar_map` (k, 4, 4), of which those at the places `chosen` are asked; `around`
    (CELLS, 3) are the rows that tell of each cell of elevation. Only scans with the position in range count. A return
    is a hit within a margin that grows with range.
    """
    limits = nearest_m, farthest_m, margin_m, margin_ratio
    cells, columns = np.empty(CLUSTER, np.int32), np.empty(CLUSTER, np.int32)
    lows, highs = np.empty(CLUSTER, np.uint16), np.empty(CLUSTER, np.uint16)
    windows, is_before = np.empty((9, CLUSTER), np.uint16), np.empty(CLUSTER, np.bool_)
    for start in range(0, len(positions), CLUSTER):
        of_cluster = slice(start, start + CLUSTER)
        here, hits_here, misses_here = positions[of_cluster], hits[of_cluster], misses[of_cluster]
        centre, radius = _sphere_around(here)
        for k in chosen:
            T, drawn = T_lidar_map[k], images[k].reshape(-1)
            if _is_hidden(centre, radius, T, around, drawn, farthest_m, margin_m, margin_ratio):
                continue
            _project(here, T, limits, cells, columns, lows, highs)
            _copy_windows(drawn, around, cells[: len(here)], columns, windows)
            _test_visibility(windows, lows, highs, hits_here, is_before)
            for i in range(len(here)):
                if is_before[i]:
                    misses_here[i] += _is_seen_through(windows[:, i])


@njit(cache=True, nogil=True, error_model="numpy")
def _project(positions, T_lidar_map, limits, cells, columns, lows, highs):
    """Pixels of positions (m, 3) in a scan, and between which ranges a return hits each, cm: none if out of range."""
    nearest_m, farthest_m, margin_m, margin_ratio = limits
    nearest, farthest, flat = nearest_m * nearest_m, farthest_m * farthest_m, positions.reshape(-1)
    for i in range(len(positions)):
        x, y, z = _in_lidar(T_lidar_map, flat, i)
        square = x * x + y * y + z * z
        in_range, r = (square >= nearest) & (square <= farthest), np.sqrt(square)
        cells[i], columns[i] = _cell(x, y, z), _column(x, y)
        margin = margin_m + margin_ratio * r
        low = uint16(max(np.ceil(UNITS_PER_M * (r - margin)), 0.0))
        high = uint16(min(np.floor(UNITS_PER_M * (r + margin)), float(EMPTY - 1)))
        lows[i], highs[i] = low if in_range else EMPTY, high if in_range else uint16(0)


@njit(cache=True, nogil=True, error_model="numpy")
def _copy_windows(drawn, around, cells, columns, windows):
    """The 3 x 3 pixels (9, n) around positions: three columns in the rows below, at and above each."""
    for i in range(len(cells)):
        for row in range(3):
            at = around[cells[i], row] * WIDTH + columns[i]
            for column in range(3):
                windows[3 * row + column, i] = drawn[at + column]


@njit(cache=True, nogil=True, error_model="numpy")
def _test_visibility(windows, lows, highs, hits, is_before):
    """Count which positions (n,) have a return at their range, and mark those that lie before all their returns.

    Without a branch, and over windows side by side, so that the compiler can use SIMD instructions.
    """
    for i in range(len(hits)):
        hit, nearer = False, False
        for k in range(9):
            hit |= (lows[i] <= windows[k, i]) & (windows[k, i] <= highs[i])
            nearer |= windows[k, i] < lows[i]
        hits[i] += hit
        is_before[i] = not (hit | nearer)


@njit(cache=True, nogil=True, error_model="numpy")
def _is_seen_through(window):
    """Whether beams passed a position that lies before all returns of its window (9,)."""
    filled, rows = 0, 0
    for row in range(3):
        beams = 0
        for pixel in window[3 * row : 3 * row + 3]:
            beams += pixel != EMPTY
        filled += beams
        rows |= (beams > 0) << row
    between = rows & 0b010 or rows == 0b101  # in its row, or in the rows above and below
    return between and filled >= LEAST_FILLED


@njit(cache=True, nogil=True, error_model="numpy")
def _sphere_around(positions):
    """Centre and radius of a sphere that holds the positions (m, 3)."""
    low, high = positions[0].copy(), positions[0].copy()
    for position in positions:
        for axis in range(3):
            low[axis], high[axis] = min(low[axis], position[axis]), max(high[axis], position[axis])
    return (low + high) / 2, np.sqrt(((high - low) ** 2).sum()) / 2


@njit(cache=True, nogil=True, error_model="numpy")
def _is_hidden(centre, radius, T_lidar_map, around, drawn, farthest_m, margin_m, margin_ratio):
    """Whether a scan says nothing of any place in a sphere: out of its range or view, or behind all that it saw there.

    The window of pixels around the sphere is a little too large, and the range to it a little too small.
    """
    x, y, z = _in_lidar(T_lidar_map, centre, 0)
    level, distance = np.sqrt(x * x + y * y), np.sqrt(x * x + y * y + z * z)
    if distance - radius > farthest_m:
        return True
    if radius >= SLENDER * level:
        return False  # it is around the scan, or nearly so
    half = np.degrees(np.arcsin(radius / level))
    cell = (atan2_deg(z, level) - LOWEST_DEG) / CELL_DEG
    first, last = max(int(cell - half / CELL_DEG) - 1, 0), min(int(cell + half / CELL_DEG) + 2, CELLS)
    # from cell to cell no row falls: the first is the lowest and the last the highest; 0 is none
    rows = around[first:last].reshape(-1)
    first, last = 0, len(rows) - 1
    while first < last and rows[first] == 0:
        first += 1
    while first < last and rows[last] == 0:
        last -= 1
    lowest, count = rows[first], rows[last] - rows[first] + 1
    nearest = UNITS_PER_M * ((1 - margin_ratio) * (distance - radius) - margin_m) - 1
    column = (atan2_deg(y, x) + 180.0) / COLUMN_DEG
    first, last = int(column - half / COLUMN_DEG) - 2, int(column + half / COLUMN_DEG) + 3
    for i in range(count):
        at = (lowest + (i + count // 2) % count) * WIDTH + 1  # from the middle: there it is seen, if anywhere
        if first < 0 or last > COLUMNS:  # across the seam
            seen = max(
                _farthest(drawn, at, at + last % COLUMNS),
                _farthest(drawn, at + first % COLUMNS, at + COLUMNS),
            )
        else:
            seen = _farthest(drawn, at + first, at + last)
        if seen >= nearest:
            return False
    return True


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _farthest(drawn, start, end):
    """The largest of some pixels; those without a return count as 0."""
    largest = uint16(0)
    for i in range(start, end):
        largest = max(largest, uint16(drawn[i] + uint16(1)))  # EMPTY becomes 0
    return int32(largest) - 1


def gaps_at(
    p_map: NDArray[np.float64], T_lidar_map: NDArray[np.float64], rows: Rows
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The gap (n,) m between the rings above and below each point (n, 3) m of a scan, and the beams it has room for.

    Where rows adjoin these are 0 and 1.
    """
    if not rows.gaps_rad.any():  # a spinning LiDAR of 64 rings: 6 ms per scan that need not be
        return np.zeros(len(p_map)), np.ones(len(p_map))
    p_lidar = p_map @ T_lidar_map[:3, :3].T + T_lidar_map[:3, 3]
    ranges = np.linalg.norm(p_lidar, axis=1)
    elevations = np.degrees(np.arcsin(p_lidar[:, 2] / ranges))
    gaps_rad = rows.gaps_rad[((elevations - LOWEST_DEG) / CELL_DEG).astype(np.intp)]
    return ranges * gaps_rad, np.maximum(gaps_rad / np.radians(CELL_DEG), 1.0)


def empty_image(rows: Rows) -> NDArray[np.uint16]:
    """A range image without returns."""
    return np.full((rows.count + 1, WIDTH), EMPTY, np.uint16)
