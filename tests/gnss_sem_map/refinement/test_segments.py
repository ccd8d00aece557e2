"""Segments of a scan: what belongs together, what is too large, and what evidence takes apart."""

import numpy as np
import pytest

from gnss_sem_map.refinement.segments import find_segments, take_apart


def side(x, y, length, height=1.5, step=0.1):
    """Points on the side of a vehicle that stands along x."""
    xs, zs = np.meshgrid(np.arange(x, x + length, step), np.arange(0.3, height, step))
    return np.column_stack([xs.ravel(), np.full(xs.size, y), zs.ravel()])


@pytest.mark.parametrize(("length", "count"), [(4.5, 1), (11.0, 1), (30.0, 0)])
def test_where_no_image_looks_a_lorry_is_an_object_and_a_wall_is_not(length, count):
    p_map = side(0.0, 5.0, length, height=3.0)
    nothing = np.zeros(len(p_map), bool)
    segments, cut = find_segments(p_map, nothing, nothing, 0.7)
    assert len(cut) == count
    assert (segments == count - 1).all()


def test_a_mover_that_passes_a_parked_car_closely_is_taken_off_it():
    parked, mover = side(0.0, 5.0, 4.5), side(2.0, 4.5, 4.5)
    p_map = np.concatenate([parked, mover])
    is_mover = np.arange(len(p_map)) >= len(parked)
    segments, _ = find_segments(p_map, np.ones(len(p_map), bool), np.ones(len(p_map), bool), 0.7)
    assert (segments == 0).all()
    apart = take_apart(p_map, segments, np.full(len(p_map), 20), np.where(is_mover, 30, 0), 0.7, 0.25)
    np.testing.assert_array_equal(apart, is_mover)


def test_one_object_stays_whole_whatever_is_said_of_its_parts():
    """Half of a car seen through, as by poor poses, is still connected to the other half; a few points say nothing."""
    car, far = side(0.0, 5.0, 4.5), side(0.0, 5.0, 4.5, step=0.3)
    for p_map in (car, far):
        throughs = np.where(p_map[:, 0] > 2.2, 30, 0)
        zeros = np.zeros(len(p_map), np.int32)
        np.testing.assert_array_equal(
            take_apart(p_map, zeros, np.full(len(p_map), 20), throughs, 0.7, 0.25), 0
        )
