"""What goes through the refinement, step by step: the map, the evidence beside it, and what is decided so far."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from gnss_sem_map.dynamics.motion_state import Motion
from gnss_sem_map.dynamics.visibility import Keyframes
from gnss_sem_map.labels.label_set import LabelSet
from gnss_sem_map.labels.roles import Role
from gnss_sem_map.labels.sensor_model import LabelCalibration
from gnss_sem_map.refinement.figures import Figures
from gnss_sem_map.refinement.height_above_ground import height_over_ground
from gnss_sem_map.refinement.kerb_points import Kerbs
from gnss_sem_map.voxels.kernels import UNITS_PER_NAT, find
from gnss_sem_map.voxels.semantic_map import Reason, SemanticMap, State
from gnss_sem_map.voxels.tile_files import Tile
from gnss_sem_map.voxels.voxel_map import VoxelMap, best_classes

Scores = NDArray[np.float32]
"""(v, c) log scores; their softmax is the class distribution."""

NAT_PER_OBSERVATION = 1.3
"""Between an uninformative observation (1) and a certain one (1.6 for five classes and a floor of 5 %)."""


class StepSettings(BaseModel):
    """What the settings of every step have."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    enabled: bool = Field(default=True, description="Whether this step is done.")


class NotApplicable(Exception):
    """A step has nothing to work on in this map; its message says what is missing."""


@dataclass(frozen=True, eq=False)
class GeometricEvidence:
    """What geometric classifiers say of voxels; that of several drives is added in whole numbers."""

    keys: NDArray[np.int64]
    """(v,) sorted."""
    sums: NDArray[np.int32]
    """(v, c + 2) in 2^-10 nat: log probabilities of the classes and of `other`; log odds of sidewalk by kerbs."""
    drives: NDArray[np.int32]
    """(v,) that say it."""

    def __add__(self, other: GeometricEvidence) -> GeometricEvidence:
        keys = np.union1d(self.keys, other.keys)
        sums, drives = np.zeros((len(keys), self.sums.shape[1]), np.int32), np.zeros(len(keys), np.int32)
        for one in (self, other):
            places = np.searchsorted(keys, one.keys)
            sums[places] += one.sums
            drives[places] += one.drives
        return GeometricEvidence(keys, sums, drives)

    def of(self, keys: NDArray[np.int64]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Means of voxels by their sorted keys, nat; NaN where no drive says anything.

        Log probabilities (n, c + 1), and log odds of sidewalk against road by the shape of kerbs (n,).
        """
        places = np.empty(len(keys), np.int64)
        find(self.keys, keys, places)
        found = np.full((len(keys), self.sums.shape[1]), np.nan, np.float32)
        known = places >= 0
        of_known = places[known]
        found[known] = self.sums[of_known] / (np.float32(UNITS_PER_NAT) * self.drives[of_known, None])
        return found[:, :-1], found[:, -1]


@dataclass(frozen=True, eq=False)
class Evidence:
    """What is known beside the map itself; None for what is not."""

    moved: VoxelMap | None = None
    """The points of moving objects, which were kept out of the map."""
    sensor_model: LabelCalibration | None = None
    """Where the classes were found to stand, in place of rules, and a temperature."""
    keyframes: Keyframes | None = None
    """Scans that say which space is free; only with poses sharp enough for it."""
    geometry: GeometricEvidence | None = None
    """What geometric classifiers say of the shape and intensity of voxels."""


@dataclass(frozen=True, eq=False)
class VehicleObject:
    """One group of vehicle voxels and what was decided about it."""

    number: int
    motion: Motion
    reason: str
    voxels: int
    centre: NDArray[np.float64]
    """(3,) m, in the map frame."""
    length_m: float
    tile: Tile
    """The first one, by x and then y, that holds a part of it: its block reports it."""


@dataclass(frozen=True, eq=False)
class MapState:
    """A map between two steps of the refinement."""

    voxels: VoxelMap
    beside: Evidence
    figures: Figures
    """What is known of the whole map, of which this may be a part."""
    heights: NDArray[np.float32]
    """(v,) m, of every voxel over the ground."""
    scores: Scores
    """What everything so far says."""
    removed: NDArray[np.bool_]
    """(v,) part of something that moved."""
    inferred: NDArray[np.bool_]
    """(v,) labelled from its surroundings: no camera saw it."""
    systematic_error: float = 0.0
    """Share of observations that are wrong in all views alike."""
    vehicles: tuple[VehicleObject, ...] = ()
    """Groups of vehicle voxels, and what was decided about each."""
    kerbs: Kerbs | None = None
    """Voxels whose points are classified one by one."""
    decided: SemanticMap | None = None
    """The map with its decisions, once they are made; later steps change those, and the last adds a layer."""

    @classmethod
    def of(
        cls,
        voxels: VoxelMap,
        beside: Evidence,
        figures: Figures | None = None,
        heights: NDArray[np.float32] | None = None,
    ) -> MapState:
        """The state before the first step: eq. 6, every observation counted in full.

        `heights` (v,) m over ground, if voxels around these tell where it is.
        """
        if heights is None:
            heights = height_over_ground(voxels.centres)
        scores = np.divide(voxels.evidence, np.float32(UNITS_PER_NAT), dtype=np.float32)
        nothing = np.zeros(len(voxels), np.bool_)
        return cls(voxels, beside, figures or Figures(), heights, scores, nothing, nothing)

    def __getitem__(self, chosen: NDArray[np.int64]) -> MapState:
        """The voxels at increasing places, with all that is known of them."""
        if len(chosen) == len(self.voxels):
            return self
        voxels = self.voxels[chosen]
        return replace(
            self,
            voxels=voxels,
            heights=self.heights[chosen],
            scores=self.scores.take(chosen, axis=0),
            removed=self.removed[chosen],
            inferred=self.inferred[chosen],
            decided=None if self.decided is None else replace(self.decided[chosen], voxels=voxels),
            kerbs=None if self.kerbs is None else self._kerbs_in(voxels),
        )

    def _kerbs_in(self, voxels: VoxelMap) -> Kerbs:
        assert self.kerbs is not None
        return self.kerbs[np.flatnonzero(voxels.indices_of(self.kerbs.keys) >= 0)]

    @cached_property
    def labels(self) -> NDArray[np.int8]:
        """The class of every voxel (v,), -1 where nothing is known."""
        if self.decided is not None:
            return self.decided.labels
        known = self.voxels.observed | self.inferred
        return best_classes(self.scores, known)

    @property
    def is_removed(self) -> NDArray[np.bool_]:
        """Which voxels (v,) are part of something that moved."""
        return self.removed if self.decided is None else self.decided.states == State.REMOVED

    @property
    def on_kerbs(self) -> NDArray[np.bool_]:
        """Which voxels (v,) have points that are classified one by one."""
        found = np.zeros(len(self.voxels), np.bool_)
        if self.kerbs is not None:
            found[self.voxels.indices_of(self.kerbs.keys)] = True
        return found

    @cached_property
    def told(self) -> NDArray[np.int8]:
        """What the map tells of every voxel (v,): its label, -1 where nothing is known, c + 1 where it is removed."""
        return np.where(self.is_removed, np.int8(len(self.voxels.label_set.legend.names)), self.labels)

    def without(self, gone: NDArray[np.bool_], reason: Reason) -> MapState:
        """The decided map with these voxels (v,) removed; of those that were, the reason stays."""
        assert self.decided is not None
        states = np.where(gone, np.uint8(State.REMOVED), self.decided.states)
        reasons = np.where(gone & ~self.is_removed, np.uint8(reason), self.decided.told_reasons)
        return replace(self, decided=replace(self.decided, states=states, reasons=reasons))

    @cached_property
    def observations(self) -> NDArray[np.float32]:
        """How often every voxel was observed (v,), about, and at least once.

        A row does not say (hits count the points of scans that no image shows, too), but every observation lowers the
        sum over the c classes by at least c ln c, and by little more than half as much again.
        """
        count = len(self.voxels.label_set.names)
        nats = -sum(self.voxels.evidence.T.astype(np.float32)) / np.float32(UNITS_PER_NAT)
        return np.asarray(
            np.maximum(nats / np.float32(NAT_PER_OBSERVATION * count * np.log(count)), 1), np.float32
        )


def classes_of(label_set: LabelSet, *roles: Role) -> tuple[int, ...]:
    """The first class of each of these roles; raises NotApplicable where the set lacks one."""
    found = {role: label_set.the(role) for role in roles}
    if missing := [role for role, label in found.items() if label is None]:
        raise NotApplicable(f"no class of the set has the role {missing[0]}")
    return tuple(label for label in found.values() if label is not None)
