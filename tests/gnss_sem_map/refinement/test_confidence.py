"""Confidence, entropy, and labels for voxels that no camera saw."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.refinement.by_block import refine
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


def test_unseen_voxels_know_nothing_unless_asked_to_infer():
    voxels = random_map(3)
    refined, report = refine(voxels)
    unseen = ~voxels.observed
    assert unseen.sum() > 100
    assert (refined.labels[unseen] == -1).all()
    np.testing.assert_allclose(refined.entropy[unseen], np.log(5), rtol=1e-6)
    assert {step.name: step.skipped for step in report.steps}["unobserved"] == "switched off"


def test_inferred_voxels_are_marked_and_leave_observed_ones_as_they_were():
    voxels = random_map(4)
    plain, _ = refine(voxels)
    refined, report = refine(voxels, RefinementSettings(unobserved={"enabled": True}))
    seen, inferred = voxels.observed, refined.states == State.INFERRED
    np.testing.assert_array_equal(refined.labels[seen], plain.labels[seen])
    np.testing.assert_array_equal(refined.confidence[seen], plain.confidence[seen])
    assert inferred.sum() > 100
    assert (refined.labels[inferred] >= 0).all()
    assert not (inferred & seen).any()
    assert {step.name: step.changed for step in report.steps}["unobserved"] == inferred.sum()


@pytest.mark.parametrize("iterations", [1, 3])
def test_labels_spread_one_voxel_per_pass_and_no_farther(iterations):
    """A row of twelve voxels of which a camera saw only the first."""
    keys = pack(np.array([(x, 0, 0) for x in range(12)] + [(40, 0, 0)]))
    evidence = np.zeros((13, 5), np.int32)
    evidence[0] = -4096
    evidence[0, BUILDING] = -1
    voxels = VoxelMap(0.2, URBAN, keys, evidence, np.ones(13, np.uint32))
    asked = RefinementSettings(
        unobserved={"enabled": True, "iterations": iterations},
        geometric_prior={"enabled": False},
        vehicles={"enabled": False},
    )
    refined, _ = refine(voxels, asked)
    expected = [BUILDING] * (1 + iterations) + [-1] * (12 - iterations)
    assert refined.labels.tolist() == expected
    assert (np.diff(refined.confidence[: 1 + iterations]) < 0).all(), "farther is less sure"
    assert (refined.confidence[1 + iterations :] == 0).all()
