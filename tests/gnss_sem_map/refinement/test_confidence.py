"""Confidence, entropy, and labels for voxels that no camera saw."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.refinement.by_block import refine
from gnss_sem_map.refinement.state import Evidence, GeometricEvidence
from gnss_sem_map.refinement.steps import RefinementSettings
from gnss_sem_map.voxels.semantic_map import State, entropy_of
from gnss_sem_map.voxels.voxel_map import VoxelMap, pack

URBAN = open_label_set("urban")
BUILDING = URBAN.index("building")


def random_map(seed, unseen=0.2):
    rng = np.random.default_rng(seed)
    keys = np.unique(pack(rng.integers(-9, 9, (1500, 3))))
    evidence = -rng.integers(1, 6000, (len(keys), 5)).astype(np.int32)
    evidence[rng.random(len(keys)) < unseen] = 0
    return VoxelMap(0.2, URBAN, keys, evidence, np.full(len(keys), 3, np.uint32))


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), cooler=st.floats(0.2, 5), warmer=st.floats(1.01, 4))
def test_the_temperature_changes_no_label_and_a_higher_one_makes_no_voxel_surer(seed, cooler, warmer):
    voxels = random_map(seed)
    a, _ = refine(voxels, RefinementSettings(decision={"temperature": cooler}))
    b, _ = refine(voxels, RefinementSettings(decision={"temperature": cooler * warmer}))
    np.testing.assert_array_equal(a.labels, b.labels)
    np.testing.assert_array_equal(a.states, b.states)
    assert (b.confidence <= a.confidence + 1e-6).all()
    assert (b.entropy >= a.entropy - 1e-5).all()


def test_entropy_is_zero_for_certainty_and_the_logarithm_of_the_class_count_for_ignorance():
    distributions = np.array([[1, 0, 0, 0, 0], [0.2] * 5, [0.5, 0.5, 0, 0, 0]], np.float32)
    np.testing.assert_allclose(entropy_of(distributions), [0, np.log(5), np.log(2)], atol=1e-6)


def test_unseen_voxels_know_nothing_without_a_geometric_classifier():
    voxels = random_map(3)
    refined, report = refine(voxels)
    unseen = ~voxels.observed
    assert unseen.sum() > 100
    assert (refined.labels[unseen] == -1).all()
    np.testing.assert_allclose(refined.entropy[unseen], np.log(5), rtol=1e-6)
    assert {step.name: step.skipped for step in report.steps}["geometric_labels"] == (
        "there is no geometric classifier"
    )


def test_what_no_camera_saw_is_what_shape_says_and_marked_as_inferred():
    """Of two voxels in three the classifier knows something; `other` is one of its answers."""
    voxels, rng = random_map(4, unseen=0.5), np.random.default_rng(4)
    keys = voxels.keys[rng.random(len(voxels)) < 0.67]
    of_classes = -rng.integers(1, 9000, (len(keys), 6), np.int32)
    no_kerbs = np.zeros(len(keys), np.int32)
    said = GeometricEvidence(keys, np.column_stack([of_classes, no_kerbs]), np.ones(len(keys), np.int32))
    alone = RefinementSettings(geometric_labels={"coupling_nat": 0}, systematic_error={"rate": 0})
    plain, _ = refine(voxels, alone)
    refined, report = refine(voxels, alone, Evidence(geometry=said))
    seen, known = voxels.observed, np.isin(voxels.keys, keys)
    inferred = refined.states == State.INFERRED
    np.testing.assert_array_equal(inferred, known & ~seen)
    np.testing.assert_array_equal(
        refined.labels[inferred], said.of(voxels.keys[inferred])[0].argmax(axis=1), "by shape alone"
    )
    assert set(refined.labels[inferred].tolist()) == set(range(6))
    assert ((refined.labels[seen] >= 0) & (refined.labels[seen] < 5)).all(), "images show a class"
    np.testing.assert_array_equal(refined.labels[~seen & ~known], -1)
    np.testing.assert_array_equal(refined.labels[seen & ~known], plain.labels[seen & ~known])
    np.testing.assert_allclose(refined.confidence[seen & ~known], plain.confidence[seen & ~known], rtol=1e-4)
    changed = {step.name: step.changed for step in report.steps}["geometric_labels"]
    assert changed == np.count_nonzero(refined.labels != plain.labels) > inferred.sum() > 100


def test_images_that_leave_a_class_no_probability_at_all_keep_their_label():
    """Without neighbours and doubt nothing limits their log-likelihoods: road and sidewalk are both impossible."""
    keys = pack(np.array([(x, 0, 0) for x in range(9)]))
    evidence = np.full((9, 5), -(2**20), np.int32)
    evidence[:, BUILDING] = -1
    voxels = VoxelMap(0.2, URBAN, keys, evidence, np.ones(9, np.uint32))
    said = GeometricEvidence(keys, np.full((9, 7), -1835, np.int32), np.ones(9, np.int32))
    off = {"enabled": False}
    alone = RefinementSettings(
        discount=off, geometric_prior=off, count_grid=off, potts_mrf=off, systematic_error={"rate": 0}
    )
    refined, _ = refine(voxels, alone, Evidence(geometry=said))
    assert (refined.labels == BUILDING).all()
    np.testing.assert_allclose(refined.confidence, 1, atol=1e-6)
