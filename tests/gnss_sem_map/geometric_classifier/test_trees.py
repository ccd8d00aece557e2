"""Boosted trees against scikit-learn, which fits them, and against a walk node by node."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
from classifiers import random_trees
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from sklearn.ensemble import HistGradientBoostingClassifier
from threadpoolctl import threadpool_limits

from gnss_sem_map.errors import DataError
from gnss_sem_map.geometric_classifier import trees
from gnss_sem_map.geometric_classifier.trees import DEPTH, INNER, BoostedTrees


def labelled(classes: tuple[int, ...]) -> tuple[NDArray[np.float32], NDArray[np.int8], NDArray[np.float64]]:
    """Rows of which some are whole numbers, as many features are; classes that follow from them; weights."""
    rng = np.random.default_rng(len(classes))
    rows = rng.normal(0, 3, (3000, 6)).astype(np.float32)
    rows[:, :3] = np.rint(rows[:, :3])
    chosen = (rows[:, 0] > 0).astype(int) + (rows[:, 3] * rows[:, 4] > 1) + (rng.random(3000) < 0.1)
    return rows, np.array(classes, np.int8)[chosen % len(classes)], rng.uniform(0.1, 1, 3000)


@pytest.mark.parametrize("classes", [(1, 4), (0, 2, 5), (0, 1, 2, 5)])
def test_scores_are_those_of_scikit_learn(classes: tuple[int, ...]) -> None:
    """Also of rows that lie on a threshold, or one float beside it."""
    rows, of_rows, weights = labelled(classes)
    found = BoostedTrees.fit(rows, of_rows, weights)
    found.check(rows.shape[1], 6)
    assert found.classes.tolist() == list(classes)
    oracle = HistGradientBoostingClassifier(
        max_iter=trees.ROUNDS, max_depth=DEPTH, max_leaf_nodes=trees.LEAVES,
        learning_rate=trees.OF_ALL_ROUNDS / trees.ROUNDS,
        min_samples_leaf=trees.LEAST_IN_LEAF, max_features=trees.SHARE_OF_FEATURES, max_bins=trees.BINS,
        early_stopping=False, random_state=trees.SEED,
    )  # fmt: skip
    with threadpool_limits(1):
        oracle.fit(rows, of_rows, sample_weight=weights)
    columns = np.tile(found.features.ravel(), 3)
    edges = np.concatenate([
        np.nextafter(found.thresholds, np.float32(side) * np.inf).ravel() if side else found.thresholds.ravel()
        for side in (-1, 0, 1)
    ])  # fmt: skip
    columns, edges = columns[np.isfinite(edges)], edges[np.isfinite(edges)]
    assert len(edges) > 300
    on_edges = rows[np.arange(len(edges)) % len(rows)].copy()
    on_edges[np.arange(len(edges)), columns] = edges
    for tried in (rows, on_edges):
        expected = oracle.decision_function(tried).reshape(len(tried), -1)
        np.testing.assert_allclose(found.scores(tried), expected, atol=1e-5)


def by_hand(of: BoostedTrees, row: NDArray[np.float32]) -> NDArray[np.float64]:
    scores = of.baseline.astype(np.float64)
    for number, (columns, thresholds, leaves) in enumerate(
        zip(of.features, of.thresholds, of.leaves, strict=True)
    ):
        node = 0
        while node < INNER:
            node = 2 * node + (1 if row[columns[node]] <= thresholds[node] else 2)
        scores[number % len(scores)] += leaves[node - INNER]
    return scores


@given(st.integers(0, 2**32 - 1), st.integers(2, 6), st.integers(0, 600))
def test_every_row_goes_left_up_to_a_threshold_whatever_the_number_of_rows(
    seed: int, classes: int, count: int
) -> None:
    rng = np.random.default_rng(seed)
    of = random_trees(rng, tuple(range(classes)), rounds=2, features=4)
    rows = np.rint(rng.normal(0, 2, (count, 4))).astype(np.float32)
    of.thresholds[rng.random(of.thresholds.shape) < 0.3] = 1.0  # rows lie on it
    found = of.scores(rows)
    assert found.shape == (count, 1 if classes == 2 else classes)
    for i in rng.choice(count, min(count, 5), replace=False):
        np.testing.assert_allclose(found[i], by_hand(of, rows[i]), atol=1e-5)


def changed(array: NDArray[Any], place: int, value: float) -> NDArray[Any]:
    found = array.copy()
    found.flat[place] = value
    return found


DAMAGE = {
    "double classes": ("classes", lambda a: a.astype(np.float64)),
    "classes in rows": ("classes", lambda a: a[:, None]),
    "a class that is none": ("classes", lambda a: changed(a, -1, 6)),
    "a negative class": ("classes", lambda a: changed(a, 0, -1)),
    "a class twice": ("classes", lambda a: changed(a, 1, a[0])),
    "classes in another order": ("classes", lambda a: a[::-1]),
    "classes whose differences overflow": ("classes", lambda a: np.array([100, -100], np.int8)),
    "one class": ("classes", lambda a: a[:1]),
    "no class": ("classes", lambda a: a[:0]),
    "a single leaf": ("leaves", lambda a: a[0, 0, None][0]),
    "a double baseline": ("baseline", lambda a: a.astype(np.float64)),
    "one score too many": ("baseline", lambda a: np.append(a, np.float32(0))),
    "a score of its own": ("baseline", lambda a: a[0]),
    "an infinite baseline": ("baseline", lambda a: changed(a, 0, np.inf)),
    "wide features": ("features", lambda a: a.astype(np.int64)),
    "a feature that is none": ("features", lambda a: changed(a, -1, 60)),
    "a negative feature": ("features", lambda a: changed(a, 7, -1)),
    "a tree without features": ("features", lambda a: a[:-1]),
    "fewer nodes": ("features", lambda a: a[:, :-1]),
    "whole thresholds": ("thresholds", lambda a: np.zeros(a.shape, np.int32)),
    "thresholds of the other end": ("thresholds", lambda a: a.astype(">f4")),
    "a threshold that is no number": ("thresholds", lambda a: changed(a, 3, np.nan)),
    "flat thresholds": ("thresholds", lambda a: a.ravel()),
    "half leaves": ("leaves", lambda a: a.astype(np.float16)),
    "an infinite leaf": ("leaves", lambda a: changed(a, 5, -np.inf)),
    "a leaf that is no number": ("leaves", lambda a: changed(a, 5, np.nan)),
    "a leaf that no tree has": ("leaves", lambda a: changed(a, 5, 3e38)),
    "a leaf too few": ("leaves", lambda a: a[:, :-1]),
}


@pytest.mark.parametrize("damage", DAMAGE)
@pytest.mark.parametrize("classes", [(0, 5), (1, 2, 5)])
def test_damaged_trees_are_refused(damage: str, classes: tuple[int, ...]) -> None:
    whole = random_trees(np.random.default_rng(0), classes, features=60)
    whole.check(60, 6)
    name, damaged = DAMAGE[damage]
    with pytest.raises(DataError, match=r"^its .*"):
        replace(whole, **{name: damaged(getattr(whole, name))}).check(60, 6)


def test_trees_of_an_unfinished_round_none_and_too_many_are_refused() -> None:
    whole = random_trees(np.random.default_rng(0), (0, 1, 2), features=60)

    def first(count: int) -> BoostedTrees:
        of_trees = ("features", "thresholds", "leaves")
        return replace(
            whole, **{f.name: np.resize(getattr(whole, f.name), (count, *getattr(whole, f.name).shape[1:]))
                      for f in fields(whole) if f.name in of_trees},
        )  # fmt: skip

    first(6).check(60, 6)
    for count in (0, 5, 3 * trees.MOST_TREES):
        with pytest.raises(DataError, match="no trees of one depth"):
            first(count).check(60, 6)
