"""Table of the attributes of voxels that scans are added to: last moments, and samples of intensities.

The median of all points of a voxel would need all of them, so a voxel keeps a sample: every point up to 40, then every
second, fourth, ... in the order in which they come, 20 to 40 of them at any time. A row is a cache line.
"""

from __future__ import annotations

import numpy as np
from numba import int64, njit
from numpy.typing import NDArray

from gnss_sem_map.voxels.attributes import Attributes
from gnss_sem_map.voxels.kernels import PREFETCH_AHEAD, find_or_insert, home, prefetch_row, rehash, run_starts
from gnss_sem_map.voxels.voxel_map import HIGHEST_LOAD

SMALLEST_TABLE = 1 << 17
WORDS = 8
"""Of a row: its key, the last moment, points and stride of the sample, the sample."""
KEY, LAST, FIRST_LEVEL = 0, 1, 24
POINTS = 4
"""In 4 bytes; the exponent of the stride is in the byte STRIDE."""
STRIDE = 20
SAMPLE = 8 * WORDS - FIRST_LEVEL
WAITS = -1
"""Level of a point that is not added."""


class AttributeTable:
    """Hash table of voxels; it grows as needed. Scans are added in one order, on which samples depend."""

    def __init__(self) -> None:
        self._rows, self._count = _empty(SMALLEST_TABLE), 0

    def add(self, keys: NDArray[np.int64], levels: NDArray[np.int16], moments_us: NDArray[np.int64]) -> None:
        """Add points (n,): their voxels, their intensities (see `seen_of`) or WAITS, and when they were measured."""
        done = 0
        while done < len(keys):
            rows = self._rows
            self._count, done = _add(
                rows, rows.view(np.uint32), rows.view(np.uint8), self._count, int(HIGHEST_LOAD * len(rows)),
                keys, levels, moments_us, done,
            )  # fmt: skip
            if done < len(keys):
                self._rows = _empty(len(rows) * 3 // 2)
                rehash(rows, self._rows)

    def attributes(self) -> Attributes:
        """Those of all voxels so far."""
        rows = self._rows
        filled = np.flatnonzero(rows[:, KEY])
        order = filled[np.argsort(rows[filled, KEY])]
        intensity = np.empty(len(order), np.uint8)
        _find_medians(rows.view(np.uint32), rows.view(np.uint8), order, intensity)
        points = rows.view(np.uint32)[order, POINTS].astype(np.int64)
        return Attributes(rows[order, KEY], points, rows[order, LAST], intensity)


def _empty(rows: int) -> NDArray[np.int64]:
    """A table of empty rows, each in a cache line."""
    room = np.zeros((rows + 1) * WORDS, np.int64)
    start = -room.ctypes.data // room.itemsize % WORDS
    return room[start : start + rows * WORDS].reshape(rows, WORDS)


def seen_of(
    intensity: NDArray[np.float32], stamps: NDArray[np.float64], valid: NDArray[np.bool_], epoch_us: int
) -> tuple[NDArray[np.int16], NDArray[np.int64]]:
    """Of the m points of a mask (n,): intensities in 0..1 as whole numbers up to 255, and Unix times in us.

    NaN counts as 0. `stamps` s is of each point, (n,), or one for all of them, (1,).
    """
    levels, moments_us = np.empty(len(valid), np.int16), np.empty(len(valid), np.int64)
    count = _find_seen(intensity, stamps, valid, epoch_us, levels, moments_us)
    return levels[:count], moments_us[:count]


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


@njit(cache=True, nogil=True)
def _add(rows, ints, bytes_, count, capacity, keys, levels, moments_us, start):
    """Add points from `start` on, until the table holds `capacity` voxels; returns these and the next point."""
    starts = run_starts(keys, start)
    runs = len(starts) - 1
    for run in range(runs):
        if run + PREFETCH_AHEAD < runs:
            prefetch_row(rows, home(keys[starts[run + PREFETCH_AHEAD]], len(rows)))
        first, end = starts[run], starts[run + 1]
        if levels[first] < 0:  # often the whole run waits
            while first < end and levels[first] < 0:
                first += 1
            if first == end:
                continue
        slot = find_or_insert(rows, keys[first])
        if rows[slot, KEY] == 0:
            if count == capacity:
                return count, first
            rows[slot, KEY], rows[slot, LAST] = keys[first], moments_us[first]
            count += 1
        points, stride, last = int64(ints[slot, POINTS]), int64(bytes_[slot, STRIDE]), rows[slot, LAST]
        for i in range(first, end):
            if levels[i] < 0:
                continue
            last = max(last, moments_us[i])
            if points & ((1 << stride) - 1) == 0:
                place = points >> stride
                if place == SAMPLE:
                    for j in range(SAMPLE // 2):
                        bytes_[slot, FIRST_LEVEL + j] = bytes_[slot, FIRST_LEVEL + 2 * j]
                    place, stride = SAMPLE // 2, stride + 1
                bytes_[slot, FIRST_LEVEL + place] = levels[i]
            points += 1
        ints[slot, POINTS], bytes_[slot, STRIDE], rows[slot, LAST] = points, stride, last
    return count, len(keys)


@njit(cache=True, nogil=True)
def _find_medians(ints, bytes_, slots, medians):
    """The lower median of the sample of each of some rows, by insertion."""
    ordered = np.empty(SAMPLE, np.uint8)
    for n in range(len(slots)):
        points, stride = int64(ints[slots[n], POINTS]), int64(bytes_[slots[n], STRIDE])
        count = (points + (1 << stride) - 1) >> stride
        for i in range(count):
            level, place = bytes_[slots[n], FIRST_LEVEL + i], i
            while place > 0 and ordered[place - 1] > level:
                ordered[place] = ordered[place - 1]
                place -= 1
            ordered[place] = level
        medians[n] = ordered[(count - 1) // 2]
