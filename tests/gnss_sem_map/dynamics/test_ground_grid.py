"""Heights and neighbourhoods of a scan, beside what comparing every pair of points says."""

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from gnss_sem_map.dynamics.ground_grid import GROUND_CELL_M, closer_than, height_over_ground, in_cells_near


@pytest.fixture
def p_map():
    return np.random.default_rng(0).normal(size=(600, 3)) * [9, 5, 2] + [3, -800, 40]


def neighbours(p_map, size_m):
    """Which pairs of points (n, n) are in the same cell or in cells that touch."""
    cells = np.floor(p_map[:, :2] / size_m)
    return (abs(cells[:, None] - cells[None]) <= 1).all(axis=2)


def test_heights_are_over_the_lowest_point_of_nine_cells(p_map):
    lowest = np.where(neighbours(p_map, GROUND_CELL_M), p_map[:, 2], np.inf).min(axis=1)
    np.testing.assert_array_equal(height_over_ground(p_map), p_map[:, 2] - lowest)
    assert height_over_ground(p_map[:0]).shape == (0,)


@pytest.mark.parametrize("reach_m", [0.3, 1.0, 4.0])
def test_near_is_in_a_marked_cell_or_beside_one(p_map, reach_m):
    marked = np.arange(len(p_map)) % 37 == 0
    expected = (neighbours(p_map, reach_m) & marked).any(axis=1)
    assert marked.sum() < expected.sum() < len(p_map)
    np.testing.assert_array_equal(in_cells_near(p_map, marked, reach_m), expected)


@pytest.mark.parametrize("axes", [2, 3])
@pytest.mark.parametrize("reach_m", [0.3, 1.0, 4.0])
def test_reached_are_those_asked_for_that_are_nearer_than_the_reach_to_a_marked_point(p_map, reach_m, axes):
    points, marked = p_map[:, :axes].astype(np.float32), np.arange(len(p_map)) % 37 == 0
    asked = np.arange(len(p_map)) % 3 > 0
    expected = asked & (cdist(points, points[marked]) < reach_m).any(axis=1)
    assert 0 < (expected & ~marked).sum() < asked.sum()
    np.testing.assert_array_equal(closer_than(points, marked, asked, reach_m), expected)


def test_no_reach_and_no_mark_find_no_more(p_map):
    marked = np.arange(len(p_map)) == 3
    np.testing.assert_array_equal(in_cells_near(p_map, marked, 0.0), marked)
    assert not in_cells_near(p_map, np.zeros(len(p_map), bool), 1.0).any()
    assert not closer_than(p_map, marked, marked, 0.0).any()
