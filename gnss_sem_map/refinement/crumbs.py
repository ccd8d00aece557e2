"""Crumbs: single voxels over the ground that something that moved left behind.

The outline of a mover is cut to some centimetres, and a walker close to a wall is found in some scans only. What is
left of them has few points, in the midst of what was removed. Free space does not tell: it is too near to the ground or
to a wall, or was looked at too seldom.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numba import njit
from numpy.typing import NDArray
from pydantic import Field

from gnss_sem_map.refinement.free_space import stands_over
from gnss_sem_map.refinement.state import MapState, NotApplicable, StepSettings
from gnss_sem_map.voxels.kernels import AXIS_BITS
from gnss_sem_map.voxels.semantic_map import State
from gnss_sem_map.voxels.voxel_map import VoxelMap

INSIDE_M = 0.03
"""What is on the ground, in the next voxel over it, has its mean height so far over the bottom of its voxel: ground
that touches two voxels does not."""


class CrumbSettings(StepSettings):
    """What is little enough to be a crumb."""

    most_points: int = Field(default=16, ge=1, description="A voxel with more points than this is no crumb.")


def reach_m(settings: CrumbSettings, voxel_size_m: float) -> float:
    """The voxels around, which stand over others in the columns beside them."""
    return 2 * voxel_size_m


def apply(state: MapState, settings: CrumbSettings) -> MapState:
    """Remove the crumbs of moving objects; see `crumbs`."""
    if state.beside.moved is None:
        raise NotApplicable("moving objects were not sought")
    assert state.decided is not None
    gone = state.is_removed
    removed = crumbs(state.voxels, gone, state.beside.moved, settings.most_points)
    removed &= state.decided.states != State.SPLIT  # a kerb is ground
    states = np.where(removed, np.uint8(State.REMOVED), state.decided.states)
    return replace(state, decided=replace(state.decided, states=states))


def crumbs(voxels: VoxelMap, gone: NDArray[np.bool_], moved: VoxelMap, most_points: int) -> NDArray[np.bool_]:
    """Which voxels (v,) are crumbs: over the ground, with few points, and in a place where more moved than stands.

    `gone` (v,) are those that are removed already; `moved` holds the points that were kept out of the map. In a voxel
    and the 26 around it, the points of these are compared with those that stand over the ground.
    """
    over = (stands_over(voxels) | _is_on_ground(voxels)) & ~gone
    asked = np.flatnonzero(over & (voxels.hits <= most_points))
    gone_hits = points_around(voxels.keys[asked], moved.keys, moved.hits)
    gone_hits += points_around(voxels.keys[asked], voxels.keys[gone], voxels.hits[gone])
    asked, gone_hits = asked[gone_hits > 0], gone_hits[gone_hits > 0]
    standing = points_around(voxels.keys[asked], voxels.keys[over], voxels.hits[over])
    found = np.zeros(len(voxels), np.bool_)
    found[asked[gone_hits > standing]] = True
    return found


def _is_on_ground(voxels: VoxelMap) -> NDArray[np.bool_]:
    """Which voxels (v,) have another one right under them, and their points well over it."""
    inside = voxels.surface_heights - voxels.indices[:, 2] * voxels.voxel_size_m
    return np.asarray(np.append(False, np.diff(voxels.keys) == 1) & (inside > INSIDE_M))


def points_around(
    asked: NDArray[np.int64], keys: NDArray[np.int64], hits: NDArray[np.uint32]
) -> NDArray[np.int64]:
    """Points (a,) in and around sorted packed voxels: of themselves and their 26 neighbours.

    `hits` (v,) are the points in the sorted packed voxels `keys` (v,).
    """
    total = np.zeros(len(asked), np.int64)
    beside = [(x << 2 * AXIS_BITS) + (y << AXIS_BITS) for x in (-1, 0, 1) for y in (-1, 0, 1)]
    _add_around(asked, keys, hits, np.array(beside), total)
    return total


@njit(cache=True, nogil=True)
def _add_around(asked, keys, hits, beside, total):
    for column in beside:
        low = 0  # the first voxel that is not lower
        for i in range(len(asked)):
            centre = asked[i] + column
            while low < len(keys) and keys[low] < centre - 1:
                low += 1
            k = low
            while k < len(keys) and keys[k] <= centre + 1:
                total[i] += hits[k]
                k += 1
