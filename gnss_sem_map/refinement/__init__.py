"""Refinement (section 3.3): what the whole map knows that no single view does.

Every step turns log scores (v, c) into better ones, can be switched off, and reports what it changed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from gnss_sem_map.dynamics.motion_state import MotionSettings, TrackedObject
from gnss_sem_map.dynamics.visibility import KeyframeScans
from gnss_sem_map.labels.label_set import UNLABELLED, LabelSet
from gnss_sem_map.labels.sensor_model import LabelCalibration
from gnss_sem_map.refinement import count_grid, vehicles
from gnss_sem_map.refinement.count_grid import CountGridSettings
from gnss_sem_map.refinement.free_space import ClearingSettings, seen_through
from gnss_sem_map.refinement.geometric_prior import GeometrySettings, against
from gnss_sem_map.refinement.height_above_ground import height_over_ground
from gnss_sem_map.refinement.kerbs import Kerbs, find_kerbs
from gnss_sem_map.refinement.levels import StepSettings, tell_levels
from gnss_sem_map.refinement.normals import flatness
from gnss_sem_map.refinement.potts_mrf import SmoothingSettings, infer, mean_field
from gnss_sem_map.refinement.road_sidewalk import on_ways
from gnss_sem_map.refinement.systematic_error import doubted, systematic_errors
from gnss_sem_map.refinement.vehicles import VehicleObject, VehicleSettings
from gnss_sem_map.voxels.kernels import UNITS_PER_NAT
from gnss_sem_map.voxels.voxel_map import SemanticMap, State, VoxelMap, entropy_of, softmax

__all__ = [
    "RefinementReport",
    "RefinementSettings",
    "Step",
    "VehicleObject",
    "refine",
    "tell_ways",
    "with_removed",
]

Scores = NDArray[np.float32]
"""(v, c) log scores; their softmax is the class distribution."""

NAT_PER_LOOK = 1.3
"""Between a look that says nothing (1) and one that is sure (1.6 for five classes and a floor of 5 %)."""
SWITCHED_OFF, LACKING = "switched off", "the class set lacks one of them"
NO_ROAD = "the map has no road to stand on"
NO_WAYS = "the map has no road, or no sidewalk"
NO_WITNESS = "no scans with poses held by scan matching"


class RefinementSettings(BaseModel):
    """What is refined, and how: `paper` is section 3.3 to the letter, `evidence` what holds on real data."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    building_vegetation: Literal["evidence", "paper", "off"] = Field(
        default="evidence",
        description="Count grids (section 3.3.1): weigh a column's labels, or overwrite them.",
    )
    vehicles: Literal["evidence", "paper", "off"] = Field(
        default="evidence",
        description="Vehicles (section 3.3.2): support by object and motion by evidence, or eq. 12 and 13.",
    )
    systematic_errors: float | None = Field(
        default=None,
        ge=0,
        le=0.5,
        description="Share of looks that err in all views alike, so that looking again makes no voxel surer;"
        " default: estimated from the map itself, by how often geometry and neighbours overrule the images.",
    )
    confidence_temperature: float = Field(
        default=1.0,
        gt=0,
        le=100,
        description="Log scores are divided by this before confidence is read off them; a calibration file brings its"
        " own.",
    )
    infer_unobserved: bool = Field(
        default=False,
        description="Label voxels that no camera saw from their neighbours; they are marked as inferred.",
    )
    count_exponent: float = Field(
        default=0.5,
        ge=0,
        le=1,
        description="n looks at a voxel count as n to this power: they repeat each other's errors. 1 is eq. 6.",
    )
    geometry: Literal["rules", "off"] = Field(
        default="rules", description="Height over ground, and how flat it lies, as evidence against classes."
    )
    smoothing: Literal["mean_field", "off"] = Field(
        default="mean_field", description="Neighbouring voxels as evidence for each other."
    )
    clearing: Literal["evidence", "off"] = Field(
        default="evidence",
        description="Voxels that scan after scan looks through are what moved, where scan matching holds the poses.",
    )
    levels: Literal["evidence", "off"] = Field(
        default="evidence",
        description="Height tells road from sidewalk where the two lie on clearly two levels.",
    )
    kerbs: Literal["evidence", "off"] = Field(
        default="evidence",
        description="Points where road meets sidewalk, which are finer than voxels, go by their own place and height.",
    )
    heights: GeometrySettings = Field(
        default=GeometrySettings(), description="Numbers of the geometry rules."
    )
    columns: CountGridSettings = Field(default=CountGridSettings(), description="Numbers of the count grids.")
    support: VehicleSettings = Field(default=VehicleSettings(), description="Numbers of the vehicle rules.")
    neighbours: SmoothingSettings = Field(
        default=SmoothingSettings(), description="Numbers of the smoothing."
    )
    motion: MotionSettings = Field(default=MotionSettings(), description="Numbers of the evidence of motion.")
    emptiness: ClearingSettings = Field(default=ClearingSettings(), description="Numbers of the clearing.")
    step: StepSettings = Field(default=StepSettings(), description="Numbers of the levels and the kerbs.")


@dataclass(frozen=True)
class Step:
    """What one step of the refinement did."""

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

    steps: tuple[Step, ...]
    objects: tuple[VehicleObject, ...] = ()
    tracked: tuple[TrackedObject, ...] = ()
    """Objects through time, with the evidence of their motion."""
    systematic_errors: float = 0.0
    """Share of looks that err in all views alike, as far as the map can tell."""


def refine(
    voxels: VoxelMap,
    settings: RefinementSettings | None = None,
    removed: VoxelMap | None = None,
    tracked: tuple[TrackedObject, ...] = (),
    calibration: LabelCalibration | None = None,
    witnesses: KeyframeScans | None = None,
) -> tuple[SemanticMap, RefinementReport]:
    """Refine a whole map; no voxel is deleted, and one that no camera saw stays unlabelled.

    `removed` holds the points of moving objects that were kept out of `voxels`; they come back as a layer of REMOVED
    voxels wherever nothing else stands. `tracked` says why, for the report. A `calibration` brings where the classes
    were found to stand, instead of rules, and its own temperature. `witnesses` are scans that say what is empty; None:
    nobody knows, or poses are not sharp enough for it.
    """
    settings = settings or RefinementSettings()
    weighed = weigh(voxels, settings, calibration)
    moving, cleared = _clear(voxels, weighed, settings, witnesses)
    scores, inferred, spread = _infer(voxels, weighed.scores, settings)
    temperature = settings.confidence_temperature if calibration is None else calibration.temperature
    refined = _decide(voxels, scores, moving, inferred, temperature, weighed.systematic_errors)
    steps = [*weighed.steps, spread, cleared]
    if removed is not None:
        refined, layered = _with_layer(refined, removed)
        steps.append(layered)
    return refined, RefinementReport(tuple(steps), weighed.objects, tracked, weighed.systematic_errors)


def tell_ways(
    refined: SemanticMap,
    settings: RefinementSettings,
    measure: Callable[[SemanticMap, NDArray[np.bool_]], NDArray[np.float64]],
) -> tuple[SemanticMap, Kerbs | None, Step]:
    """Road and sidewalk told apart once more, by how high they lie: the voxels, and where points must be told apart.

    `measure` is asked for the heights (v,) m of the map's surface in some of its voxels (v,), NaN where unknown.
    """
    name = "levels"
    wanted = on_ways(refined)
    if "evidence" not in (settings.levels, settings.kerbs) or not wanted.any():
        return refined, None, Step(name, {}, SWITCHED_OFF if settings.levels == "off" else NO_WAYS)
    heights = measure(refined, wanted)
    step = Step(name, {}, SWITCHED_OFF)
    if settings.levels == "evidence":
        told = tell_levels(refined, heights, settings.step)
        step = Step(name, _changes(told.voxels.label_set, refined.labels, told.labels))
        refined = told
    kerbs = find_kerbs(refined, heights, settings.step) if settings.kerbs == "evidence" else None
    return refined, kerbs, step


@dataclass(frozen=True, eq=False)
class Weighed:
    """All evidence together, before anything is decided."""

    scores: Scores
    moving: NDArray[np.bool_]
    objects: tuple[VehicleObject, ...]
    steps: tuple[Step, ...]
    systematic_errors: float


def weigh(
    voxels: VoxelMap, settings: RefinementSettings, calibration: LabelCalibration | None = None
) -> Weighed:
    """What images, heights, columns, objects and neighbours say of every voxel together."""
    looks = _looks(voxels)
    images = _discounted(voxels, looks, settings.count_exponent)
    heights = height_over_ground(voxels.centres)
    scores, geometry = _weigh_heights(voxels, images, heights, settings, calibration)
    systematic = _systematic_errors(voxels, looks, images, scores, settings)
    scores, columns = _correct_columns(voxels, scores, settings)
    scores, moving, objects, judged = _judge_vehicles(voxels, scores, heights, settings)
    scores, smoothed = _smooth(voxels, scores, settings)
    return Weighed(scores, moving, objects, (geometry, columns, judged, smoothed), systematic)


def _with_layer(static: SemanticMap, removed: VoxelMap) -> tuple[SemanticMap, Step]:
    alone = removed[static.voxels.indices_of(removed.keys) < 0]
    gone = np.ones(len(alone), np.bool_)
    changes = _changes(alone.label_set, alone.labels, alone.labels, gone)
    return with_removed(static, removed), Step("moving objects", changes)


def _looks(voxels: VoxelMap) -> NDArray[np.float32]:
    """How often every voxel was looked at (v,), about, and at least once.

    A row does not say (hits count the points of scans that no image shows, too), but every look lowers the sum over the
    c classes by at least c ln c, and by little more than half as much again.
    """
    count = len(voxels.label_set.names)
    nats = -voxels.evidence.sum(axis=1, dtype=np.float32) / np.float32(UNITS_PER_NAT)
    return np.asarray(np.maximum(nats / np.float32(NAT_PER_LOOK * count * np.log(count)), 1), np.float32)


def _discounted(voxels: VoxelMap, looks: NDArray[np.float32], exponent: float) -> Scores:
    """Evidence in nat; n looks at a voxel count as n^exponent."""
    evidence = voxels.evidence.astype(np.float32) / np.float32(UNITS_PER_NAT)
    return np.asarray(evidence * (looks ** (exponent - 1))[:, None], np.float32)


def _systematic_errors(
    voxels: VoxelMap,
    looks: NDArray[np.float32],
    images: Scores,
    with_geometry: Scores,
    settings: RefinementSettings,
) -> float:
    """What is set, or what geometry and neighbours, each for itself, say of the images."""
    if settings.systematic_errors is not None:
        return settings.systematic_errors
    with_neighbours, _ = _smooth(voxels, images, settings)
    seen = voxels.observed
    called, by_geometry, by_neighbours = (
        scores[seen].argmax(axis=1) for scores in (images, with_geometry, with_neighbours)
    )
    return systematic_errors(by_geometry != called, by_neighbours != called, looks[seen])


def _labels(voxels: VoxelMap, scores: Scores) -> NDArray[np.int8]:
    return np.where(voxels.observed, scores.argmax(axis=1), UNLABELLED).astype(np.int8)


def _weigh_heights(
    voxels: VoxelMap,
    scores: Scores,
    heights: NDArray[np.float32],
    settings: RefinementSettings,
    calibration: LabelCalibration | None,
) -> tuple[Scores, Step]:
    """Height over ground and the surface's normal against classes that are not found there."""
    if settings.geometry == "off":
        return scores, Step("heights", {}, SWITCHED_OFF)
    lie = flatness(voxels.keys, voxels.observed)
    if calibration is None:
        refined = scores + against(heights, lie, voxels.label_set, settings.heights)
    else:
        refined = scores + calibration.of_geometry(heights, lie)
    return refined, _step("heights", voxels, scores, refined)


def _smooth(voxels: VoxelMap, scores: Scores, settings: RefinementSettings) -> tuple[Scores, Step]:
    """Neighbours for each other."""
    if settings.smoothing == "off":
        return scores, Step("smoothing", {}, SWITCHED_OFF)
    refined = mean_field(voxels.keys, scores, voxels.observed, settings.neighbours)
    return refined, _step("smoothing", voxels, scores, refined)


def _step(name: str, voxels: VoxelMap, before: Scores, after: Scores) -> Step:
    return Step(name, _changes(voxels.label_set, _labels(voxels, before), _labels(voxels, after)))


def _correct_columns(voxels: VoxelMap, scores: Scores, settings: RefinementSettings) -> tuple[Scores, Step]:
    """Building against vegetation, column by column (eq. 8 to 11)."""
    name, mode = "building and vegetation", settings.building_vegetation
    classes = _classes(voxels.label_set, "building", "vegetation")
    if mode == "off" or len(classes) < 2:
        return scores, Step(name, {}, SWITCHED_OFF if mode == "off" else LACKING)
    first, second = classes
    labels = _labels(voxels, scores)
    if mode == "paper":
        log_odds = count_grid.paper_log_odds(voxels.keys, labels, (first, second), settings.columns)
    else:
        own = scores[:, first] - scores[:, second]
        log_odds = count_grid.evidence_log_odds(
            voxels.keys, labels, own, (first, second), settings.columns, voxels.voxel_size_m
        )
    refined = count_grid.decide(scores, np.isin(labels, classes), (first, second), log_odds)
    return refined, _step(name, voxels, scores, refined)


def _judge_vehicles(
    voxels: VoxelMap, scores: Scores, heights: NDArray[np.float32], settings: RefinementSettings
) -> tuple[Scores, NDArray[np.bool_], tuple[VehicleObject, ...], Step]:
    """Which voxels are vehicles, and, in mode `paper`, which of those moved."""
    name, mode, nothing = "vehicles", settings.vehicles, np.zeros(len(voxels), np.bool_)
    classes = _classes(voxels.label_set, "vehicle", "road")
    if mode == "off" or len(classes) < 2:
        return (
            scores,
            nothing,
            (),
            Step(name, {}, SWITCHED_OFF if mode == "off" else LACKING),
        )
    labels = _labels(voxels, scores)
    if mode == "paper":
        found = vehicles.paper(
            voxels.indices, labels, classes[0], classes[1], settings.support, voxels.voxel_size_m
        )
        gone = found.moving | found.rejected
        return scores, gone, found.objects, Step(name, _changes(voxels.label_set, labels, labels, gone))
    if not (
        labels == classes[1]
    ).any():  # nothing is known of any vehicle: a camera that looks aside sees no road
        return scores, nothing, (), Step(name, {}, NO_ROAD)
    found = vehicles.supported(
        voxels.indices, labels, heights, classes[0], classes[1], settings.support, voxels.voxel_size_m
    )
    refined = scores.copy()
    refined[found.rejected, classes[0]] -= np.float32(settings.support.rejected_nat)
    return (
        refined,
        nothing,
        found.objects,
        Step(name, _changes(voxels.label_set, labels, _labels(voxels, refined))),
    )


def _infer(
    voxels: VoxelMap, scores: Scores, settings: RefinementSettings
) -> tuple[Scores, NDArray[np.bool_], Step]:
    """Voxels that no camera saw, from their neighbours."""
    name, nothing = "inferred", np.zeros(len(voxels), np.bool_)
    if not settings.infer_unobserved:
        return scores, nothing, Step(name, {}, SWITCHED_OFF)
    spread, inferred = infer(voxels.keys, scores, voxels.observed, settings.neighbours)
    labels = _labels(voxels, scores)
    after = np.where(inferred, spread.argmax(axis=1), labels).astype(np.int8)
    return spread, inferred, Step(name, _changes(voxels.label_set, labels, after))


def _clear(
    voxels: VoxelMap, weighed: Weighed, settings: RefinementSettings, witnesses: KeyframeScans | None
) -> tuple[NDArray[np.bool_], Step]:
    """What moved (v,): as weighed, and what witnesses look through."""
    name = "seen through"
    if settings.clearing == "off" or witnesses is None:
        return weighed.moving, Step(name, {}, SWITCHED_OFF if settings.clearing == "off" else NO_WITNESS)
    empty = seen_through(voxels, witnesses, settings.emptiness, settings.motion)
    labels = _labels(voxels, weighed.scores)
    return weighed.moving | empty, Step(name, _changes(voxels.label_set, labels, labels, empty))


def _decide(
    voxels: VoxelMap,
    scores: Scores,
    moving: NDArray[np.bool_],
    inferred: NDArray[np.bool_],
    temperature: float,
    systematic: float,
) -> SemanticMap:
    """The most probable class of every voxel, and how probable it is, unless the images err in all views alike."""
    known = voxels.observed | inferred
    labels = np.where(known, scores.argmax(axis=1), UNLABELLED).astype(np.int8)
    states = np.where(voxels.observed, State.OBSERVED, State.UNOBSERVED).astype(np.uint8)
    states[labels != voxels.labels] = State.REFINED
    states[inferred] = State.INFERRED
    states[moving] = State.REMOVED
    probabilities = doubted(softmax(scores / np.float32(temperature)), systematic)
    confidence = np.where(known, probabilities.max(axis=1, initial=0.0), 0).astype(np.float32)
    entropy = np.where(known, entropy_of(probabilities), np.log(scores.shape[1])).astype(np.float32)
    return SemanticMap(voxels, labels, confidence, states, entropy)


def with_removed(static: SemanticMap, removed: VoxelMap) -> SemanticMap:
    """The map with a layer of REMOVED voxels, of class vehicle, wherever nothing of the static map stands.

    Where something stands, its evidence and its decision stay, and the hits of what moved through are counted beside
    its own, in `hits_removed`: no point is lost. Raises DataError for another voxel size or class set.
    """
    alone = removed[static.voxels.indices_of(removed.keys) < 0]
    voxels = static.voxels + alone
    kept, added = voxels.indices_of(static.voxels.keys), voxels.indices_of(alone.keys)
    vehicle = _classes(voxels.label_set, "vehicle")
    labels, confidence = np.full(len(voxels), UNLABELLED, np.int8), np.zeros(len(voxels), np.float32)
    states = np.full(len(voxels), State.REMOVED, np.uint8)
    labels[kept], confidence[kept], states[kept] = static.labels, static.confidence, static.states
    labels[added] = vehicle[0] if vehicle else UNLABELLED
    confidence[added] = alone.probabilities[:, vehicle[0]] if vehicle else 0.0
    entropy = None
    if static.entropy is not None:
        entropy = np.empty(len(voxels), np.float32)
        entropy[kept], entropy[added] = static.entropy, entropy_of(alone.probabilities)
    refined = SemanticMap(voxels, labels, confidence, states, entropy)
    return refined if len(alone) == len(removed) else _with_hits(refined, static, removed)


def _with_hits(refined: SemanticMap, static: SemanticMap, removed: VoxelMap) -> SemanticMap:
    """The same voxels; those of `static` that things moved through have their hits as well."""
    hits, gone = refined.voxels.hits.copy(), refined.removed_hits.copy()
    through = removed[static.voxels.indices_of(removed.keys) >= 0]
    places = refined.voxels.indices_of(through.keys)
    hits[places] += through.hits
    gone[places] += through.hits
    return replace(refined, voxels=replace(refined.voxels, hits=hits), hits_removed=gone)


def _classes(label_set: LabelSet, *names: str) -> tuple[int, ...]:
    """The classes of these names that the set has."""
    return tuple(label_set.index(name) for name in names if name in label_set.names)


def _changes(
    label_set: LabelSet,
    before: NDArray[np.int8],
    after: NDArray[np.int8],
    removed: NDArray[np.bool_] | None = None,
) -> dict[tuple[str, str], int]:
    """How many voxels went from which class to which; class names end with `removed`."""
    names = [*label_set.names, "removed", "unlabelled"]  # -1, unlabelled, is the last
    targets = after if removed is None else np.where(removed, len(label_set.names), after)
    differ = targets != before
    pairs, counts = np.unique(np.stack([before[differ], targets[differ]]), axis=1, return_counts=True)
    return {(names[a], names[b]): int(n) for (a, b), n in zip(pairs.T, counts, strict=True)}
