"""Which of many voxel keys are the same: `np.unique` by a hash table, for keys that mostly repeat."""

from __future__ import annotations

import numpy as np
from numba import njit, uint64
from numpy.typing import NDArray

LEAST_BITS = 10


def distinct(keys: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """The distinct keys in ascending order (u,), and which of them every key (n,) is; as `np.unique` says it."""
    found, numbers = _numbered(keys)
    order = np.argsort(found)
    rank = np.empty(len(found), np.int32)
    rank[order] = np.arange(len(found), dtype=np.int32)
    return found[order], rank[numbers]


@njit(cache=True, nogil=True)
def _numbered(keys):
    """The distinct keys in order of appearance, and the number of each key (n,) among them.

    Neighbours in a scan are neighbours in the world: a key that repeats the one before it needs no look-up.
    """
    bits, count = LEAST_BITS, 0
    table = np.full(1 << bits, -1, np.int32)  # numbers, found by open addressing
    found, numbers = np.empty(len(keys), np.int64), np.empty(len(keys), np.int32)
    for i in range(len(keys)):
        if i > 0 and keys[i] == keys[i - 1]:
            numbers[i] = numbers[i - 1]
            continue
        slot = _slot_of(keys[i], found, table, bits)
        if table[slot] < 0:
            table[slot], found[count] = count, keys[i]
            count += 1
        numbers[i] = table[slot]
        if 2 * count > len(table):
            bits += 1
            table = np.full(1 << bits, -1, np.int32)
            for number in range(count):
                table[_slot_of(found[number], found, table, bits)] = number
    return found[:count].copy(), numbers


@njit(cache=True, nogil=True, inline="always")
def _slot_of(key, found, table, bits):
    """Where a key is in the table, or where it would be."""
    h = uint64(key) * uint64(0x9E3779B97F4A7C15)
    h = (h ^ (h >> uint64(29))) * uint64(0xD6E8FEB86659FD93)
    slot = h >> uint64(64 - bits)
    while table[slot] >= 0 and found[table[slot]] != key:
        slot = (slot + uint64(1)) & uint64(len(table) - 1)
    return slot
