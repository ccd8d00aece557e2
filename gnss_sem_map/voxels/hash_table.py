"""A table of rows that are found by their key, in the order in which keys come.

What a scan adds lies side by side, as does what the next scan looks for: a search costs one access to the small array
of slots, and one to a row that is often in the cache. Growing does not move what is there.
"""

from __future__ import annotations

import numpy as np
from numba import int64, njit, uint64
from numpy.typing import NDArray

GROWN_BY = 8
"""Full rows grow by this part: the new ones take memory at once."""


class HashTable:
    """Rows of 64-bit words, the first of them the key; compiled loops search with `slot_of`, and add what is new."""

    def __init__(self, words: int, rows: int) -> None:
        """With room for so many `rows`, a power of two."""
        self.rows = np.zeros((rows, words), np.int64)
        self.slots = np.full(2 * rows, -1, np.int32)
        self.count = 0

    @property
    def filled(self) -> NDArray[np.int64]:
        """(count, words) the rows with a key."""
        return self.rows[: self.count]

    @property
    def nbytes(self) -> int:
        """Size in memory."""
        return self.rows.nbytes + self.slots.nbytes

    def grow(self) -> None:
        """Make room for more rows; views of those before are invalid from now on."""
        if self.count == len(self.rows):  # in place: no second table beside it, no page is touched twice
            size = len(self.rows) + max(len(self.rows) // GROWN_BY, GROWN_BY)
            self.rows.resize((size, self.rows.shape[1]), refcheck=False)
        if 2 * self.count >= len(self.slots):
            self.slots = slots_of(self.rows[:, 0], self.count, 2 * len(self.slots))


@njit(cache=True, nogil=True, inline="always")
def home(key, size):
    """Slot where the search for a key begins: a multiplicative hash, scaled to the number of slots."""
    h = uint64(key) * uint64(0x9E3779B97F4A7C15)
    h ^= h >> uint64(32)
    h *= uint64(0xD6E8FEB86659FD93)
    return int64(((h >> uint64(32)) * uint64(size)) >> uint64(32))


@njit(cache=True, nogil=True, inline="always")
def slot_of(key, keys, slots, size):
    """Slot of a key, or the empty one for it; `slots` (size,) are rows of `keys` or -1, their number a power of two.

    The `size` is a variable of the caller, who inserts what is new: with `len(slots)` here, or with both in one
    function, a loop over the points of a scan takes a third longer.
    """
    slot = home(key, size)
    while slots[slot] >= 0 and keys[slots[slot]] != key:
        slot = (slot + 1) & (size - 1)
    return slot


@njit(cache=True, nogil=True)
def slots_of(keys, count, size):
    """So many slots with the first `count` keys."""
    slots = np.full(size, -1, np.int32)
    for row in range(count):
        slots[slot_of(keys[row], keys, slots, size)] = row
    return slots


@njit(cache=True, nogil=True, inline="always")
def room_in(rows, slots):
    """How many rows there may be: no more than half of the slots are used."""
    return min(len(rows), len(slots) // 2)
