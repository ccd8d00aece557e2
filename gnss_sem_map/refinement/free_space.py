"""Free-space evidence: voxels that rays of keyframe scans traverse repeatedly are removed.

Moving objects are detected before mapping, and their points are left out. Some leave a trail: they are too far away to
be tracked, in no image, or too close to a wall. Static voxels are hit again from other poses; those of a trail are not.
"""

from __future__ import annotations

from itertools import chain

import numpy as np
from numba import njit
from numpy.typing import NDArray
from pydantic import Field
from scipy.spatial.distance import cdist

from gnss_sem_map.dynamics.clusters import boxes_of
from gnss_sem_map.dynamics.range_images import CLUSTER, FARTHEST_M
from gnss_sem_map.dynamics.visibility import WIDE_RATIO, Keyframes, hits_and_misses, origins_of, spatial_order
from gnss_sem_map.refinement.state import MapState, NotApplicable, StepSettings
from gnss_sem_map.refinement.surroundings import COLUMNS_AROUND, more_goes_than_stands, over_ground
from gnss_sem_map.voxels.semantic_map import Reason
from gnss_sem_map.voxels.voxel_map import VoxelMap

OVER_M = (0.4, 3.0)
"""Only voxels with another one so far below them (least, most) are removed: the ground stays."""
POINTS_PER_MISS = 6.0
"""A voxel with more points than this per miss too many stays, whatever the keyframe scans say: other scans saw it."""


class FreeSpaceSettings(StepSettings):
    """How often a voxel must be traversed before it is removed; keyframe scans are 2 m or 2 s apart."""

    least_misses: int = Field(
        default=3, ge=1, description="Least number of keyframe scans whose rays traverse the voxel,"
    )
    misses_per_hit: float = Field(default=1.5, gt=0, description="and least ratio of misses to hits.")
    farthest_m: float = Field(
        default=80.0,
        gt=0,
        le=FARTHEST_M,
        description="Scans farther than this are no evidence, m; farther than for objects, which need an outline.",
    )


def reach_m(settings: FreeSpaceSettings, voxel_size_m: float) -> float:
    """The voxels around one, and what they stand over, one farther; keyframe scans are used wherever they are."""
    return 2 * voxel_size_m


def apply(state: MapState, settings: FreeSpaceSettings) -> MapState:
    """Remove the voxels that rays traverse repeatedly, see `traversed`, unless more stands around them than goes."""
    if state.beside.keyframes is None:
        raise NotApplicable("no keyframe scans: the poses are not sharp enough to tell what is free")
    assert state.decided is not None
    removed = traversed(state.voxels, state.beside.keyframes, settings)
    removed &= ~state.on_kerbs  # which are ground
    # rays graze the edges of roofs
    free = more_goes_than_stands(state, removed, removed, over_ground(state.voxels, state.heights))
    return state.without(free, Reason.FREE_SPACE)


def traversed(voxels: VoxelMap, keyframes: Keyframes, settings: FreeSpaceSettings) -> NDArray[np.bool_]:
    """Which voxels (v,) are free space, by the rays through their centres.

    Needs sharp poses: with a pose error of half a metre rays traverse walls. Ground voxels are kept,
    because grazing rays traverse them. Scans are read part by part. A voxel is asked about no longer once even misses
    in all the scans left, as far as they are in range, would not make it free.
    """
    undecided = np.flatnonzero(_stands_over(voxels))
    places = voxels.centres[undecided]
    order = spatial_order(places)
    undecided, places = undecided[order], places[order]
    points = voxels.hits[undecided]
    group, in_range = _scans_in_range(places, keyframes.T_lidar_map, settings.farthest_m)
    left, counts = in_range.sum(axis=1), np.zeros((2, len(undecided)), np.int32)
    for part in chain([None], keyframes.parts()):
        if part is not None:
            counts += hits_and_misses(places, part, settings.farthest_m, WIDE_RATIO)
            left -= in_range[:, : len(part)].sum(axis=1)
            in_range = in_range[:, len(part) :]
        hits, most_misses = counts[0], counts[1] + left[group]
        may_be_free = most_misses >= settings.least_misses
        too_many = most_misses - settings.misses_per_hit * hits
        may_be_free &= points < POINTS_PER_MISS * too_many
        stays = np.flatnonzero(may_be_free)
        undecided, points, group = undecided[stays], points[stays], group[stays]
        places, counts = places.take(stays, axis=0), counts.take(stays, axis=1)
        if not len(undecided):
            break
    free = np.zeros(len(voxels), np.bool_)
    free[undecided] = True
    return free


def _scans_in_range(
    places: NDArray[np.float64], T_lidar_map: NDArray[np.float64], farthest_m: float
) -> tuple[NDArray[np.int32], NDArray[np.bool_]]:
    """The group of neighbours that each place (v, 3) m is in, and which scans may be in range of each group (g, k)."""
    group = np.arange(len(places), dtype=np.int32) // CLUSTER
    low, high = boxes_of(places, group, -(-len(places) // CLUSTER))
    reach = farthest_m + np.linalg.norm(high - low, axis=1) / 2
    distance = cdist((low + high) / 2, origins_of(T_lidar_map))
    return group, distance <= (1 + 1e-9) * reach[:, None]


def _stands_over(voxels: VoxelMap) -> NDArray[np.bool_]:
    """Which voxels (v,) have one under them, in 3 x 3 columns, lower by OVER_M."""
    least, most = (round(m / voxels.voxel_size_m) for m in OVER_M)
    found = np.zeros(len(voxels), np.bool_)
    _find_under(voxels.keys, COLUMNS_AROUND, least, most, found)
    return found


@njit(cache=True, nogil=True)
def _find_under(keys, beside, least, most, found):
    for column in beside:
        above = 0  # the first voxel that is not so low
        for i in range(len(keys)):
            highest = keys[i] + column - least
            while above < len(keys) and keys[above] <= highest:
                above += 1
            found[i] |= above > 0 and keys[above - 1] >= keys[i] + column - most
