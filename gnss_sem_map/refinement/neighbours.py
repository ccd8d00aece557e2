"""Pairs of neighbouring voxels, found by walking along the sorted voxels once per direction."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gnss_sem_map.voxels.kernels import AXIS_BITS

HALF_STENCIL = np.array(
    [(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if (x, y, z) < (0, 0, 0)], np.int64
)
"""13 of the 26 neighbours; the others see the pair from their side."""


OFFSETS = np.array([(x << 2 * AXIS_BITS) + (y << AXIS_BITS) + z for x, y, z in HALF_STENCIL.tolist()])
"""The same, of packed keys."""
HALF_COLUMNS = OFFSETS[::3] + 1
"""The columns that they stand in, three in each but the last: from the key of a voxel to its height there."""


def pairs_of_neighbours(keys: NDArray[np.int64]) -> NDArray[np.int32]:
    """Places (p, 2) of every two sorted packed voxels (v,) that touch, be it in a corner; each pair once."""
    # the system gives memory for pairs only where they are filled in
    pairs, count = np.empty((len(OFFSETS) * len(keys) + 1, 2), np.int32), 0
    for offset in OFFSETS:
        count += _find_pairs(keys, offset, pairs[count:])
    return pairs[:count]


@njit(cache=True, nogil=True)
def _find_pairs(keys, offset, pairs):
    """Fill in the places of every voxel that has another at an offset, and of that one; returns how many."""
    count, j = 0, 0
    for i in range(len(keys)):
        wanted = keys[i] + offset
        while keys[j] < wanted:
            j += 1
        pairs[count, 0], pairs[count, 1] = i, j
        count += keys[j] == wanted  # kept only if it is one: no branch
    return count
