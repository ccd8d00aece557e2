"""Classifiers that were trained on nothing: trees of random numbers."""

from __future__ import annotations

import numpy as np

from gnss_sem_map.geometric_classifier.classifier import Classifier
from gnss_sem_map.geometric_classifier.features import NAMES
from gnss_sem_map.geometric_classifier.trees import INNER, LEAVES, BoostedTrees
from gnss_sem_map.labels.label_set import LabelSet, open_label_set

URBAN = open_label_set()
SIZE_M = 0.2


def random_trees(
    rng: np.random.Generator, classes: tuple[int, ...], rounds: int = 3, features: int = len(NAMES)
) -> BoostedTrees:
    """Some of their nodes send all to the left, as those of a tree that ended earlier."""
    scores = 1 if len(classes) == 2 else len(classes)
    trees = rounds * scores
    thresholds = rng.normal(0, 2, (trees, INNER)).astype(np.float32)
    thresholds[rng.random(thresholds.shape) < 0.1] = np.inf
    return BoostedTrees(
        np.array(classes, np.int8),
        rng.normal(0, 1, scores).astype(np.float32),
        rng.integers(0, features, (trees, INNER)).astype(np.int16),
        thresholds,
        rng.normal(0, 1, (trees, LEAVES)).astype(np.float32),
    )


def random_classifier(
    seed: int = 0, label_set: LabelSet = URBAN, size_m: float = SIZE_M, uses_intensity: bool = False
) -> Classifier:
    """The first model knows one class less than the second."""
    rng, count = np.random.default_rng(seed), len(label_set.names)
    folds = random_trees(rng, (0, *range(2, count + 1))), random_trees(rng, tuple(range(count + 1)))
    return Classifier(label_set.names, size_m, folds, 1.25, uses_intensity)
