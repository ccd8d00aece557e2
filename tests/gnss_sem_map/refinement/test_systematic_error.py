"""Errors that all views share, counted without a truth."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.refinement.by_block import refine
from gnss_sem_map.refinement.figures import MOST_SYSTEMATIC, systematic_errors
from gnss_sem_map.refinement.steps import RefinementSettings
from gnss_sem_map.refinement.systematic_error import counted, doubted
from gnss_sem_map.voxels.voxel_map import VoxelMap, pack

URBAN = open_label_set("urban")
ROAD, BUILDING = URBAN.index("road"), URBAN.index("building")


@settings(max_examples=30, deadline=None)
@given(
    share=st.floats(0.02, 0.4),
    first=st.floats(0.1, 0.9),
    second=st.floats(0.1, 0.9),
    seed=st.integers(0, 2**32 - 1),
)
def test_two_witnesses_that_each_find_some_errors_tell_how_many_there_are(share, first, second, seed):
    rng = np.random.default_rng(seed)
    n, looks = 50_000, rng.integers(1, 50, 50_000).astype(np.float32)
    wrong = rng.random(n) < share
    found = [wrong & (rng.random(n) < chance) for chance in (first, second)]
    estimate = systematic_errors(counted(found[0], found[1], looks))
    drawn = looks[wrong].sum() / looks.sum()  # what there is to find: itself a draw around `share`
    # variance of Lincoln and Petersen's estimate, for voxels that weigh alike; looks that differ add a third
    spread = np.sqrt((1 - first) * (1 - second) / (n * share * first * second)) * np.sqrt(1.4)
    # its inverse is linear in what both found, which is drawn; itself it is far off where that is ten voxels
    assert abs(drawn / estimate - 1) < 5 * spread + 0.01
    assert systematic_errors(counted(found[0], found[1], 7 * looks)) == pytest.approx(estimate, rel=1e-4)


def test_a_place_counts_as_often_as_it_is_looked_at():
    wrong = np.arange(1000) < 100
    assert systematic_errors(counted(wrong, wrong, np.ones(1000))) == pytest.approx(0.1)
    assert systematic_errors(counted(wrong, wrong, np.where(wrong, 9.0, 1.0))) == pytest.approx(0.5)
    assert systematic_errors(counted(wrong, wrong, np.where(wrong, 1.0, 9.0))) == pytest.approx(100 / 8200)


def test_a_witness_alone_is_believed_no_witness_finds_nothing_and_no_estimate_passes_the_half():
    none, some = np.zeros(1000, np.bool_), np.arange(1000) < 30
    assert systematic_errors(counted(none, some, np.ones(1000))) == pytest.approx(0.03)
    assert systematic_errors(counted(none, none, np.ones(1000))) == 0
    assert systematic_errors(counted(none[:0], none[:0], np.ones(0))) == 0
    assert systematic_errors(counted(some, some[::-1], np.ones(1000))) == MOST_SYSTEMATIC


def test_doubt_keeps_the_order_of_classes_and_full_doubt_knows_nothing():
    probabilities = np.random.default_rng(0).dirichlet(np.ones(5), 100).astype(np.float32)
    shared = doubted(probabilities, 0.3)
    np.testing.assert_allclose(shared.sum(axis=1), 1, rtol=1e-6)
    np.testing.assert_array_equal(shared.argsort(axis=1), probabilities.argsort(axis=1))
    np.testing.assert_array_equal(doubted(probabilities, 0.0), probabilities)
    np.testing.assert_allclose(doubted(probabilities, 1.0), 0.2, rtol=1e-6)


def test_a_map_finds_its_systematic_errors_and_is_never_surer_than_they_allow():
    """A road on which one place in twelve is called building, in every view: neighbours and the ground see it."""
    rng = np.random.default_rng(1)
    keys = np.sort(pack(np.stack(np.meshgrid(range(60), range(60), [0], indexing="ij"), -1).reshape(-1, 3)))
    called = np.where(rng.random(len(keys)) < 1 / 12, BUILDING, ROAD)
    evidence = np.full((len(keys), 5), -2300, np.int32)
    evidence[np.arange(len(keys)), called] = -600
    voxels = VoxelMap(0.2, URBAN, keys, evidence, np.ones(len(keys), np.uint32))
    refined, report = refine(voxels)
    share = report.systematic_errors
    assert share == pytest.approx((called == BUILDING).mean(), rel=0.2)
    certain, report = refine(voxels, RefinementSettings(systematic_error={"rate": 0.0}))
    assert report.systematic_errors == 0
    np.testing.assert_array_equal(refined.labels, certain.labels)
    np.testing.assert_allclose(refined.confidence, (1 - share) * certain.confidence + share / 5, rtol=1e-5)
