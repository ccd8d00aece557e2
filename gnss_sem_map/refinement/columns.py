"""What is in the column of a voxel: whether something passed there, over ground that is seen.

A walker close to a wall has few points beside the many of the wall, but the wall is in other columns than the walker:
under a walker the ground is seen once he is gone.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.refinement.state import MapState

HIGH_M = 1.8
"""What passed is as high as a person: so far over and under a voxel, what moved and the ground are sought."""


def passed_over_ground(
    state: MapState, asked: NDArray[np.bool_], going: NDArray[np.bool_], over: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Which of the voxels `asked` (v,) have more points of what goes in their column than of what stands, and ground.

    What goes are the points that were kept out of the map, and those of the voxels `going` (v,); all others that are
    `over` the ground (v,) stand, the rest is ground.
    """
    keys, hits, moved = state.voxels.keys, state.voxels.hits, state.beside.moved
    places, reach = np.flatnonzero(asked), round(HIGH_M / state.voxels.voxel_size_m)
    goes = points_between(keys[places], keys[going], hits[going], -reach, reach)
    if moved is not None:
        goes += points_between(keys[places], moved.keys, moved.hits, -reach, reach)
    stands, ground = over & ~going, ~(over | going)
    places = places[goes > points_between(keys[places], keys[stands], hits[stands], -reach, reach)]
    found = np.zeros(len(keys), np.bool_)
    found[places] = points_between(keys[places], keys[ground], hits[ground], -reach - 1, -1) > 0
    return found


def points_between(
    asked: NDArray[np.int64], keys: NDArray[np.int64], hits: NDArray[np.uint32], low: int, high: int
) -> NDArray[np.int64]:
    """Points (a,) in the columns of packed voxels, from `low` to `high` voxels over each, both included.

    `hits` (v,) are the points in the sorted packed voxels `keys` (v,).
    """
    sums = np.append(0, np.cumsum(hits, dtype=np.int64))
    ends = np.searchsorted(keys, asked + high, side="right")
    return np.asarray(sums[ends] - sums[np.searchsorted(keys, asked + low)])
