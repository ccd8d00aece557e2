"""Voxel-grid downsampling: one point per cube. At 0.5 m a tenth of the points remains, enough for registration."""

from __future__ import annotations

import numpy as np
from numba import int64, njit
from numpy.typing import NDArray

from gnss_sem_map.scans.kernels import COLUMNS, coordinates, is_usable
from gnss_sem_map.sensor_log import Points
from gnss_sem_map.voxels.hash_table import slot_of, slots_of
from gnss_sem_map.voxels.hash_unique import FEWEST_SLOTS, distinct
from gnss_sem_map.voxels.kernels import pack_keys, run_starts

SLOTS_PER_S = 20.0
"""Points of one cube are averaged if they were measured within the same 50 ms: where a sweep begins and ends, one cube
holds points of two places, because the vehicle has moved on."""
INDEX_BITS, SLOT_BITS = 20, 3
"""Bits of a key: of each index of its cube, and of the number of its 50 ms."""
MEANS = 5
"""Columns of a cube: the means of x, y, z, intensity and stamp."""


def one_per_cube(points: NDArray[np.float64], edge_m: float) -> NDArray[np.float64]:
    """The mean (c, 3) m of the points (n, 3) m in each occupied cube of this edge length, in the order of the keys."""
    keys = np.empty(len(points), np.int64)
    pack_keys(points, edge_m, keys)
    cubes, cube = distinct(keys)
    means = np.zeros((len(cubes), 3))
    _mean(points, cube, means)
    return means


def thinned(points: Points, edge_m: float, nearest_m: float, farthest_m: float) -> Points:
    """The means of the usable points of a sweep, stamps included, in each occupied cube of this edge length.

    Deskewing a mean is as good as averaging deskewed points: within a cube and 50 ms, the pose is linear in time. Cubes
    are in order of appearance. Compiled, and releases the GIL: scans are prepared while others are matched.
    """
    stamps = np.empty(0) if points.stamps is None else points.stamps
    means = np.empty((len(points.xyz), MEANS))
    means = means[: _thin(points.rows, stamps, edge_m, nearest_m, farthest_m, means)]
    rows = means[:, :4].astype(np.float32)
    return Points(rows[:, :3], rows[:, 3], None if points.stamps is None else means[:, 4].copy())


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


@njit(cache=True, nogil=True, error_model="numpy")
def _thin(rows, stamps, edge_m, nearest_m, farthest_m, means):
    """Average the usable points (4 n,) of each cube into `means`; returns the number of cubes.

    Consecutive points of a scan are often in the same cube: their sums stay in registers, and need one look-up.
    """
    keys = _keys(rows, stamps, edge_m, nearest_m, farthest_m)
    starts, is_timed = run_starts(keys, 0), len(stamps) > 0
    count, size = 0, FEWEST_SLOTS
    slots = np.full(size, -1, np.int32)
    cubes, counts = np.empty(len(keys), np.int64), np.empty(len(keys), np.int64)
    for run in range(len(starts) - 1):
        first, end = starts[run], starts[run + 1]
        if keys[first] == 0:
            continue
        slot = slot_of(keys[first], cubes, slots, size)
        if slots[slot] < 0:
            slots[slot], cubes[count], counts[count], means[count] = count, keys[first], 0, 0.0
            count += 1
        row = slots[slot]
        if 2 * count > size:
            size *= 2
            slots = slots_of(cubes, count, size)
        sums = means[row]
        x, y, z, intensity, stamp = sums[0], sums[1], sums[2], sums[3], sums[4]
        for i in range(first, end):
            x += rows[4 * i]
            y += rows[4 * i + 1]
            z += rows[4 * i + 2]
            intensity += rows[4 * i + 3]
            if is_timed:
                stamp += stamps[i]
        sums[0], sums[1], sums[2], sums[3], sums[4] = x, y, z, intensity, stamp
        counts[row] += end - first
    for row in range(count):
        means[row] /= counts[row]
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def _keys(rows, stamps, edge_m, nearest_m, farthest_m):
    """Key (n,) of the cube of each point, at one time of several; 0 for a point that is not usable."""
    keys = np.empty(len(rows) // COLUMNS, np.int64)
    for i in range(len(keys)):
        x, y, z = coordinates(rows, i)
        stamp = stamps[i] if len(stamps) > 0 else 0.0
        key = _key(x / edge_m, y / edge_m, z / edge_m, stamp * SLOTS_PER_S)
        keys[i] = key if is_usable(x, y, z, stamp, nearest_m, farthest_m) else 0
    return keys


@njit(cache=True, nogil=True, inline="always")
def _key(i, j, k, slot):
    """Key of a cube, at one time of several, never 0; indices are taken modulo their number."""
    cells, slots = (1 << INDEX_BITS) - 1, 1 << SLOT_BITS
    key = slots | (int64(np.floor(slot)) & (slots - 1))
    for index in (i, j, k):
        key = (key << INDEX_BITS) | (int64(np.floor(index)) & cells)
    return key
