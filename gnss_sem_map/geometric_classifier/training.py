"""Training rows: voxels that images show, with what these say of them; and the classifier that is fitted to them.

A row is a class with a weight: the confidence of the label, and beside it the images' share of `other`, which is a
class of its own. Without it every lawn would become road. Rows are chosen by a hash of the voxel's key, so the choice
depends neither on the order of the blocks nor on how many there are at a time. No truth is used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from gnss_sem_map.geometric_classifier.classifier import FOLDS, Classifier, folds_of, log_scores_of
from gnss_sem_map.geometric_classifier.features import features_of
from gnss_sem_map.geometric_classifier.trees import BoostedTrees
from gnss_sem_map.labels.label_set import LabelSet
from gnss_sem_map.refinement.state import Evidence, MapState
from gnss_sem_map.refinement.steps import STEPS, RefinementSettings, do
from gnss_sem_map.voxels.voxel_map import VoxelMap, best_classes, softmax

LABELLED_BY = ("discount", "geometric_prior", "potts_mrf")
"""Steps of the refinement after which the labels of images are what the classifier learns."""
LEAST_WEIGHT = 0.1
"""Rows of less are left out."""
FEWEST = 200
"""Rows that a fold needs, and of two classes each; with fewer there is no classifier."""
FEWEST_OF_CLASS = 20
"""Rows that a class needs in a fold, or it is not learned."""
NO_LABELS = "images label nothing"
TEMPERATURES = np.exp(np.linspace(-1.0, 2.0, 61))
_MIX = np.uint64(0x9E3779B97F4A7C15)


class GeometricClassifierSettings(BaseModel):
    """What the geometric classifier learns from, and how much it may say."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    enabled: bool = Field(True, description="Whether voxels are classified by shape and intensity as well.")
    model: Path | None = Field(
        None,
        description="A classifier of `gnss-sem-map fit-classifier`; null: every drive trains its own on the labels of"
        " its images.",
    )
    rows_per_fold: int = Field(
        6000, ge=FEWEST, le=1_000_000, description="Most training rows of a drive in each of the two folds."
    )
    kerb_weight: float = Field(
        1.0,
        ge=0,
        le=1,
        description="How much of the log odds of road against sidewalk by shape, learned from simulated towns, counts.",
    )


@dataclass(frozen=True, eq=False)
class Rows:
    """Training rows (r,) of one or more drives."""

    order: NDArray[np.uint64]
    """Hash of the voxel's key: the rows with the least are taken."""
    folds: NDArray[np.int8]
    classes: NDArray[np.int8]
    """c is `other`."""
    weights: NDArray[np.float32]
    features: NDArray[np.float32]
    """(r, f)."""

    def __len__(self) -> int:
        return len(self.order)

    def __getitem__(self, chosen: NDArray[Any]) -> Rows:
        return Rows(*(getattr(self, field.name)[chosen] for field in fields(self)))

    def __add__(self, other: Rows) -> Rows:
        return Rows(*(np.concatenate([getattr(one, f.name) for one in (self, other)]) for f in fields(self)))

    def first(self, per_fold: int) -> Rows:
        """At most so many of each fold, those with the least hashes, in their order."""
        return self[_first(self.order, self.folds, self.classes, per_fold)]


def _first(
    order: NDArray[np.uint64], folds: NDArray[np.integer], classes: NDArray[np.int8], per_fold: int
) -> NDArray[np.int64]:
    """Places of the rows with the least hashes, at most so many of each fold."""
    sort = np.lexsort((classes, order))
    return np.concatenate([sort[folds[sort] == fold][:per_fold] for fold in range(FOLDS)])


def rows_of(
    around: VoxelMap,
    intensity: NDArray[np.uint8],
    places: NDArray[np.int64],
    beside: Evidence,
    settings: RefinementSettings,
    most: int,
) -> Rows:
    """Training rows of the voxels at increasing places, most of each fold, by what is `around` them.

    `intensity` (v,) of all voxels `around`, 0 to 255; `beside` has the sensor model, if there is one.
    """
    state = MapState.of(around, beside)
    for step in STEPS:
        if step.name in LABELLED_BY:
            state, _ = do(step, state, settings)
    count, other = len(around.label_set.names), around.other_share[places]
    observed = around.observed[places]
    labels = best_classes(state.scores[places], observed)
    sure = softmax(state.scores[places]).max(axis=1, initial=0)
    voxels = np.concatenate([places[observed], places[other > 0]])
    classes = np.concatenate([labels[observed], np.full(np.count_nonzero(other > 0), count, np.int8)])
    weights = np.concatenate([(sure * (1 - other))[observed], other[other > 0]]).astype(np.float32)
    keep = weights >= LEAST_WEIGHT
    voxels, classes, weights = voxels[keep], classes[keep], weights[keep]
    keys = around.keys[voxels]
    order, folds = _hashes(keys), folds_of(keys, around.voxel_size_m).astype(np.int8)
    taken = _first(order, folds, classes, most)
    chosen, place_of = np.unique(voxels[taken], return_inverse=True)
    features = features_of(around, intensity, chosen)[place_of]
    return Rows(order[taken], folds[taken], classes[taken], weights[taken], features)


def fit(
    rows: Sequence[Rows], label_set: LabelSet, voxel_size_m: float, uses_intensity: bool
) -> Classifier | str:
    """The classifier of the training rows of some drives, or why there is none, in a few words."""
    together = reduce(Rows.__add__, rows)
    parts = []
    for fold in range(FOLDS):
        of_fold = together[np.flatnonzero(together.folds == fold)]
        count = np.bincount(of_fold.classes, minlength=len(label_set.names) + 1)
        of_fold = of_fold[np.flatnonzero(count[of_fold.classes] >= FEWEST_OF_CLASS)]
        if len(together) == 0:
            return NO_LABELS
        if len(of_fold) < FEWEST:
            return f"images label {len(together)} voxels, too few to learn from"
        if np.count_nonzero(count >= FEWEST_OF_CLASS) < 2:
            return "images know one class only, so there is nothing to learn"
        parts.append(of_fold)
    trees = tuple(BoostedTrees.fit(of.features, of.classes, of.weights.astype(np.float64)) for of in parts)
    temperature = _temperature(trees, parts, len(label_set.names) + 1)
    return Classifier(label_set.names, voxel_size_m, trees, temperature, uses_intensity)


def _temperature(trees: Sequence[BoostedTrees], parts: Sequence[Rows], answers: int) -> float:
    """The temperature at which each model finds the labels of the other fold most probable (Guo et al. 2017)."""
    held_out = [
        (rows, log_scores_of(model, rows.features, answers))
        for model, rows in zip(trees, reversed(parts), strict=True)
    ]

    def loss(temperature: float) -> float:
        total = 0.0
        for rows, scores in held_out:
            right = softmax(scores / np.float32(temperature))[np.arange(len(rows)), rows.classes]
            total -= float((rows.weights * np.log(np.maximum(right, 1e-4))).sum(dtype=np.float64))
        return total

    return float(min(TEMPERATURES, key=loss))


def _hashes(keys: NDArray[np.int64]) -> NDArray[np.uint64]:
    """Numbers (v,) that look like chance and follow from the key of each voxel alone (Fibonacci hashing, twice)."""
    mixed = keys.astype(np.uint64) * _MIX
    return np.asarray((mixed ^ mixed >> np.uint64(29)) * _MIX)
