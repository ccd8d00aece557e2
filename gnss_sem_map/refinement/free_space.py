"""What is left in the map of things that moved: voxels that scan after scan looks through are empty.

Moving objects are found as objects, and their points are left out. Of some a trail remains: too far away to be
followed, never in an image, too close to a wall to be told from it. What stands is hit again, wherever one looks from.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from gnss_sem_map.dynamics.visibility import KeyframeScans, VisibilitySettings, hits_and_misses
from gnss_sem_map.refinement.state import MapState, NotApplicable, StepSettings
from gnss_sem_map.voxels.kernels import AXIS_BITS
from gnss_sem_map.voxels.voxel_map import VoxelMap


class FreeSpaceSettings(VisibilitySettings, StepSettings):
    """How often a voxel is seen through before it is empty; witnesses are scans 1 m or 1 s apart."""

    least_through: int = Field(default=6, ge=1, description="So many witnesses saw through it,")
    through_per_hit: float = Field(default=3.0, gt=0, description="so many times as often as hit it,")
    points_per_through: float = Field(
        default=2.0, gt=0, description="and so many points it holds at most for each."
    )
    farthest_m: float = Field(
        default=80.0,
        gt=0,
        description="Farther scans do not hits_and_misses, m: a voxel needs no outline, as objects do.",
    )
    over_m: tuple[float, float] = Field(
        default=(0.4, 3.0), description="Only what stands over something, so far at least and at most, m."
    )


def reach_m(settings: FreeSpaceSettings, voxel_size_m: float) -> float:
    """What a voxel stands over; keyframes are asked from wherever they are."""
    return settings.over_m[1] + voxel_size_m


def apply(state: MapState, settings: FreeSpaceSettings) -> MapState:
    """Remove the voxels that keyframe scans repeatedly look through; see `seen_through`."""
    if state.beside.keyframes is None:
        raise NotApplicable("no keyframe scans with poses from LiDAR odometry")
    return replace(
        state, removed=state.removed | seen_through(state.voxels, state.beside.keyframes, settings)
    )


def seen_through(
    voxels: VoxelMap, witnesses: KeyframeScans, settings: FreeSpaceSettings
) -> NDArray[np.bool_]:
    """Which voxels (v,) are empty, by what the witnesses say of their centres.

    Only with poses that scan matching has made sharp: who stands half a metre off looks through walls. The ground is
    never empty, though one who looks along it sees through its voxels: what moved stood over it.
    """
    high = np.flatnonzero(
        _stands_over(voxels.keys, [round(m / voxels.voxel_size_m) for m in settings.over_m])
    )
    hits, throughs = hits_and_misses(voxels.centres[high], witnesses, settings)
    empty = throughs >= settings.least_through
    empty &= throughs > settings.through_per_hit * hits
    empty &= voxels.hits[high] < settings.points_per_through * throughs
    cleared = np.zeros(len(voxels), np.bool_)
    cleared[high[empty]] = True
    return cleared


def _stands_over(keys: NDArray[np.int64], under: Sequence[int]) -> NDArray[np.bool_]:
    """Which of the sorted voxels (v,) have one under them, in 3 x 3 columns, so many voxels lower (least, most)."""
    least, most = under
    found = np.zeros(len(keys), np.bool_)
    for x in (-1, 0, 1):
        for y in (-1, 0, 1):
            column = keys + (x << 2 * AXIS_BITS) + (y << AXIS_BITS)
            highest = np.searchsorted(keys, column - least, side="right") - 1
            found |= (highest >= 0) & (keys[highest] >= column - most)
    return found
