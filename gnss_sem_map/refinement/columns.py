"""What is in the column of a voxel: whether something passed there, over ground that is seen.

A walker close to a wall has few points beside the many of the wall, but the wall is in other columns than the walker:
under a walker the ground is seen once he is gone. What stands is seen about as often as the ground under it; what is
seen once, over ground that is seen again and again, was gone most of the time, however far away it was seen.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.dynamics.clusters import HIGHEST_M
from gnss_sem_map.dynamics.standing import is_occupied
from gnss_sem_map.refinement.state import MapState
from gnss_sem_map.refinement.surroundings import COLUMNS_AROUND, points_around

HIGH_M = 1.8
"""What passed is as high as a person: so far over and under a voxel, what moved and the ground are sought. It is no
higher than the LiDAR, which sees it from all places that show the ground under it."""

OWN_COLUMN = COLUMNS_AROUND[4:5]


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


def seldom_there(
    state: MapState, asked: NDArray[np.bool_], going: NDArray[np.bool_], over: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Which of the voxels `asked` (v,) were gone most of the time: the ground under them is hardly ever hidden.

    The points of that ground are hits, and those of what stands in 3 x 3 columns are misses, see `is_occupied`. Up to
    the height of a person no more is needed; up to that of a lorry, something must have moved there: the LiDAR sees the
    ground under branches and signs from where it does not see these. `going`, `over` (v,) as in `passed_over_ground`.
    """
    keys, hits, moved = state.voxels.keys, state.voxels.hits, state.beside.moved
    person, lorry = (round(m / state.voxels.voxel_size_m) for m in (HIGH_M, HIGHEST_M))
    places, stands, ground = np.flatnonzero(asked), over & ~going, ~(over | going)
    under = points_between(keys[places], keys[ground], hits[ground], -lorry - 1, -1)
    places = places[is_occupied(under, hits[places])]  # few are left, whose surroundings are worth a look
    stand = points_around(keys[places], keys[stands], hits[stands], -person, person)
    goes = points_around(keys[places], keys[going], hits[going], -person, person)
    if moved is not None:
        goes += points_around(keys[places], moved.keys, moved.hits, -person, person)
    low, deep = (
        is_occupied(points_between(keys[places], keys[ground], hits[ground], -depth - 1, -1), stand)
        for depth in (person, lorry)
    )
    found = np.zeros(len(keys), np.bool_)
    found[places[low | (deep & (goes > 0))]] = True
    return found


def points_between(
    asked: NDArray[np.int64], keys: NDArray[np.int64], hits: NDArray[np.uint32], low: int, high: int
) -> NDArray[np.int64]:
    """As `points_around`, in the columns of the voxels alone."""
    return points_around(asked, keys, hits, low, high, OWN_COLUMN)
