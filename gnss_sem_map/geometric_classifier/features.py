"""Features of what is around a voxel: shape, height, column, step, intensity; nothing of where a camera looked.

Sums of whole numbers in windows of cells, on three levels (cells of one, two and four voxels), give the covariance of
the voxels around each one, and so its eigenvalues (Weinmann et al. 2015); lowest and highest voxels of columns, on
three levels as well, say how high it lies over what is around it. The sums are exact, so a voxel has the same features
in a part of a map as in the whole, as long as `REACH_M` around it is in the part.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gnss_sem_map.refinement import height_above_ground
from gnss_sem_map.refinement.height_above_ground import height_over_ground
from gnss_sem_map.voxels.kernels import AXIS_BITS, AXIS_MASK, HEIGHT_UNITS
from gnss_sem_map.voxels.voxel_map import VoxelMap

LEVELS = (0, 1, 2)
"""Cells of 2^level voxels: windows of 5 x 5 x 5 cells are 1, 2 and 4 m wide for voxels of 0.2 m."""
COLUMN_LEVELS = (1, 2, 3)
"""Columns of 2^level voxels: windows of 5 x 5 columns are 2, 4 and 8 m wide."""
WINDOW = 2
"""Cells to each side."""
TALL = 8
"""Voxels: what is so high over the lowest of its column stands upright, 1.6 m."""

OF_SHAPE = (
    "count", "linearity", "planarity", "scattering", "normal_z", "axis_z", "roughness", "spread_z", "above_mean",
    "intensity_mean", "intensity_spread", "intensity_above_mean",
)  # fmt: skip
OF_COLUMN = (
    "column_count",
    "column_above",
    "column_below",
    "gap_above",
    "gap_below",
    "run_above",
    "run_below",
)
OF_AREA = ("above_lowest", "above_mean_lowest", "lowest_spread", "highest_above", "tall_share", "columns")
NAMES = (
    "height", "intensity", *OF_COLUMN,
    *(f"{name}_{level}" for level in LEVELS for name in OF_SHAPE),
    *(f"{name}_{level}" for level in COLUMN_LEVELS for name in OF_AREA),
)  # fmt: skip
"""Of the columns of `features_of`; a model that was trained on others is refused."""
OF_INTENSITY = tuple(name for name in NAMES if name.startswith("intensity"))

MOMENTS = 12
"""n, x, y, z, xx, xy, xz, yy, yz, zz, intensity and its square."""


def reach_m(voxel_size_m: float) -> float:
    """How far around a voxel its features read, m."""
    return height_above_ground.REACH_M + (WINDOW + 1) * voxel_size_m * (1 << max(COLUMN_LEVELS))


def features_of(
    voxels: VoxelMap, intensity: NDArray[np.uint8], places: NDArray[np.int64] | None = None
) -> NDArray[np.float32]:
    """Features (p, f) of the voxels at increasing places (p,), by default of all; those around them say what they are.

    `intensity` (v,) of every voxel, 0 to 255. Lengths are in voxels, but for the height over ground, m.
    """
    heights = height_over_ground(voxels.centres)
    places = np.arange(len(voxels)) if places is None else places
    found = np.empty((len(places), len(NAMES)), np.float32)
    found[:, 0], found[:, 1] = heights[places], intensity[places]
    z, at = _fine_z(voxels), 2
    _columns(voxels.keys, places, found, at)
    at += len(OF_COLUMN)
    for level in LEVELS:
        cells = _Cells.of(voxels.keys, level)
        sums = np.zeros((len(cells.keys), MOMENTS), np.int32)
        _add_moments(voxels.keys, z, intensity, cells.of_voxel, level, sums)
        shapes = np.empty((len(cells.keys), len(OF_SHAPE) - 1), np.float32)
        _shapes(cells.keys, sums, cells.with_any(places), level, shapes)
        _of_shape(z, intensity, cells.of_voxel, places, level, shapes, found, at)
        at += len(OF_SHAPE)
    for level in COLUMN_LEVELS:
        cells = _Cells.of(voxels.keys, level, flat=True)
        lows, area = np.empty((len(cells.keys), 3), np.int64), np.zeros((len(cells.keys), 6), np.float64)
        _lows(voxels.keys, z, cells.of_voxel, lows)
        _areas(cells.keys, lows, cells.with_any(places), area)
        _of_area(z, cells.of_voxel, places, area, found, at)
        at += len(OF_AREA)
    return found


def _fine_z(voxels: VoxelMap) -> NDArray[np.int64]:
    """Mean height of the points of every voxel (v,) in 1/256 of its edge, in the middle where it is unknown."""
    inside = np.full(len(voxels), HEIGHT_UNITS // 2, np.int64)
    if voxels.heights is not None:
        inside = voxels.heights // np.maximum(voxels.hits, 1).astype(np.int64)
    return (voxels.keys & AXIS_MASK) * HEIGHT_UNITS + inside


@dataclass(frozen=True, eq=False)
class _Cells:
    """Cells of 2^level voxels that hold any, sorted by key, and the cell of every voxel."""

    keys: NDArray[np.int64]
    of_voxel: NDArray[np.int64]

    @classmethod
    def of(cls, keys: NDArray[np.int64], level: int, flat: bool = False) -> _Cells:
        """`flat`: columns, which have no height."""
        if level == 0 and not flat:
            return cls(keys, np.arange(len(keys)))
        coarse = np.empty(len(keys), np.int64)
        _coarsen(keys, level, flat, coarse)
        order = np.argsort(coarse, kind="stable")
        of_voxel = np.empty(len(keys), np.int64)
        cells = np.empty(len(keys), np.int64)
        count = _number(coarse, order, of_voxel, cells)
        return cls(cells[:count].copy(), of_voxel)

    def with_any(self, places: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which cells hold any of the voxels at these places."""
        found = np.zeros(len(self.keys), np.bool_)
        found[self.of_voxel[places]] = True
        return found


@njit(cache=True, nogil=True)
def _coarsen(keys, level, flat, coarse):
    for i in range(len(keys)):
        x, y, z = keys[i] >> 2 * AXIS_BITS, keys[i] >> AXIS_BITS & AXIS_MASK, keys[i] & AXIS_MASK
        coarse[i] = x >> level << 2 * AXIS_BITS | y >> level << AXIS_BITS | (0 if flat else z >> level)


@njit(cache=True, nogil=True)
def _number(coarse, order, of_voxel, cells):
    count = -1
    for i in order:
        if count < 0 or coarse[i] != cells[count]:
            count += 1
            cells[count] = coarse[i]
        of_voxel[i] = count
    return count + 1


@njit(cache=True, nogil=True)
def _columns(keys, places, found, at):
    """What is over and under a voxel in its own column."""
    for p in range(len(places)):
        i = places[p]
        column = keys[i] >> AXIS_BITS
        first, last = i, i
        while first > 0 and keys[first - 1] >> AXIS_BITS == column:
            first -= 1
        while last + 1 < len(keys) and keys[last + 1] >> AXIS_BITS == column:
            last += 1
        up, down = i, i
        while up < last and keys[up + 1] == keys[up] + 1:
            up += 1
        while down > first and keys[down - 1] == keys[down] - 1:
            down -= 1
        found[p, at] = last - first + 1
        found[p, at + 1] = keys[last] - keys[i]
        found[p, at + 2] = keys[i] - keys[first]
        found[p, at + 3] = keys[up + 1] - keys[up] if up < last else 0
        found[p, at + 4] = keys[down] - keys[down - 1] if down > first else 0
        found[p, at + 5] = keys[up] - keys[i]
        found[p, at + 6] = keys[i] - keys[down]


@njit(cache=True, nogil=True)
def _add_moments(keys, z, intensity, of_voxel, level, sums):
    """Moments of every cell, around its own first corner: x and y in voxels, z in 1/256 voxel."""
    mask = (1 << level) - 1
    for i in range(len(keys)):
        x, y = keys[i] >> 2 * AXIS_BITS & mask, keys[i] >> AXIS_BITS & mask
        h = z[i] & ((HEIGHT_UNITS << level) - 1)
        v = np.int64(intensity[i])
        s = sums[of_voxel[i]]
        s[0] += 1
        s[1] += x
        s[2] += y
        s[3] += h
        s[4] += x * x
        s[5] += x * y
        s[6] += x * h
        s[7] += y * y
        s[8] += y * h
        s[9] += h * h
        s[10] += v
        s[11] += v * v


@njit(cache=True, nogil=True)
def _shapes(keys, sums, wanted, level, shapes):
    """Of each wanted cell the moments of its window, around its own first corner, and the shape that follows."""
    side = 2 * WINDOW + 1
    ahead = np.zeros(
        side * side, np.int64
    )  # of each column of cells in the window, the first one that may be in it
    size, tall = np.int64(1 << level), np.int64(HEIGHT_UNITS << level)
    total = np.empty(MOMENTS, np.int64)
    for i in range(len(keys)):
        if not wanted[i]:
            continue
        total[:] = 0
        for dx in range(-WINDOW, WINDOW + 1):
            for dy in range(-WINDOW, WINDOW + 1):
                low = keys[i] + (dx << 2 * AXIS_BITS) + (dy << AXIS_BITS) - WINDOW
                column = (dx + WINDOW) * side + dy + WINDOW
                j = ahead[column]
                while j < len(keys) and keys[j] < low:
                    j += 1
                ahead[column] = j
                while j < len(keys) and keys[j] <= low + 2 * WINDOW:
                    s, n = sums[j], np.int64(sums[j, 0])
                    x, y, h = dx * size, dy * size, (keys[j] - low - WINDOW) * tall
                    total[0] += n
                    total[1] += s[1] + n * x
                    total[2] += s[2] + n * y
                    total[3] += s[3] + n * h
                    total[4] += s[4] + 2 * x * s[1] + n * x * x
                    total[5] += s[5] + x * s[2] + y * s[1] + n * x * y
                    total[6] += s[6] + x * s[3] + h * s[1] + n * x * h
                    total[7] += s[7] + 2 * y * s[2] + n * y * y
                    total[8] += s[8] + y * s[3] + h * s[2] + n * y * h
                    total[9] += s[9] + 2 * h * s[3] + n * h * h
                    total[10] += s[10]
                    total[11] += s[11]
                    j += 1
        _shape(total, shapes[i])


@njit(cache=True, nogil=True, error_model="numpy")
def _shape(total, shape):
    """Eigenvalues of the covariance, in closed form (Smith 1961), and means and spreads."""
    n, unit = np.float64(total[0]), 1.0 / HEIGHT_UNITS
    mx, my, mz = total[1] / n, total[2] / n, total[3] / n * unit
    a = total[4] / n - mx * mx
    b = total[7] / n - my * my
    c = total[9] / n * unit * unit - mz * mz
    d = total[5] / n - mx * my
    e = total[6] / n * unit - mx * mz
    f = total[8] / n * unit - my * mz
    mean = (a + b + c) / 3
    p = np.sqrt(
        max(((a - mean) ** 2 + (b - mean) ** 2 + (c - mean) ** 2 + 2 * (d * d + e * e + f * f)) / 6, 1e-12)
    )
    u, v, w = (a - mean) / p, (b - mean) / p, (c - mean) / p
    q, r, s = d / p, e / p, f / p
    half = (u * (v * w - s * s) - q * (q * w - s * r) + r * (q * s - v * r)) / 2
    angle = np.arccos(min(max(half, -1.0), 1.0)) / 3
    largest = mean + 2 * p * np.cos(angle)
    smallest = mean + 2 * p * np.cos(angle + 2 * np.pi / 3)
    middle = 3 * mean - largest - smallest
    over = max(largest, 1e-6)
    shape[0] = n
    shape[1] = (largest - middle) / over
    shape[2] = (middle - smallest) / over
    shape[3] = max(smallest, 0.0) / over
    shape[4] = _z_of_axis(a, b, c, d, e, f, smallest)
    shape[5] = _z_of_axis(a, b, c, d, e, f, largest)
    shape[6] = np.sqrt(max(smallest, 0.0))
    shape[7] = np.sqrt(max(c, 0.0))
    shape[8] = mz
    shape[9] = total[10] / n
    shape[10] = np.sqrt(max(total[11] / n - shape[9] * shape[9], 0.0))


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _z_of_axis(a, b, c, d, e, f, value):
    """|z| of the unit eigenvector of an eigenvalue: the longest cross product of two rows."""
    ax, ay, az = a - value, d, e
    bx, by, bz = d, b - value, f
    cx, cy, cz = e, f, c - value
    x1, y1, z1 = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    x2, y2, z2 = ay * cz - az * cy, az * cx - ax * cz, ax * cy - ay * cx
    x3, y3, z3 = by * cz - bz * cy, bz * cx - bx * cz, bx * cy - by * cx
    n1, n2, n3 = x1 * x1 + y1 * y1 + z1 * z1, x2 * x2 + y2 * y2 + z2 * z2, x3 * x3 + y3 * y3 + z3 * z3
    n, z = (n1, z1) if n1 >= n2 and n1 >= n3 else ((n2, z2) if n2 >= n3 else (n3, z3))
    return abs(z) / np.sqrt(n) if n > 1e-18 else 0.0


@njit(cache=True, nogil=True)
def _of_shape(z, intensity, of_voxel, places, level, shapes, found, at):
    mask, unit = (HEIGHT_UNITS << level) - 1, 1.0 / HEIGHT_UNITS
    for p in range(len(places)):
        i = places[p]
        shape = shapes[of_voxel[i]]
        for k in range(8):
            found[p, at + k] = shape[k]
        found[p, at + 8] = (z[i] & mask) * unit - shape[8]
        found[p, at + 9], found[p, at + 10] = shape[9], shape[10]
        found[p, at + 11] = intensity[i] - shape[9]


@njit(cache=True, nogil=True)
def _lows(keys, z, of_voxel, lows):
    """Lowest and highest of every column, and whether it is tall."""
    lows[:, 0], lows[:, 1] = 1 << 62, -1
    for i in range(len(keys)):
        low = lows[of_voxel[i]]
        low[0], low[1] = min(low[0], z[i]), max(low[1], z[i])
    for k in range(len(lows)):
        lows[k, 2] = lows[k, 1] - lows[k, 0] >= TALL * HEIGHT_UNITS


@njit(cache=True, nogil=True)
def _areas(keys, lows, wanted, area):
    """Of the columns in the window of each wanted one: lowest, mean and spread of lows, highest, share tall, number."""
    side = 2 * WINDOW + 1
    ahead = np.zeros(side, np.int64)
    unit = 1.0 / HEIGHT_UNITS
    for i in range(len(keys)):
        if not wanted[i]:
            continue
        n, tall, total, squares = np.int64(0), np.int64(0), np.int64(0), np.int64(0)
        lowest, highest, own = lows[i, 0], lows[i, 1], lows[i, 0]
        for dx in range(-WINDOW, WINDOW + 1):
            first = keys[i] + (dx << 2 * AXIS_BITS) - (WINDOW << AXIS_BITS)
            last, j = first + (2 * WINDOW << AXIS_BITS), ahead[dx + WINDOW]
            while j < len(keys) and keys[j] < first:
                j += 1
            ahead[dx + WINDOW] = j
            while j < len(keys) and keys[j] <= last:
                over = lows[j, 0] - own
                n, tall, total, squares = n + 1, tall + lows[j, 2], total + over, squares + over * over
                lowest, highest = min(lowest, lows[j, 0]), max(highest, lows[j, 1])
                j += 1
        mean = total / n
        area[i, 0] = lowest
        area[i, 1] = own + mean
        area[i, 2] = np.sqrt(max(squares / n - mean * mean, 0.0)) * unit
        area[i, 3] = highest
        area[i, 4] = tall / n
        area[i, 5] = n


@njit(cache=True, nogil=True)
def _of_area(z, of_voxel, places, area, found, at):
    unit = 1.0 / HEIGHT_UNITS
    for p in range(len(places)):
        i = places[p]
        of = area[of_voxel[i]]
        found[p, at] = (z[i] - of[0]) * unit
        found[p, at + 1] = (z[i] - of[1]) * unit
        found[p, at + 2] = of[2]
        found[p, at + 3] = (of[3] - z[i]) * unit
        found[p, at + 4], found[p, at + 5] = of[4], of[5]
