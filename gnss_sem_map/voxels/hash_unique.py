"""`np.unique` with inverse by a hash table: faster where most keys repeat, as the voxel keys of a scan do."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gnss_sem_map.voxels.hash_table import slot_of, slots_of

FEWEST_SLOTS = 1 << 14


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
    count, size = 0, FEWEST_SLOTS
    slots = np.full(size, -1, np.int32)
    found, numbers = np.empty(len(keys), np.int64), np.empty(len(keys), np.int32)
    for i in range(len(keys)):
        if i > 0 and keys[i] == keys[i - 1]:
            numbers[i] = numbers[i - 1]
            continue
        slot = slot_of(keys[i], found, slots, size)
        if slots[slot] < 0:
            slots[slot], found[count] = count, keys[i]
            count += 1
        numbers[i] = slots[slot]
        if 2 * count > size:
            size *= 2
            slots = slots_of(found, count, size)
    return found[:count].copy(), numbers
