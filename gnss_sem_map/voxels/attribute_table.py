"""Attributes of the voxels of a table: last moments, and samples of intensities, in the last words of their rows.

The median of all points of a voxel would need all of them, so a voxel keeps a sample: every point up to 40, then every
second, fourth, ... in the order in which they come, 20 to 40 of them at any time.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import int64, njit
from numpy.typing import NDArray

WORDS = 7
"""Of a row: the last moment; points (4 bytes), exponent of the stride (1 byte) and sample."""
SAMPLE = 40
WAITS = -1
"""Level of a point that is not noted."""


def seen_of(
    intensity: NDArray[np.float32], stamps: NDArray[np.float64], valid: NDArray[np.bool_], epoch_us: int
) -> tuple[NDArray[np.int16], NDArray[np.int64]]:
    """Of the m points of a mask (n,): intensities in 0..1 as whole numbers up to 255, and Unix times in us.

    NaN counts as 0. `stamps` s is of each point, (n,), or one for all of them, (1,).
    """
    levels, moments_us = np.empty(len(valid), np.int16), np.empty(len(valid), np.int64)
    count = _find_seen(intensity, stamps, valid, epoch_us, levels, moments_us)
    return levels[:count], moments_us[:count]


def columns_of(rows: NDArray[np.int64]) -> tuple[NDArray[Any], ...]:
    """Those of `Attributes`, of the voxels of a table (slots, words) that have any."""
    last_at, points_at, stride_at = _places(rows)
    points = rows.view(np.int32)[:, points_at]
    slots = np.flatnonzero(points)
    slots = slots[np.argsort(rows[slots, 0])]
    intensity = np.empty(len(slots), np.uint8)
    _find_medians(rows.view(np.uint8), points, stride_at, slots, intensity)
    return rows[slots, 0], points[slots].astype(np.int64), rows[slots, last_at], intensity


@njit(cache=True, nogil=True)
def _find_seen(intensity, stamps, valid, epoch_us, levels, moments_us):
    count = 0
    for i in range(len(valid)):
        if valid[i]:
            value = np.float32(255) * intensity[i]
            levels[count] = int64(np.rint(min(value, np.float32(255)))) if value > 0 else 0  # not for NaN
            moments_us[count] = epoch_us + int64(np.rint(1e6 * stamps[min(i, len(stamps) - 1)]))
            count += 1
    return count


@njit(cache=True, nogil=True, inline="always")
def _places(rows):
    """Column of the last moment, of the points in the int32 view, and of the stride in that of bytes."""
    last_at = rows.shape[1] - WORDS
    return last_at, 2 * last_at + 2, 8 * last_at + 12


@njit(cache=True, nogil=True, inline="always")
def note(rows, ints, bytes_, slot, levels, moments_us, first, end):
    """Note some points of one voxel in its row; `ints` and `bytes_` are views of the rows."""
    last_at, points_at, stride_at = _places(rows)
    points, stride, last = int64(ints[slot, points_at]), int64(bytes_[slot, stride_at]), rows[slot, last_at]
    for i in range(first, end):
        if levels[i] < 0:
            continue
        last = max(last, moments_us[i]) if points > 0 else moments_us[i]
        if points & ((1 << stride) - 1) == 0:
            place = points >> stride
            if place == SAMPLE:
                for j in range(SAMPLE // 2):
                    bytes_[slot, stride_at + 1 + j] = bytes_[slot, stride_at + 1 + 2 * j]
                place, stride = SAMPLE // 2, stride + 1
            bytes_[slot, stride_at + 1 + place] = levels[i]
        points += 1
    ints[slot, points_at], bytes_[slot, stride_at], rows[slot, last_at] = points, stride, last


@njit(cache=True, nogil=True)
def _find_medians(bytes_, points, stride_at, slots, medians):
    """The lower median of the sample of each of some rows: the least level that half of it does not exceed."""
    for n in range(len(slots)):
        slot = slots[n]
        stride, begin = int64(bytes_[slot, stride_at]), stride_at + 1
        count = (int64(points[slot]) + (1 << stride) - 1) >> stride
        low, high = 0, 255
        while low < high:
            middle, below = (low + high) >> 1, 0
            for i in range(begin, begin + count):
                below += bytes_[slot, i] <= middle
            low, high = (low, middle) if 2 * below >= count else (middle + 1, high)
        medians[n] = low
