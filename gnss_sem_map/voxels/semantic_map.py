"""A voxel map with a decision for every voxel: its class, how sure that is, and where it comes from."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.errors import DataError
from gnss_sem_map.voxels.voxel_map import VoxelMap


class State(IntEnum):
    """Source of the label of a voxel."""

    UNOBSERVED = 0
    """Not visible in any image: no label."""
    OBSERVED = 1
    """Label of the fused images."""
    INFERRED = 2
    """Not visible in any image; label of the geometric classifier, from shape and intensity."""
    REFINED = 3
    """Label of the images, changed by refinement."""
    REMOVED = 4
    """Part of something that moved: kept as a layer, not shown in the map."""
    SPLIT = 5
    """Road meets sidewalk here: its points are classified one by one in `labels/`."""


class Reason(IntEnum):
    """Why a voxel was removed."""

    NONE = 0
    """It was not, or the map does not tell."""
    MOVED = 1
    """Its points are those of an object that moved."""
    FREE_SPACE = 2
    """Rays of other scans pass through it."""
    CRUMB = 3
    """It has few points, amid those of what moved."""
    RULE = 4
    """By the rule of the paper (eq. 12 and 13), where that is chosen."""


@dataclass(frozen=True, eq=False)
class SemanticMap:
    """A voxel map with the label, confidence and state of every voxel."""

    voxels: VoxelMap
    labels: NDArray[np.int8]
    """(v,) class index, c for `other`, which is none of the c classes, -1 unlabelled."""
    confidence: NDArray[np.float32]
    """(v,) probability of the label; 0 where unlabelled."""
    states: NDArray[np.uint8]
    """(v,) of `State`."""
    entropy: NDArray[np.float32] | None = None
    """(v,) nat: entropy of the class distribution; None for a map that was read from disk."""
    hits_removed: NDArray[np.uint32] | None = None
    """(v,) hits of moving objects; None: the hits of the removed voxels, and no others."""
    reasons: NDArray[np.uint8] | None = None
    """(v,) of `Reason`: why voxels were removed; None for a map that was not refined."""

    def __post_init__(self) -> None:
        for name, values in (
            ("labels", self.labels),
            ("confidence", self.confidence),
            ("states", self.states),
            ("entropy", self.entropy),
            ("hits_removed", self.hits_removed),
            ("reasons", self.reasons),
        ):
            if values is not None and values.shape != (len(self.voxels),):
                raise DataError(f"semantic map: found {values.shape} {name} for {len(self.voxels)} voxels")

    @classmethod
    def of(cls, voxels: VoxelMap) -> SemanticMap:
        """The fused map, before refinement."""
        probability = voxels.probabilities.max(axis=1, initial=0.0)
        return cls(
            voxels=voxels,
            labels=voxels.labels,
            confidence=np.where(voxels.observed, probability, 0).astype(np.float32),
            states=np.where(voxels.observed, State.OBSERVED, State.UNOBSERVED).astype(np.uint8),
            entropy=entropy_of(voxels.probabilities),
        )

    def __len__(self) -> int:
        return len(self.voxels)

    def __getitem__(self, chosen: NDArray[np.bool_] | NDArray[np.int64]) -> SemanticMap:
        """The voxels where a boolean mask holds, or those at increasing places."""
        return SemanticMap(
            self.voxels[chosen],
            self.labels[chosen],
            self.confidence[chosen],
            self.states[chosen],
            None if self.entropy is None else self.entropy[chosen],
            None if self.hits_removed is None else self.hits_removed[chosen],
            None if self.reasons is None else self.reasons[chosen],
        )

    @cached_property
    def shown(self) -> NDArray[np.bool_]:
        """(v,) mask of the labelled voxels without the removed ones."""
        return np.asarray((self.labels >= 0) & (self.states != State.REMOVED))

    @property
    def inferred(self) -> NDArray[np.bool_]:
        """(v,) mask of the labelled voxels that no camera saw, of which the label is inferred."""
        return np.asarray((self.labels >= 0) & (self.states == State.INFERRED))

    @property
    def told_reasons(self) -> NDArray[np.uint8]:
        """(v,) of `Reason`: NONE where the map does not tell."""
        return np.zeros(len(self), np.uint8) if self.reasons is None else self.reasons

    @property
    def removed_hits(self) -> NDArray[np.uint32]:
        """(v,) hits of moving objects."""
        return self.hits_of_removed if self.hits_removed is None else self.hits_removed

    @property
    def hits_of_removed(self) -> NDArray[np.uint32]:
        """(v,) hits of the removed voxels, 0 of others: those that moved, unless `hits_removed` says more."""
        return np.where(self.states == State.REMOVED, self.voxels.hits, np.uint32(0))

    @property
    def standing(self) -> VoxelMap:
        """The static map: without the removed voxels, and without the hits of moving objects in the others."""
        static = self.states != State.REMOVED
        voxels = self.voxels[static]
        return replace(voxels, hits=voxels.hits - self.removed_hits[static])


def entropy_of(probabilities: NDArray[np.float32]) -> NDArray[np.float32]:
    """Entropy (v,) nat of class distributions (v, c): 0 for a certain class, ln c for a uniform distribution."""
    terms = probabilities * np.log(np.maximum(probabilities, np.float32(1e-30)))
    return np.asarray(-sum(terms.T), np.float32)
