"""Removed is a layer, not a loss: what moved comes back into the map as voxels that are not shown.

They are called vehicles, or persons where the class set has them, because they moved, not because of what an image
says. How often that is true is read off those that images show, and holds for the others as well: most movers are
beside or behind the car, in no image.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.labels.label_set import UNLABELLED
from gnss_sem_map.labels.roles import MOVABLE
from gnss_sem_map.refinement.figures import Sums
from gnss_sem_map.refinement.state import MapState, NotApplicable, StepSettings
from gnss_sem_map.voxels.kernels import UNITS_PER_NAT
from gnss_sem_map.voxels.semantic_map import Reason, SemanticMap, State, entropy_of
from gnss_sem_map.voxels.voxel_map import VoxelMap, softmax


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
    return replace(
        state, decided=with_removed(state.decided, state.beside.moved, state.figures.moved_otherwise)
    )


def measure(moved: VoxelMap | None) -> Sums:
    """How many points of moving objects images show, and of these, how many they call nothing that may move.

    Points, not voxels: the more points a voxel has, the surer is what the images say of it.
    """
    if moved is None or not (movable := moved.label_set.having(*MOVABLE)):
        return Sums()
    otherwise = moved.observed & ~np.isin(moved.labels, movable)
    return Sums(
        moved=int(moved.hits[moved.observed].sum(dtype=np.int64)),
        moved_otherwise=int(moved.hits[otherwise].sum(dtype=np.int64)),
    )


def probabilities_of(moved: VoxelMap, otherwise: float) -> NDArray[np.float32]:
    """Class probabilities (v, c) of moving objects, a share of which is `otherwise` than a class that may move.

    Bayes' rule: the share is the prior, divided alike among the other classes, and the images are the evidence. The
    prior of a class that may move is at least that of any class, so a share of 1 says nothing.
    """
    movable, count = moved.label_set.having(*MOVABLE), len(moved.label_set.names)
    if not 0 < len(movable) < count:
        return moved.probabilities
    share = max(1 - otherwise, len(movable) / count)
    odds = share * (count - len(movable)) / ((1 - share) * len(movable))
    scores = moved.evidence.astype(np.float32) / np.float32(UNITS_PER_NAT)
    scores[:, movable] += np.float32(np.log(odds))
    return softmax(scores)


def with_removed(static: SemanticMap, removed: VoxelMap, otherwise: float = 1.0) -> SemanticMap:
    """The map with a layer of REMOVED voxels, of classes that may move, wherever nothing of the static map stands.

    A share of what moved is `otherwise`, see `probabilities_of`. Where something stands, its evidence and its decision
    stay, and the hits of what moved through are counted beside its own, in `hits_removed`: no point is lost. Raises
    DataError for another voxel size or class set.
    """
    alone = removed[static.voxels.indices_of(removed.keys) < 0]
    voxels = static.voxels + alone
    kept, added = voxels.indices_of(static.voxels.keys), voxels.indices_of(alone.keys)
    movable = np.array(voxels.label_set.having(*MOVABLE), np.int8)
    labels, confidence = np.full(len(voxels), UNLABELLED, np.int8), np.zeros(len(voxels), np.float32)
    states = np.full(len(voxels), State.REMOVED, np.uint8)
    reasons = np.full(len(voxels), Reason.MOVED, np.uint8)
    labels[kept], confidence[kept], states[kept] = static.labels, static.confidence, static.states
    reasons[kept] = static.told_reasons
    probabilities = probabilities_of(alone, otherwise)
    if len(movable):
        labels[added] = movable[probabilities[:, movable].argmax(axis=1)]
        confidence[added] = probabilities[:, movable].max(axis=1)
    entropy = None
    if static.entropy is not None:
        entropy = np.empty(len(voxels), np.float32)
        entropy[kept], entropy[added] = static.entropy, entropy_of(probabilities)
    refined = SemanticMap(voxels, labels, confidence, states, entropy, reasons=reasons)
    return refined if len(alone) == len(removed) else _with_hits(refined, static, removed)


def _with_hits(refined: SemanticMap, static: SemanticMap, removed: VoxelMap) -> SemanticMap:
    """The same voxels; those of `static` that things moved through have their hits as well."""
    through = removed[static.voxels.indices_of(removed.keys) >= 0]
    nothing = np.zeros_like(through.evidence)
    gone = refined.removed_hits.copy()
    gone[refined.voxels.indices_of(through.keys)] += through.hits
    return replace(refined, voxels=refined.voxels + replace(through, evidence=nothing), hits_removed=gone)
