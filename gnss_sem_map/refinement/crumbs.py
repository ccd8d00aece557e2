"""Crumbs: single voxels over the ground that something that moved left behind.

The outline of a mover is cut to some centimetres, and a walker close to a wall is found in some scans only. What is
left of them has few points, in the midst of what was removed, or alone over ground that is seen again and again. Free
space does not tell: it is too near to the ground or to a wall, or was looked at too seldom.
"""

from __future__ import annotations

from pydantic import Field

from gnss_sem_map.refinement.columns import passed_over_ground, seldom_there
from gnss_sem_map.refinement.state import MapState, NotApplicable, StepSettings
from gnss_sem_map.refinement.surroundings import more_goes_than_stands, over_ground
from gnss_sem_map.voxels.semantic_map import Reason


class CrumbSettings(StepSettings):
    """What is little enough to be a crumb."""

    most_points: int = Field(default=16, ge=1, description="A voxel with more points than this is no crumb.")


def reach_m(settings: CrumbSettings, voxel_size_m: float) -> float:
    """The voxels around."""
    return voxel_size_m


def apply(state: MapState, settings: CrumbSettings) -> MapState:
    """Remove voxels over the ground with few points: more moved there than stands, or they were seldom there."""
    if state.beside.moved is None:
        raise NotApplicable("moving objects were not sought")
    assert state.decided is not None
    gone, over = state.is_removed, over_ground(state.voxels, state.heights)
    asked = over & ~gone & (state.voxels.hits <= settings.most_points)
    asked &= ~state.on_kerbs  # which are ground
    crumbs = more_goes_than_stands(state, asked, gone, over) | passed_over_ground(state, asked, gone, over)
    crumbs |= seldom_there(state, asked, gone, over)
    return state.without(crumbs, Reason.CRUMB)
