"""DBSCAN on voxels against scikit-learn, number by number."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.cluster import DBSCAN

from gnss_sem_map.errors import ConfigError, DataError
from gnss_sem_map.voxels.dbscan import TIE, dbscan


def reference(indices, eps_voxels, min_samples):
    return DBSCAN(eps=eps_voxels + TIE, min_samples=min_samples).fit(indices).labels_


@settings(max_examples=150, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(1, 700),
    half_widths=st.tuples(st.integers(1, 25), st.integers(1, 25), st.integers(1, 90)),
    eps_voxels=st.sampled_from([0.5, 1.0, 1.5, 2.0, 2.5, 0.6 / 0.2, 3.3, 5.0, 9.7, 16.9, 17.5]),
    min_samples=st.integers(1, 14),
)
def test_every_cluster_number_is_that_of_scikit_learn(seed, count, half_widths, eps_voxels, min_samples):
    rng = np.random.default_rng(seed)
    spread = np.array(half_widths)
    ordered = np.unique(rng.integers(-spread, spread + 1, (count, 3)), axis=0)
    for indices in (ordered, rng.permutation(ordered)):
        expected = reference(indices, eps_voxels, min_samples)
        np.testing.assert_array_equal(dbscan(indices, eps_voxels, min_samples), expected)


def test_border_voxels_between_two_clusters_go_to_the_one_that_the_input_names_first():
    left, right, between = [(x, 0, 0) for x in range(-6, 0)], [(x, 0, 0) for x in range(3, 9)], [(1, 0, 0)]
    for order in (left + right + between, right + between + left, between + right + left):
        indices = np.array(order)
        clusters = dbscan(indices, 2.0, 4)
        np.testing.assert_array_equal(clusters, reference(indices, 2.0, 4))
        border = int(np.flatnonzero((indices == between[0]).all(axis=1))[0])
        assert clusters[border] == 0
        assert clusters.max() == 1


def test_voxels_at_exactly_the_radius_are_neighbours_although_the_quotient_is_rounded():
    assert 0.6 / 0.2 < 3
    assert dbscan(np.array([(0, 0, 0), (0, 0, 3)]), 0.6 / 0.2, 2).tolist() == [0, 0]


def test_clusters_reach_across_the_whole_range_of_the_map():
    edge = 2**20 - 1
    indices = np.array([(-edge - 1, edge, edge), (-edge - 1, edge, edge - 1), (edge, -edge - 1, -edge - 1)])
    assert dbscan(indices, 1.0, 2).tolist() == [0, 0, -1]


def test_one_cluster_of_tall_columns_is_found_at_any_height():
    indices = np.array([(0, 0, z) for z in range(-70, 70)])
    for height in (-(2**19), 0, 31, 2**19):
        assert not dbscan(indices + np.array([0, 0, height]), 2.5, 4).any()


def test_no_voxels_have_no_clusters():
    assert dbscan(np.empty((0, 3), np.int32), 2.5, 3).shape == (0,)


def test_what_is_no_set_of_voxels_is_refused():
    with pytest.raises(DataError, match="twice"):
        dbscan(np.array([(1, 2, 3), (0, 0, 0), (1, 2, 3)]), 2.5, 3)
    with pytest.raises(DataError, match="indices"):
        dbscan(np.array([(2**20, 0, 0)]), 2.5, 3)
    with pytest.raises(ConfigError, match="eps"):
        dbscan(np.array([(0, 0, 0)]), 0.0, 3)
    with pytest.raises(ConfigError, match="samples"):
        dbscan(np.array([(0, 0, 0)]), 1.0, 0)


@pytest.mark.slow
def test_a_hundred_thousand_voxels_of_walls_are_clustered_like_scikit_learn():
    rng = np.random.default_rng(0)
    indices = np.unique(rng.integers((0, 0, 0), (300, 300, 12), (140_000, 3)), axis=0)
    indices = indices[(indices[:, 0] // 40 + indices[:, 1] // 40) % 2 == 0]
    np.testing.assert_array_equal(dbscan(indices, 2.5, 10), reference(indices, 2.5, 10))
