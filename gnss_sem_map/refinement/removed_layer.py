"""Removed is a layer, not a loss: what moved comes back into the map as voxels that are not shown."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gnss_sem_map.labels.label_set import UNLABELLED
from gnss_sem_map.refinement.state import MapState, NotApplicable, StepSettings
from gnss_sem_map.voxels.semantic_map import Reason, SemanticMap, State, entropy_of
from gnss_sem_map.voxels.voxel_map import VoxelMap


class RemovedLayerSettings(StepSettings):
    """Nothing can be chosen but whether."""


def reach_m(settings: RemovedLayerSettings, voxel_size_m: float) -> float:
    """A voxel alone."""
    return 0.0


def apply(state: MapState, settings: RemovedLayerSettings) -> MapState:
    """The decided map with the voxels of moving objects; see `with_removed`."""
    if state.beside.moved is None:
        raise NotApplicable("moving objects were not sought")
    assert state.decided is not None
    return replace(state, decided=with_removed(state.decided, state.beside.moved))


def with_removed(static: SemanticMap, removed: VoxelMap) -> SemanticMap:
    """The map with a layer of REMOVED voxels, of class vehicle, wherever nothing of the static map stands.

    Where something stands, its evidence and its decision stay, and the hits of what moved through are counted beside
    its own, in `hits_removed`: no point is lost. Raises DataError for another voxel size or class set.
    """
    alone = removed[static.voxels.indices_of(removed.keys) < 0]
    voxels = static.voxels + alone
    kept, added = voxels.indices_of(static.voxels.keys), voxels.indices_of(alone.keys)
    names = voxels.label_set.names
    vehicle = names.index("vehicle") if "vehicle" in names else UNLABELLED
    labels, confidence = np.full(len(voxels), vehicle, np.int8), np.zeros(len(voxels), np.float32)
    states = np.full(len(voxels), State.REMOVED, np.uint8)
    reasons = np.full(len(voxels), Reason.MOVED, np.uint8)
    labels[kept], confidence[kept], states[kept] = static.labels, static.confidence, static.states
    reasons[kept] = static.told_reasons
    confidence[added] = alone.probabilities[:, vehicle] if vehicle != UNLABELLED else 0.0
    entropy = None
    if static.entropy is not None:
        entropy = np.empty(len(voxels), np.float32)
        entropy[kept], entropy[added] = static.entropy, entropy_of(alone.probabilities)
    refined = SemanticMap(voxels, labels, confidence, states, entropy, reasons=reasons)
    return refined if len(alone) == len(removed) else _with_hits(refined, static, removed)


def _with_hits(refined: SemanticMap, static: SemanticMap, removed: VoxelMap) -> SemanticMap:
    """The same voxels; those of `static` that things moved through have their hits as well."""
    through = removed[static.voxels.indices_of(removed.keys) >= 0]
    nothing = np.zeros_like(through.evidence)
    gone = refined.removed_hits.copy()
    gone[refined.voxels.indices_of(through.keys)] += through.hits
    return replace(refined, voxels=refined.voxels + replace(through, evidence=nothing), hits_removed=gone)
