"""Boosted trees of one depth as arrays: fitted by scikit-learn, walked by a compiled loop, saved without pickles."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from gnss_sem_map.errors import DataError

DEPTH = 4
INNER, LEAVES = (1 << DEPTH) - 1, 1 << DEPTH
"""Nodes of a whole tree: the children of node n are 2 n + 1 and 2 n + 2."""
ALL_LEAVES, DE_BRUIJN = (1 << LEAVES) - 1, 0x0F2D
"""As bits; and a number whose products with the 16 bits differ in bits 12 to 15."""
ROUNDS, OF_ALL_ROUNDS, LEAST_IN_LEAF = 80, 4.0, 100
"""Few labels are independent of each other, as views of one surface err alike: small trees of many voxels, in small
steps: the learning rate is `OF_ALL_ROUNDS` / rounds."""
SHARE_OF_FEATURES = 0.5
"""Of each split."""
BINS = 63
SEED = 0
ROWS_AT_ONCE = 256
"""Voxels that walk through a tree one after another, while it and their features are in the cache."""
CORES_VARIABLE = "LOKY_MAX_CPU_COUNT"
MOST_TREES, MOST_IN_LEAF = 1 << 14, 1e6


@dataclass(frozen=True, eq=False)
class BoostedTrees:
    """Trees whose leaves add up to scores: of k classes in turn, or the log odds of the second of two classes."""

    classes: NDArray[np.int8]
    """(k,) that it was fitted to, in ascending order."""
    baseline: NDArray[np.float32]
    """(s,) scores before the first tree; s is k, or 1 for two classes."""
    features: NDArray[np.int16]
    """(t, 15) column that an inner node looks at."""
    thresholds: NDArray[np.float32]
    """(t, 15): up to it one goes left. Infinite where the tree that was fitted ends earlier."""
    leaves: NDArray[np.float32]
    """(t, 16) what a leaf adds."""

    @classmethod
    def fit(
        cls,
        features: NDArray[np.float32],
        classes: NDArray[np.int8],
        weights: NDArray[np.float64],
        rounds: int = ROUNDS,
    ) -> BoostedTrees:
        """Fit them to the classes (r,) of rows (r, f), two different ones at least.

        Histogram gradient boosting (Ke et al. 2017, as scikit-learn has it), in one thread: so it gives the same bits
        on any number of cores. It is given the numbers of bins in place of the features: its own search for them takes
        three quarters of the time, and depends on its version.
        """
        from sklearn.ensemble import HistGradientBoostingClassifier

        model = HistGradientBoostingClassifier(
            max_iter=rounds, max_depth=DEPTH, max_leaf_nodes=LEAVES, learning_rate=OF_ALL_ROUNDS / rounds,
            min_samples_leaf=LEAST_IN_LEAF, max_features=SHARE_OF_FEATURES, max_bins=BINS, early_stopping=False,
            random_state=SEED,
        )  # fmt: skip
        limits = [_limits_of_bins(column, weights) for column in features.T]
        bins = [np.searchsorted(of, column) for of, column in zip(limits, features.T, strict=True)]
        with _one_core():
            model.fit(np.column_stack(bins), classes, sample_weight=weights)
        trees = [_whole(tree.nodes, limits) for of_round in model._predictors for tree in of_round]
        columns, thresholds, leaves = map(np.stack, zip(*trees, strict=True))
        baseline = model._baseline_prediction.ravel().astype(np.float32)
        return cls(model.classes_.astype(np.int8), baseline, columns, thresholds, leaves)

    def scores(self, features: NDArray[np.float32]) -> NDArray[np.float32]:
        """Sums of baseline and trees (v, s) of rows (v, f)."""
        scores = np.tile(self.baseline, (len(features), 1))
        _walk(features, self.features, self.thresholds, self.leaves, scores)
        return scores

    def check(self, features: int, classes: int) -> None:
        """Raise DataError unless these are trees for so many features and classes, in arrays as the fields say."""
        kinds = (np.int8, np.float32, np.int16, np.float32, np.float32)
        arrays: tuple[NDArray[Any], ...] = (
            self.classes, self.baseline, self.features, self.thresholds, self.leaves,
        )  # fmt: skip
        if (
            any(array.dtype != kind for array, kind in zip(arrays, kinds, strict=True))
            or self.classes.ndim != 1
            or self.leaves.ndim != 2
        ):
            raise DataError("its arrays have other types")
        trees, known = len(self.leaves), self.classes
        scores = 1 if len(known) == 2 else len(known)
        shapes = (scores,), (trees, INNER), (trees, INNER), (trees, LEAVES)
        if len(known) < 2 or (known[1:] <= known[:-1]).any() or known[0] < 0 or known[-1] >= classes:
            raise DataError("its trees are of other classes")
        if (
            tuple(array.shape for array in arrays[1:]) != shapes
            or not 0 < trees <= MOST_TREES
            or trees % scores
        ):
            raise DataError("its arrays are no trees of one depth")
        if (self.features < 0).any() or (self.features >= features).any() or np.isnan(self.thresholds).any():
            raise DataError("its trees look at features that are none")
        if not all((np.abs(array) <= MOST_IN_LEAF).all() for array in (self.leaves, self.baseline)):
            raise DataError(f"its leaves are not within {MOST_IN_LEAF:g}")


@contextmanager
def _one_core() -> Iterator[None]:
    """While it lasts, OpenMP has one thread, and joblib, which scikit-learn asks, starts no process to count cores."""
    before = os.environ.get(CORES_VARIABLE)
    os.environ[CORES_VARIABLE] = "1"
    try:
        with threadpool_limits(1):
            yield
    finally:
        os.environ.pop(CORES_VARIABLE)
        if before is not None:
            os.environ[CORES_VARIABLE] = before


def _limits_of_bins(column: NDArray[np.float32], weights: NDArray[np.float64]) -> NDArray[np.float32]:
    """The limits up to which values of a feature (r,) are in each bin but the last; bins of about one weight."""
    values = np.unique(column)
    if len(values) <= BINS:
        return np.asarray((values[:-1] + values[1:]) / np.float32(2))
    order = np.argsort(column, kind="stable")
    weight = np.cumsum(weights[order])
    last = np.searchsorted(weight, np.arange(1, BINS) / BINS * weight[-1])
    return np.unique(column[order[np.minimum(last, len(order) - 1)]])


def _whole(
    nodes: NDArray[Any], limits: list[NDArray[np.float32]]
) -> tuple[NDArray[np.int16], NDArray[np.float32], NDArray[np.float32]]:
    """A tree of scikit-learn, in which every path has the same length: where it ended, all go left.

    It splits numbers of bins, with these `limits`.
    """
    columns, thresholds = np.zeros(INNER, np.int16), np.full(INNER, np.inf, np.float32)
    leaves = np.zeros(LEAVES, np.float32)
    there = {0: 0}  # place in the whole tree -> place in `nodes`
    for place in range(INNER + LEAVES):
        if place not in there:
            continue
        node = nodes[there[place]]
        if place >= INNER:
            leaves[place - INNER] = node["value"]
        elif node["is_leaf"]:
            there[2 * place + 1] = there[place]
        else:
            column = columns[place] = node["feature_idx"]
            thresholds[place] = limits[column][int(node["num_threshold"])]
            there[2 * place + 1], there[2 * place + 2] = int(node["left"]), int(node["right"])
    return columns, thresholds, leaves


@njit(cache=True, nogil=True)
def _walk(rows, features, thresholds, leaves, scores):
    """Every row goes through every tree.

    All nodes of a tree answer, also those that a row does not pass, and strike out the leaves that it cannot reach any
    more; the first that is left is its leaf (QuickScorer, Lucchese et al. 2015). So one vector instruction compares a
    feature of many rows: a sixth of the time of a look at four nodes of one row after another.
    """
    columns, here = scores.shape[1], np.zeros((rows.shape[1], ROWS_AT_ONCE), np.float32)
    total, reachable = np.empty(ROWS_AT_ONCE, np.float32), np.empty(ROWS_AT_ONCE, np.int32)
    to_the_right, slots = _reached_to_the_right(), _slots()
    by_slot = np.empty(LEAVES, np.float32)
    for first in range(0, len(rows), ROWS_AT_ONCE):
        count = min(ROWS_AT_ONCE, len(rows) - first)
        for i in range(count):
            for f in range(rows.shape[1]):
                here[f, i] = rows[first + i, f]
        for column in range(columns):
            for i in range(count):
                total[i] = scores[first + i, column]
            for tree in range(column, len(leaves), columns):
                reachable[:] = ALL_LEAVES
                for node in range(INNER):
                    values, threshold = here[features[tree, node]], thresholds[tree, node]
                    left_out = to_the_right[node]
                    for i in range(ROWS_AT_ONCE):
                        reachable[i] &= left_out if values[i] > threshold else ALL_LEAVES
                for leaf in range(LEAVES):
                    by_slot[slots[leaf]] = leaves[tree, leaf]
                for i in range(count):
                    total[i] += by_slot[_slot(reachable[i] & -reachable[i])]
            for i in range(count):
                scores[first + i, column] = total[i]


@njit(cache=True, nogil=True)
def _slot(bit):
    """A number from 0 to 15 for each of 16 bits (de Bruijn multiplication)."""
    return ((bit * DE_BRUIJN) & ALL_LEAVES) >> 12


@njit(cache=True, nogil=True)
def _slots():
    """The slot of each leaf, (16,)."""
    slots = np.empty(LEAVES, np.int32)
    for leaf in range(LEAVES):
        slots[leaf] = _slot(1 << leaf)
    return slots


@njit(cache=True, nogil=True)
def _reached_to_the_right():
    """Of every inner node (15,) the leaves, as bits, that stay possible where a row goes right."""
    masks = np.empty(INNER, np.int32)
    for level in range(DEPTH):
        width = LEAVES >> level  # leaves below a node of this level
        for place in range(1 << level):
            on_the_left = ((1 << width // 2) - 1) << place * width
            masks[(1 << level) - 1 + place] = ALL_LEAVES ^ on_the_left
    return masks
