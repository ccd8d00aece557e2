"""The refinement (section 3.3 of the paper): THE list of its steps, in the order in which they are done.

A step is a file of its own name: a settings class, `apply` (state in, state out), and `reach_m`, how far away it reads.
Its name is the same in the file, in the settings and in the report.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import reduce
from operator import add
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from gnss_sem_map.dynamics.motion_state import Motion, TrackedObject
from gnss_sem_map.refinement import (
    count_grid,
    crumbs,
    decision,
    discount,
    free_space,
    geometric_labels,
    geometric_prior,
    kerbs,
    potts_mrf,
    removed_layer,
    systematic_error,
    vehicles,
)
from gnss_sem_map.refinement.count_grid import CountGridSettings
from gnss_sem_map.refinement.crumbs import CrumbSettings
from gnss_sem_map.refinement.decision import DecisionSettings
from gnss_sem_map.refinement.discount import DiscountSettings
from gnss_sem_map.refinement.free_space import FreeSpaceSettings
from gnss_sem_map.refinement.geometric_labels import GeometricLabelSettings
from gnss_sem_map.refinement.geometric_prior import GeometricPriorSettings
from gnss_sem_map.refinement.kerbs import KerbSettings
from gnss_sem_map.refinement.potts_mrf import PottsSettings
from gnss_sem_map.refinement.removed_layer import RemovedLayerSettings
from gnss_sem_map.refinement.state import MapState, NotApplicable, StepSettings, VehicleObject
from gnss_sem_map.refinement.systematic_error import SystematicErrorSettings
from gnss_sem_map.refinement.vehicles import VehicleSettings


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
    geometric_labels: GeometricLabelSettings = Field(
        default=GeometricLabelSettings(),
        description="What the geometric classifier says: it corrects what images saw, and labels what no camera saw,"
        " which is marked as inferred.",
    )
    decision: DecisionSettings = Field(
        default=DecisionSettings(), description="The most probable class, and its confidence."
    )
    kerbs: KerbSettings = Field(
        default=KerbSettings(),
        description="Points where road meets sidewalk are classified by their own position and height, in `labels/`.",
    )
    free_space: FreeSpaceSettings = Field(
        default=FreeSpaceSettings(),
        description="Voxels that rays traverse again and again are removed, where poses are sharp enough.",
    )
    crumbs: CrumbSettings = Field(
        default=CrumbSettings(),
        description="Few points amid those of a moving object are removed with it.",
    )
    removed_layer: RemovedLayerSettings = Field(
        default=RemovedLayerSettings(),
        description="Moving objects come back as a layer that is not shown.",
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
        geometric_labels,
        decision,
        kerbs,
        free_space,
        crumbs,
        removed_layer,
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

    def __add__(self, other: StepReport) -> StepReport:
        """Of two parts of a map; a step was done when it was done in one of them."""
        changes = {
            pair: self.changes.get(pair, 0) + other.changes.get(pair, 0)
            for pair in sorted({*self.changes, *other.changes})
        }
        skipped = max(self.skipped, other.skipped) if self.skipped and other.skipped else ""
        return StepReport(self.name, changes, skipped)


@dataclass(frozen=True, eq=False)
class RefinementReport:
    """What every step changed, and every object that was judged."""

    steps: tuple[StepReport, ...]
    objects: tuple[VehicleObject, ...] = ()
    tracked: tuple[TrackedObject, ...] = ()
    """Objects through time, with the evidence of their motion."""
    systematic_errors: float = 0.0
    """Share of observations that are wrong in all views alike, as far as the map can tell."""
    untracked: int = 0
    """Objects that had too few points to be tracked."""

    def to_json(self) -> dict[str, Any]:
        """What it says of a block, without objects through time; `from_json` reads it back."""
        steps = [
            {
                "name": step.name,
                "changes": [[*pair, n] for pair, n in step.changes.items()],
                "skipped": step.skipped,
            }
            for step in self.steps
        ]
        objects = [asdict(thing) | {"centre": thing.centre.tolist()} for thing in self.objects]
        return {"steps": steps, "objects": objects, "systematic_errors": self.systematic_errors}

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> RefinementReport:
        """Raises KeyError, TypeError or ValueError for anything else."""
        steps = [
            StepReport(
                str(step["name"]),
                {(str(a), str(b)): int(n) for a, b, n in step["changes"]},
                str(step["skipped"]),
            )
            for step in content["steps"]
        ]
        if [step.name for step in steps] != [step.name for step in STEPS]:
            raise ValueError("a report of other steps")
        objects = tuple(_object_of(thing) for thing in content["objects"])
        return cls(tuple(steps), objects, (), float(content["systematic_errors"]))

    @classmethod
    def joined(cls, reports: Sequence[RefinementReport]) -> RefinementReport:
        """Of all parts of a map, one at least; objects are numbered from west to east."""
        objects = sorted(
            (thing for report in reports for thing in report.objects), key=lambda thing: tuple(thing.centre)
        )
        return cls(
            tuple(reduce(add, parts) for parts in zip(*(report.steps for report in reports), strict=True)),
            tuple(replace(thing, number=number) for number, thing in enumerate(objects)),
            tuple(one for report in reports for one in report.tracked),
            max(report.systematic_errors for report in reports),
            sum(report.untracked for report in reports),
        )


def _object_of(thing: Mapping[str, Any]) -> VehicleObject:
    x, y = thing["tile"]
    centre = np.array(thing["centre"], np.float64)
    return VehicleObject(
        **{**thing, "motion": Motion(thing["motion"]), "centre": centre, "tile": (int(x), int(y))}
    )


def do(
    step: Step, state: MapState, settings: RefinementSettings, own: NDArray[np.bool_] | None = None
) -> tuple[MapState, StepReport]:
    """The state after a step, and what it changed in a map's `own` voxels (v,), all by default."""
    section = step.settings(settings)
    if not section.enabled:
        return state, StepReport(step.name, {}, "switched off")
    try:
        after = step.apply(state, section)
    except NotApplicable as reason:
        return state, StepReport(step.name, {}, str(reason))
    return after, StepReport(step.name, _changes(state, after, own))


def _changes(before: MapState, after: MapState, own: NDArray[np.bool_] | None) -> dict[tuple[str, str], int]:
    """How many voxels went from which class to which; a voxel that is new in the map was what its evidence says."""
    if after.scores is before.scores and after.decided is before.decided and after.removed is before.removed:
        return {}
    names = [*after.voxels.label_set.legend.names, "removed", "unlabelled"]  # -1, unlabelled, is the last
    source, target = before.told, after.told
    if len(source) < len(target):
        assert after.decided is not None
        known = after.decided.voxels.labels.copy()
        known[after.decided.voxels.indices_of(before.voxels.keys)] = source
        source = known
    differ = target != source if own is None else (target != source) & own
    # -1 comes first; sorting the pairs would take as long as a step does
    pairs = (source[differ].astype(np.intp) + 1) * len(names) + target[differ] + 1
    counts = np.bincount(pairs, minlength=len(names) ** 2).reshape(len(names), -1)
    return {(names[a - 1], names[b - 1]): int(counts[a, b]) for a, b in np.argwhere(counts)}
