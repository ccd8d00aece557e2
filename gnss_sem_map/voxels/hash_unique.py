"""`np.unique` with inverse by a hash table: faster where most keys repeat, as the voxel keys of a scan do."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gnss_sem_map.voxels.kernels import home

LEAST_BITS = 10


def distinct(keys: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """The distinct keys (u,) in ascending order, and the index (n,) of every key among them; as `np.unique`."""
    found, numbers = _numbered(keys)
    order = np.argsort(found)
    rank = np.empty(len(found), np.int32)
    rank[order] = np.arange(len(found), dtype=np.int32)
    return found[order], rank[numbers]


@njit(cache=True, nogil=True)
def _numbered(keys):
    """The distinct keys in order of appearance, and the index of each key (n,) among them.

    Consecutive points of a scan are often in the same voxel: a key that repeats the one before needs no look-up.
    """
    bits, count = LEAST_BITS, 0
    table = np.full(1 << bits, -1, np.int32)  # indices, found by open addressing
    found, numbers = np.empty(len(keys), np.int64), np.empty(len(keys), np.int32)
    for i in range(len(keys)):
        if i > 0 and keys[i] == keys[i - 1]:
            numbers[i] = numbers[i - 1]
            continue
        slot = slot_of(keys[i], found, table, bits)
        if table[slot] < 0:
            table[slot], found[count] = count, keys[i]
            count += 1
        numbers[i] = table[slot]
        if 2 * count > len(table):
            bits += 1
            table = grown(found, count, bits)
    return found[:count].copy(), numbers


@njit(cache=True, nogil=True)
def grown(found, count, bits):
    """A table of so many bits with the first `count` keys that were found."""
    table = np.full(1 << bits, -1, np.int32)
    for number in range(count):
        table[slot_of(found[number], found, table, bits)] = number
    return table


@njit(cache=True, nogil=True, inline="always")
def slot_of(key, found, table, bits):
    """Slot of a key in the table, or the empty slot for it."""
    slot = home(key, 1 << bits)
    while table[slot] >= 0 and found[table[slot]] != key:
        slot = (slot + 1) & (len(table) - 1)
    return slot
