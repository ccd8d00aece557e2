"""What is around a voxel over the ground: whether more of it goes, with something that moved, or stands."""

from __future__ import annotations

import numpy as np
from numba import int64, njit
from numpy.typing import NDArray

from gnss_sem_map.refinement.state import MapState
from gnss_sem_map.voxels.kernels import AXIS_BITS
from gnss_sem_map.voxels.voxel_map import VoxelMap

COLUMNS_AROUND = np.array(
    [(x << 2 * AXIS_BITS) + (y << AXIS_BITS) for x in (-1, 0, 1) for y in (-1, 0, 1)], np.int64
)
"""From the key of a voxel to those of the same height in its column and the eight beside."""
OVER_M = 0.3
"""Centres of voxels on the ground are lower than this over it."""
INSIDE_M = 0.03
"""What is on the ground, in the next voxel over it, has its mean height so far over the bottom of its voxel: ground
that touches two voxels does not."""
STEP_M = 0.025
"""Or it is so far over the mean height in the voxel under it. Ground that touches two voxels of 0.2 m would have to be
steeper than 1 in 4: rays meet the ground so flat that the noise of ranges hardly changes its height."""


def over_ground(voxels: VoxelMap, heights: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Which voxels (v,) are over the ground, and no part of it; `heights` (v,) m are those of `height_over_ground`."""
    inside = voxels.surface_heights - voxels.indices[:, 2] * voxels.voxel_size_m
    has_under = np.append(False, np.diff(voxels.keys) == 1)[: len(voxels)]
    step = np.diff(inside, prepend=0.0) + voxels.voxel_size_m
    on_ground = has_under & ((inside > INSIDE_M) | (step > STEP_M))
    return np.asarray((heights > OVER_M) | on_ground)


def more_goes_than_stands(
    state: MapState, asked: NDArray[np.bool_], going: NDArray[np.bool_], over: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Which of the voxels `asked` (v,) have more points of what goes around them than of what stands over the ground.

    What goes are the points that were kept out of the map, and those of the voxels `going` (v,); all others that are
    `over` the ground (v,) stand. A voxel counts with the 26 around it.
    """
    keys, hits, moved = state.voxels.keys, state.voxels.hits, state.beside.moved
    places, stands = np.flatnonzero(asked), over & ~going
    goes = points_around(keys[places], keys[going], hits[going])
    if moved is not None:
        goes += points_around(keys[places], moved.keys, moved.hits)
    places, goes = places[goes > 0], goes[goes > 0]
    found = np.zeros(len(keys), np.bool_)
    found[places[goes > points_around(keys[places], keys[stands], hits[stands])]] = True
    return found


def points_around(
    asked: NDArray[np.int64],
    keys: NDArray[np.int64],
    hits: NDArray[np.uint32],
    low: int = -1,
    high: int = 1,
    columns: NDArray[np.int64] = COLUMNS_AROUND,
) -> NDArray[np.int64]:
    """Points (a,) around sorted packed voxels, from `low` to `high` voxels over each: themselves and 26 by default.

    `hits` (v,) are the points in the sorted packed voxels `keys` (v,).
    """
    total = np.zeros(len(asked), np.int64)
    _add_around(asked, keys, hits, columns, low, high, total)
    return total


@njit(cache=True, nogil=True)
def _add_around(asked, keys, hits, columns, low, high, total):
    for column in columns:
        first, end, inside = 0, 0, int64(0)  # a window over the voxels, and the points in it
        for i in range(len(asked)):
            centre = asked[i] + column
            while end < len(keys) and keys[end] <= centre + high:
                inside += hits[end]
                end += 1
            while first < end and keys[first] < centre + low:
                inside -= hits[first]
                first += 1
            total[i] += inside
