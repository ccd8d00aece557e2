"""Training rows are the same however a map is cut; what is learned is as sure as the labels are right."""

from __future__ import annotations

from dataclasses import replace
from functools import cache, reduce

import numpy as np
import pytest
from classifiers import SIZE_M, URBAN
from numpy.typing import NDArray

from gnss_sem_map.geometric_classifier import features, training
from gnss_sem_map.geometric_classifier.classifier import Classifier, folds_of
from gnss_sem_map.geometric_classifier.training import FEWEST_OF_CLASS, Rows, fit, rows_of
from gnss_sem_map.refinement import geometric_prior, height_above_ground, potts_mrf
from gnss_sem_map.refinement.state import Evidence, MapState
from gnss_sem_map.refinement.steps import STEPS, RefinementSettings, do
from gnss_sem_map.voxels.voxel_map import VoxelMap, pack, softmax

ROAD, SIDEWALK, VEHICLE, BUILDING, VEGETATION, OTHER = range(6)
SETTINGS = RefinementSettings()
MOST = 1500


@cache
def street() -> tuple[VoxelMap, NDArray[np.uint8], NDArray[np.int64]]:
    """A road of 80 m, walls and hedges beside it, a lawn behind; intensities; what each voxel truly is.

    Images show two of three voxels, and err about one of ten; they call half of the lawn `other`.
    """
    rng = np.random.default_rng(0)
    x, y = np.meshgrid(np.arange(-200, 200), np.arange(-40, 41), indexing="ij")
    z = np.where(abs(y) < 15, 0, 1) + (rng.random(x.shape) < 0.3) * (y > 25)
    ground = np.column_stack([x.ravel(), y.ravel(), z.ravel()])
    wall = np.array([(x, 22, z) for x in range(-200, 200) for z in range(2, 20)])
    hedge = np.unique(rng.integers((-200, -30, 2), (200, -22, 12), (12_000, 3)), axis=0)
    indices = np.concatenate([ground, wall, hedge])
    true = np.select(
        [np.arange(len(indices)) >= len(ground) + len(wall), np.arange(len(indices)) >= len(ground)],
        [VEGETATION, BUILDING], np.select([abs(indices[:, 1]) < 15, indices[:, 1] > 25], [ROAD, OTHER], SIDEWALK),
    )  # fmt: skip
    keys, order = np.unique(pack(indices), return_index=True)
    true = true[order]
    called = np.where(rng.random(len(keys)) < 0.1, rng.integers(0, 5, len(keys)), true % 5)
    evidence = np.full((len(keys), 5), -4000, np.int32)
    evidence[np.arange(len(keys)), called] = -200
    evidence[rng.random(len(keys)) < 1 / 3] = 0
    seen = (evidence != 0).any(axis=1)
    mass = np.where(
        seen & (true == OTHER) & (rng.random(len(keys)) < 0.5), rng.integers(0, 256, len(keys)), 0
    )
    hits = np.ones(len(keys), np.uint32)
    of_images = np.column_stack([seen, mass]).astype(np.int32)
    voxels = VoxelMap(SIZE_M, URBAN, keys, evidence, hits, np.full(len(keys), 128, np.int64), of_images)
    return voxels, (40 * true + rng.integers(0, 20, len(keys))).astype(np.uint8), true


@cache
def rows() -> Rows:
    voxels, intensity, _ = street()
    return rows_of(voxels, intensity, np.arange(len(voxels)), Evidence(), SETTINGS, MOST)


def assert_same(a: Rows, b: Rows) -> None:
    for name in ("order", "folds", "classes", "weights", "features"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)


@pytest.mark.parametrize("order", [(0, 1, 2, 3), (3, 1, 0, 2)])
def test_rows_depend_neither_on_how_a_map_is_cut_nor_on_the_order_of_the_parts(
    order: tuple[int, ...],
) -> None:
    voxels, intensity, _ = street()
    x = voxels.centres[:, 0]
    margin = max(
        features.reach_m(SIZE_M),
        height_above_ground.REACH_M
        + geometric_prior.reach_m(SETTINGS.geometric_prior, SIZE_M)
        + potts_mrf.reach_m(SETTINGS.potts_mrf, SIZE_M),
    )
    edges = [-40.0, -23.3, -5.0, 14.1, 40.0]
    parts = []
    for k in order:
        near = np.flatnonzero((x > edges[k] - margin) & (x < edges[k + 1] + margin))
        places = np.flatnonzero((x[near] > edges[k]) & (x[near] <= edges[k + 1]))
        parts.append(rows_of(voxels[near], intensity[near], places, Evidence(), SETTINGS, MOST))
    assert_same(reduce(lambda a, b: (a + b).first(MOST), parts), rows())


def test_each_fold_has_so_many_rows_of_its_own_blocks_that_look_like_chance() -> None:
    voxels, _, _ = street()
    whole = rows()
    assert np.bincount(whole.folds).tolist() == [MOST, MOST]
    hashes = training._hashes(voxels.keys)
    places = np.argsort(hashes)[np.searchsorted(np.sort(hashes), whole.order)]
    np.testing.assert_array_equal(folds_of(voxels.keys[places], SIZE_M), whole.folds)
    x = voxels.centres[places, 0]
    assert np.histogram(x, 8, (-40, 40))[0].min() > 0.7 * len(x) / 8


def test_a_row_weighs_as_much_as_its_label_is_sure_and_other_as_images_say() -> None:
    voxels, intensity, _ = street()
    everything = rows_of(voxels, intensity, np.arange(len(voxels)), Evidence(), SETTINGS, len(voxels))
    state = MapState.of(voxels, Evidence())
    for step in STEPS:
        if step.name in ("discount", "geometric_prior", "potts_mrf"):
            state, _ = do(step, state, SETTINGS)
    sure, other = softmax(state.scores).max(axis=1) * (1 - voxels.other_share), voxels.other_share
    label = np.where(voxels.observed, state.labels, -1)
    expected = {(int(h), int(c)): w for h, c, w, s in zip(
        np.tile(training._hashes(voxels.keys), 2), np.concatenate([label, np.full(len(voxels), OTHER)]),
        np.concatenate([sure, other]), np.tile(voxels.observed, 2), strict=True) if s and w >= 0.1}  # fmt: skip
    found = zip(everything.order.tolist(), everything.classes.tolist(), strict=True)
    assert dict(zip(found, everything.weights.tolist(), strict=True)) == pytest.approx(expected, abs=1e-6)
    assert 0 < np.count_nonzero(everything.classes == OTHER) < 0.2 * len(everything)


def test_voxels_that_images_ignore_as_other_are_rows_of_other() -> None:
    """With a model that abstains, such voxels have no evidence for any class."""
    voxels, intensity, true = street()
    assert voxels.of_images is not None
    lawn = true == OTHER
    evidence = np.where(lawn[:, None], 0, voxels.evidence)
    of_images = np.where(lawn[:, None], np.array([1, 255]), voxels.of_images)
    abstained = replace(voxels, evidence=evidence.astype(np.int32), of_images=of_images.astype(np.int32))
    found = rows_of(abstained, intensity, np.flatnonzero(lawn), Evidence(), SETTINGS, len(voxels))
    assert len(found) == lawn.sum()
    assert (found.classes == OTHER).all()
    assert (found.weights == 1).all()


def fitted(of: Rows) -> Classifier:
    found = fit([of], URBAN, SIZE_M, True)
    assert isinstance(found, Classifier)
    return found


@cache
def learned() -> Classifier:
    return fitted(rows())


def answers(of: Classifier) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """ln P of the voxels that no image shows, and what they truly are."""
    voxels, intensity, true = street()
    unseen = np.flatnonzero(~voxels.observed)[::7]
    rows_of_unseen = features.features_of(voxels, intensity, unseen)
    return of.log_probabilities(rows_of_unseen, voxels.keys[unseen], np.zeros(len(unseen), np.bool_)), true[
        unseen
    ]


def test_what_no_image_shows_gets_the_class_it_has() -> None:
    logs, true = answers(learned())
    known = true != OTHER
    assert (logs.argmax(axis=1) == true)[known].mean() > 0.95


def test_a_model_knows_nothing_of_the_labels_of_the_other_colour() -> None:
    of, rng = rows(), np.random.default_rng(1)
    second = np.flatnonzero(of.folds == 1)
    classes, weights = of.classes.copy(), of.weights.copy()
    classes[second], weights[second] = rng.permutation(classes[second]), rng.uniform(0.1, 1, len(second))
    other = fitted(replace(of, classes=classes, weights=weights.astype(np.float32)))
    np.testing.assert_array_equal(other.folds[0].leaves, learned().folds[0].leaves)
    assert not np.array_equal(other.folds[1].leaves, learned().folds[1].leaves)


def test_labels_that_are_wrong_everywhere_leave_the_classifier_unsure() -> None:
    """Of labels that say nothing of what a voxel is, it learns how frequent each is, and no more."""
    of, rng = rows(), np.random.default_rng(2)
    shuffled = rng.permutation(len(of))
    wrong = fitted(replace(of, classes=of.classes[shuffled], weights=of.weights[shuffled]))
    prior = np.bincount(of.classes, of.weights, 6) / of.weights.sum()
    sure, unsure = (np.exp(answers(one)[0]) for one in (learned(), wrong))
    assert sure.max(axis=1).mean() > 0.9
    assert unsure.max(axis=1).mean() < prior.max() + 0.15
    assert np.abs(unsure - prior).sum(axis=1).mean() < 0.2 * np.abs(sure - prior).sum(axis=1).mean()
    assert wrong.temperature > 1.3 * learned().temperature


def test_the_temperature_is_that_at_which_labels_of_the_other_fold_are_most_probable() -> None:
    of, found = rows(), learned()

    def loss(temperature: float) -> float:
        total = 0.0
        for k, trees in enumerate(found.folds):
            held_out = of[np.flatnonzero(of.folds != k)]
            scores = np.full((len(held_out), 6), -np.inf)
            scores[:, trees.classes] = trees.scores(held_out.features)
            odds = np.exp((scores - scores.max(axis=1, keepdims=True)) / temperature)
            right = (odds / odds.sum(axis=1, keepdims=True))[np.arange(len(held_out)), held_out.classes]
            total -= (held_out.weights * np.log(np.maximum(right, 1e-4))).sum()
        return total

    assert all(
        loss(found.temperature) <= loss(factor * found.temperature) for factor in (0.8, 0.9, 1.1, 1.25)
    )


def test_scores_that_are_larger_are_divided_by_more_and_those_of_noise_by_most() -> None:
    of, right = rows(), learned().folds
    parts = [of[np.flatnonzero(of.folds == k)] for k in (0, 1)]
    larger = [replace(one, baseline=2 * one.baseline, leaves=2 * one.leaves) for one in right]
    assert training._temperature(larger, parts, 6) == pytest.approx(2 * learned().temperature, rel=0.06)
    rng = np.random.default_rng(3)
    noise = [replace(one, leaves=rng.permuted(100 * one.leaves, axis=0)) for one in right]
    assert training._temperature(noise, parts, 6) == training.TEMPERATURES.max()


@pytest.mark.parametrize(
    ("chosen", "why"),
    [
        (lambda of: of.order < 0, "images label nothing"),
        (lambda of: np.arange(len(of)) % 50 == 0, "images label 60 voxels, too few to learn from"),
        (lambda of: of.folds == 1, f"images label {MOST} voxels, too few to learn from"),
        (lambda of: of.classes == ROAD, "images know one class only, so there is nothing to learn"),
    ],
)  # fmt: skip
def test_too_few_rows_and_one_class_teach_nothing(chosen, why: str) -> None:
    of = rows()
    assert fit([of[np.flatnonzero(chosen(of))]], URBAN, SIZE_M, False) == why


def test_a_class_of_few_rows_is_not_learned() -> None:
    of = rows()
    few = np.flatnonzero(of.classes == BUILDING)
    first = few[of.folds[few] == 0]
    assert len(first) > FEWEST_OF_CLASS
    found = fitted(of[np.setdiff1d(np.arange(len(of)), first[FEWEST_OF_CLASS - 1 :])])
    assert BUILDING not in found.folds[0].classes
    assert BUILDING in found.folds[1].classes
    assert np.isfinite(answers(found)[0]).all()


def test_the_same_rows_give_the_same_bytes_also_as_those_of_several_drives() -> None:
    of = rows()
    half = len(of) // 2
    again = fit([of[np.arange(half)], of[np.arange(half, len(of))]], URBAN, SIZE_M, True)
    assert isinstance(again, Classifier)
    assert again.to_bytes() == learned().to_bytes()
