"""Kerbs: voxels where road meets sidewalk at a step; their points are classified one by one.

A voxel is wider than a kerb and higher than its step, so it holds points of both classes. Each point lies on the level
of its class, and on its side of the edge between the two classes of the map.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.labels.label_set import UNLABELLED
from gnss_sem_map.refinement.kerb_points import Kerbs
from gnss_sem_map.refinement.road_sidewalk import (
    ROAD,
    RoadEdgeSettings,
    around,
    heights_of,
    is_road_or_sidewalk,
    meeting,
    road_and_sidewalk,
)
from gnss_sem_map.refinement.state import MapState
from gnss_sem_map.voxels.semantic_map import SemanticMap, State

REACH = 3
"""Levels of road and sidewalk are those within so many voxels to each side of a kerb."""


class KerbSettings(RoadEdgeSettings):
    """Which steps are kerbs."""


def reach_m(settings: KerbSettings, voxel_size_m: float) -> float:
    """A kerb is found among its neighbours, and its levels in the voxels near it."""
    return (REACH + 2) * voxel_size_m


def apply(state: MapState, settings: KerbSettings) -> MapState:
    """Find the voxels whose points are classified one by one in `labels/`; the map marks them as SPLIT."""
    assert state.decided is not None
    kerbs = find_kerbs(state.decided, heights_of(state), settings)
    if kerbs is None:
        return state
    states, places = state.decided.states.copy(), state.decided.voxels.indices_of(kerbs.keys)
    states[places] = np.where(states[places] == State.INFERRED, State.INFERRED, State.SPLIT)
    return replace(state, kerbs=kerbs, decided=replace(state.decided, states=states))


def find_kerbs(
    semantic_map: SemanticMap, heights: NDArray[np.float64], settings: KerbSettings
) -> Kerbs | None:
    """Where road and sidewalk of a map meet at a step, and how high both lie; None where they never do.

    `heights` (v,) m: of every voxel's surface, NaN where unknown.
    """
    classes = road_and_sidewalk(semantic_map.voxels.label_set)
    if classes is None:
        return None
    labels = np.where(is_road_or_sidewalk(semantic_map), semantic_map.labels, UNLABELLED)
    edge = np.flatnonzero(meeting(semantic_map, labels, classes))
    if len(edge) == 0:
        return None
    road, sidewalk = _levels(semantic_map, edge, labels, classes, heights)
    is_step = sidewalk - road >= settings.least_m  # no, where one of them is not known
    kerbs = edge[is_step]
    if len(kerbs) == 0:
        return None
    beside = _around(semantic_map, kerbs, (1, 1, 0)).T.reshape(-1, 3, 3)
    known = (beside >= 0) & (labels[beside] >= 0)
    sure = np.maximum(2 * semantic_map.confidence[beside] - 1, 0)  # unsure of one is not sure of the other
    leaning = np.where(known, np.where(labels[beside] == classes[ROAD], sure, -sure), np.float32(0))
    levels = np.stack([road[is_step], sidewalk[is_step]])
    return Kerbs(
        semantic_map.voxels.voxel_size_m,
        classes,
        semantic_map.voxels.keys[kerbs],
        leaning,
        known,
        levels,
    )


def _around(
    semantic_map: SemanticMap, voxels: NDArray[np.int64], reach: tuple[int, int, int]
) -> NDArray[np.int64]:
    """Places (o, k) of what lies around k voxels; see `around`."""
    keys = semantic_map.voxels.keys
    return np.stack(list(around(keys, keys[voxels], reach)))


def _levels(
    semantic_map: SemanticMap,
    edge: NDArray[np.int64],
    labels: NDArray[np.integer],
    classes: tuple[int, int],
    heights: NDArray[np.float64],
) -> list[NDArray[np.float64]]:
    """Per class the mean height (e,) m of the voxels near the edge between them, NaN where there is none."""
    nearby = _around(semantic_map, edge, (REACH, REACH, 1))
    is_mixed = np.isin(nearby, edge)  # what holds both is no measure of either
    known = (nearby >= 0) & ~is_mixed & np.isfinite(heights[nearby])
    return [_mean_where(known & (labels[nearby] == one), heights[nearby]) for one in classes]


def _mean_where(these: NDArray[np.bool_], values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean over the first axis of the values that count, NaN where none does."""
    count = np.count_nonzero(these, axis=0)
    return np.where(count > 0, np.where(these, values, 0.0).sum(axis=0) / np.maximum(count, 1), np.nan)
