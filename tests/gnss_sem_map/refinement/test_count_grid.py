"""Count grids against a loop over columns, and what they must and must not overwrite."""

from math import comb, log

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import beta

from gnss_sem_map.refinement import count_grid as grids
from gnss_sem_map.refinement.count_grid import (
    CountGridSettings,
    count_grid,
    evidence_log_odds,
    paper_log_odds,
)
from gnss_sem_map.refinement.figures import column_error_rate
from gnss_sem_map.voxels.voxel_map import pack

BUILDING, VEGETATION = 3, 4


def voxels(rng, count, spread):
    keys = np.unique(pack(rng.integers(-spread, spread, (count, 3))))
    return keys, rng.integers(-1, 5, len(keys)).astype(np.int8)


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1), cell=st.integers(1, 7), layer=st.integers(1, 9), reach=st.integers(0, 3)
)
def test_counts_are_those_of_a_loop_over_all_pairs(seed, cell, layer, reach):
    rng = np.random.default_rng(seed)
    keys, labels = voxels(rng, 120, 12)
    counts = count_grid(keys, labels, (BUILDING, VEGETATION), cell, layer, reach)
    from gnss_sem_map.voxels.voxel_map import AXIS_OFFSET, unpack

    indices = unpack(keys) + AXIS_OFFSET
    columns, layers = indices[:, :2] // cell, indices[:, 2] // layer
    same = (columns[:, None] == columns[None]).all(2) & (abs(layers[:, None] - layers[None]) <= reach)
    for k, c in enumerate((BUILDING, VEGETATION)):
        np.testing.assert_array_equal(counts[:, k], (same & (labels == c)[None]).sum(1))


def test_the_count_grid_of_one_voxel_columns_is_a_bincount():
    rng = np.random.default_rng(1)
    keys, labels = voxels(rng, 3000, 10)
    column = np.unique(keys >> 21, return_inverse=True)[1]
    counts = count_grid(keys, labels, (BUILDING, VEGETATION), 1)
    for k, c in enumerate((BUILDING, VEGETATION)):
        np.testing.assert_array_equal(counts[:, k], np.bincount(column, labels == c)[column])


def test_the_last_voxels_that_have_keys_are_counted():
    """The first key past their cells would not fit into 64 bits."""
    end = 2**20 - 1
    keys = np.sort(pack(np.array([[end, end, end], [end, end, end - 11], [end - 8, end, end]])))
    counts = count_grid(keys, np.full(3, BUILDING, np.int8), (BUILDING, VEGETATION), 5, 5, 1)
    assert counts.tolist() == [[1, 0]] * 3


def test_any_number_of_threads_counts_the_same(monkeypatch):
    keys, labels = voxels(np.random.default_rng(2), 5000, 30)
    expected = count_grid(keys, labels, (BUILDING, VEGETATION), 5, 5, 1)
    monkeypatch.setattr(grids, "LEAST_AT_ONCE", 1)
    for threads in (1, 3, 50):
        monkeypatch.setattr(grids, "THREADS", threads)
        np.testing.assert_array_equal(count_grid(keys, labels, (BUILDING, VEGETATION), 5, 5, 1), expected)


def test_the_papers_rule_is_bayes_with_a_binomial_likelihood():
    indices = np.array([(0, 0, z) for z in range(5)] + [(9, 9, z) for z in range(4)])
    labels = np.array([3, 3, 3, 4, 3, 4, 4, 4, 3], np.int8)
    settings = CountGridSettings(error_rate=0.1)
    prior = log(6 / 5)  # 5 and 4 voxels, one pseudo-count each
    odds = paper_log_odds(pack(indices), labels, (BUILDING, VEGETATION), settings, prior)

    def likelihood(right, wrong):
        return comb(right + wrong, right) * 0.9**right * 0.1**wrong

    np.testing.assert_allclose(odds[:5], prior + log(likelihood(4, 1) / likelihood(1, 4)))
    np.testing.assert_allclose(odds[5:], prior + log(likelihood(1, 3) / likelihood(3, 1)))


def test_the_columns_likelihood_is_beta_binomial_in_the_other_voxels():
    indices = np.array([(0, 0, z) for z in range(5)])
    labels = np.array([3, 3, 3, 4, 3], np.int8)
    odds = evidence_log_odds(pack(indices), labels, np.zeros(5, np.float32), (3, 4), (5, 5, 4), 0.5 / 3)

    def likelihood(building, vegetation, a, b):
        return beta(building + a, vegetation + b) / beta(a, b)

    for i, (building, vegetation) in {0: (3, 1), 3: (4, 0)}.items():
        expected = log(
            likelihood(building, vegetation, 2.5, 0.5) / likelihood(building, vegetation, 0.5, 2.5)
        )
        assert odds[i] == pytest.approx(expected)


def test_a_thousand_agreeing_voxels_are_not_a_thousand_witnesses():
    """Ten times the voxels add a constant (ln 10 times a - b), not ten times the certainty."""
    odds = []
    for count in (10, 100, 1000):
        indices = np.array([(0, 0, z) for z in range(count)])
        labels = np.full(count, BUILDING, np.int8)
        own = np.zeros(count, np.float32)
        odds.append(evidence_log_odds(pack(indices), labels, own, (3, 4), (5, 5, 10**6), 0.05)[0])
    assert odds[2] - odds[1] == pytest.approx(odds[1] - odds[0], rel=0.05)


@pytest.mark.parametrize(("a", "b"), [(2.4, 0.6), (2.1, 0.9)])
def test_the_error_rate_is_found_in_the_map_itself(a, b):
    rng = np.random.default_rng(5)
    share = rng.beta(a, b, 20_000)
    building = rng.random(20_000) < 0.5
    right = rng.binomial(20, share)
    first = np.where(building, right, 20 - right)
    counts = np.repeat(np.stack([first, 20 - first], 1), 20, axis=0).astype(np.int32)
    assert 3.0 * column_error_rate(grids.pairs(counts)) == pytest.approx(b, abs=0.06)


def test_a_tree_before_a_facade_keeps_its_crown_and_the_facade_its_wall():
    """Vegetation at 0 to 3 m and building from 6 to 14 m in one column: neither rules the other."""
    indices = np.array([(x, y, z) for x in range(5) for y in range(5) for z in [*range(15), *range(30, 70)]])
    labels = np.where(indices[:, 2] < 20, VEGETATION, BUILDING).astype(np.int8)
    order = np.argsort(pack(indices))
    keys, labels = pack(indices)[order], labels[order]
    own = np.where(labels == BUILDING, 0.5, -0.5).astype(np.float32)
    odds = evidence_log_odds(keys, labels, own, (BUILDING, VEGETATION), (5, 5, 2), 0.05)
    assert ((odds > 0) == (labels == BUILDING)).all()


def test_only_the_two_classes_change_and_the_better_one_keeps_its_score():
    scores = np.array([[0, -1, -2, -3, -4], [-9, -9, -9, -1, -2], [-9, -9, -9, -2, -1]], np.float32)
    refined = grids.decide(
        scores, np.array([False, True, True]), (BUILDING, VEGETATION), np.array([5.0, -3.0, -3.0])
    )
    np.testing.assert_array_equal(refined[0], scores[0])
    np.testing.assert_array_equal(refined[1], [-9, -9, -9, -4, -1])
    np.testing.assert_array_equal(refined[2], [-9, -9, -9, -4, -1])
