"""The refinement (section 3.3 of the paper): THE list of its steps, in the order in which they are done.

A step is a file of its own name: a settings class, `apply` (state in, state out), and `reach_m`, how far away it reads.
Its name is the same in the file, in the settings and in the report.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from gnss_sem_map.dynamics.motion_state import TrackedObject
from gnss_sem_map.refinement import (
    count_grid,
    decision,
    discount,
    free_space,
    geometric_prior,
    kerbs,
    levels,
    potts_mrf,
    removed_layer,
    systematic_error,
    unobserved,
    vehicles,
)
from gnss_sem_map.refinement.count_grid import CountGridSettings
from gnss_sem_map.refinement.decision import DecisionSettings
from gnss_sem_map.refinement.discount import DiscountSettings
from gnss_sem_map.refinement.free_space import FreeSpaceSettings
from gnss_sem_map.refinement.geometric_prior import GeometricPriorSettings
from gnss_sem_map.refinement.kerbs import KerbSettings
from gnss_sem_map.refinement.levels import LevelSettings
from gnss_sem_map.refinement.potts_mrf import PottsSettings
from gnss_sem_map.refinement.removed_layer import RemovedLayerSettings
from gnss_sem_map.refinement.state import Evidence, MapState, NotApplicable, StepSettings, VehicleObject
from gnss_sem_map.refinement.systematic_error import SystematicErrorSettings
from gnss_sem_map.refinement.unobserved import UnobservedSettings
from gnss_sem_map.refinement.vehicles import VehicleSettings
from gnss_sem_map.voxels.semantic_map import SemanticMap
from gnss_sem_map.voxels.voxel_map import VoxelMap


class RefinementSettings(BaseModel):
    """One section per step, in their order."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    discount: DiscountSettings = Field(
        default=DiscountSettings(), description="Repeated observations of a voxel count as fewer."
    )
    geometric_prior: GeometricPriorSettings = Field(
        default=GeometricPriorSettings(),
        description="Height over ground, and how flat a surface lies, as evidence against classes.",
    )
    systematic_error: SystematicErrorSettings = Field(
        default=SystematicErrorSettings(),
        description="How often images err in all views alike, which limits the confidence.",
    )
    count_grid: CountGridSettings = Field(
        default=CountGridSettings(),
        description="Building against vegetation, column by column (section 3.3.1).",
    )
    vehicles: VehicleSettings = Field(
        default=VehicleSettings(), description="Vehicles stand on road (section 3.3.2)."
    )
    potts_mrf: PottsSettings = Field(
        default=PottsSettings(), description="Neighbouring voxels as evidence for each other."
    )
    free_space: FreeSpaceSettings = Field(
        default=FreeSpaceSettings(),
        description="Voxels that rays traverse again and again are removed, where poses come from LiDAR odometry.",
    )
    unobserved: UnobservedSettings = Field(
        default=UnobservedSettings(),
        description="Labels for voxels that no camera saw, from their neighbours; they are marked as inferred.",
    )
    decision: DecisionSettings = Field(
        default=DecisionSettings(), description="The most probable class, and its confidence."
    )
    removed_layer: RemovedLayerSettings = Field(
        default=RemovedLayerSettings(),
        description="Moving objects come back as a layer that is not shown.",
    )
    levels: LevelSettings = Field(
        default=LevelSettings(),
        description="Height tells road from sidewalk where the two lie on clearly two levels.",
    )
    kerbs: KerbSettings = Field(
        default=KerbSettings(),
        description="Points where road meets sidewalk are classified by their own position and height, in `labels/`.",
    )


@dataclass(frozen=True)
class Step:
    """One step of the refinement."""

    name: str
    apply: Callable[[MapState, Any], MapState]
    reach_m: Callable[[Any, float], float]
    """Settings and voxel size, m -> how far from a voxel evidence can change it, m."""

    def settings(self, settings: RefinementSettings) -> StepSettings:
        """The section of this step."""
        section: StepSettings = getattr(settings, self.name)
        return section


STEPS = tuple(
    Step(module.__name__.rsplit(".", 1)[1], module.apply, module.reach_m)
    for module in (
        discount,
        geometric_prior,
        systematic_error,
        count_grid,
        vehicles,
        potts_mrf,
        free_space,
        unobserved,
        decision,
        removed_layer,
        levels,
        kerbs,
    )
)


@dataclass(frozen=True)
class StepReport:
    """What one step changed."""

    name: str
    changes: Mapping[tuple[str, str], int]
    """(from, to) class -> voxels; `removed` for those that left the shown map."""
    skipped: str = ""
    """Why it was not done; empty when it was."""

    @property
    def changed(self) -> int:
        """Voxels that changed."""
        return sum(self.changes.values())


@dataclass(frozen=True, eq=False)
class RefinementReport:
    """What every step changed, and every object that was judged."""

    steps: tuple[StepReport, ...]
    objects: tuple[VehicleObject, ...] = ()
    tracked: tuple[TrackedObject, ...] = ()
    """Objects through time, with the evidence of their motion."""
    systematic_errors: float = 0.0
    """Share of observations that are wrong in all views alike, as far as the map can tell."""


def refine(
    voxels: VoxelMap, settings: RefinementSettings | None = None, beside: Evidence | None = None
) -> tuple[SemanticMap, RefinementReport]:
    """Refine a whole map; no voxel is deleted, and one that no camera saw stays unlabelled unless it is inferred."""
    state, report = run_steps(voxels, settings, beside)
    assert state.decided is not None
    return state.decided, report


def run_steps(
    voxels: VoxelMap, settings: RefinementSettings | None = None, beside: Evidence | None = None
) -> tuple[MapState, RefinementReport]:
    """All steps one after the other: the last state, decided, and what each of them changed."""
    settings = settings or RefinementSettings()
    state, reports = MapState.of(voxels, beside or Evidence()), []
    for step in STEPS:
        state, report = _do(step, state, step.settings(settings))
        reports.append(report)
    return state, RefinementReport(tuple(reports), state.vehicles, systematic_errors=state.systematic_error)


def _do(step: Step, state: MapState, settings: StepSettings) -> tuple[MapState, StepReport]:
    if not settings.enabled:
        return state, StepReport(step.name, {}, "switched off")
    try:
        after = step.apply(state, settings)
    except NotApplicable as reason:
        return state, StepReport(step.name, {}, str(reason))
    return after, StepReport(step.name, _changes(state, after))


def _changes(before: MapState, after: MapState) -> dict[tuple[str, str], int]:
    """How many voxels went from which class to which; a voxel that is new in the map was what its evidence says."""
    names = [*after.voxels.label_set.names, "removed", "unlabelled"]  # -1, unlabelled, is the last
    removed = len(names) - 2
    target = np.where(after.is_removed, removed, after.labels)
    source = np.where(before.is_removed, removed, before.labels)
    if after.voxels is not before.voxels:
        known = after.voxels.labels.astype(np.int64)
        known[after.voxels.indices_of(before.voxels.keys)] = source
        source = known
    differ = target != source
    pairs, counts = np.unique(np.stack([source[differ], target[differ]]), axis=1, return_counts=True)
    return {(names[a], names[b]): int(n) for (a, b), n in zip(pairs.T, counts, strict=True)}
