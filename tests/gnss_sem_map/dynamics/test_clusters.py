"""Segments of a scan: what belongs together, what is too large, and what evidence takes apart."""

import numpy as np
import pytest

from gnss_sem_map.dynamics.clusters import VOXEL_M, find_segments, split_segments


def side(x, y, length, height=1.5, step=0.1):
    """Points on the side of a vehicle that stands along x."""
    xs, zs = np.meshgrid(np.arange(x, x + length, step), np.arange(0.3, height, step))
    return np.column_stack([xs.ravel(), np.full(xs.size, y), zs.ravel()])


def segments_of(p_map, is_object, gap_m=0.0, beams=1.0):
    """Segments of a scan with the same gap between rings everywhere."""
    n = len(p_map)
    return find_segments(p_map, is_object, np.full(n, gap_m), np.full(n, beams), 0.7)


def test_one_ring_on_a_car_is_an_object_where_the_next_rings_lie_above_and_below_it():
    """The same ring is a kerb or a wire where rings are dense."""
    p_map = np.column_stack([np.arange(0, 1.8, 0.15), np.full(12, 8.0), np.full(12, 0.6)])
    nothing = np.zeros(len(p_map), bool)
    assert len(segments_of(p_map, nothing, gap_m=0.7, beams=4.8)[0].truncated) == 1
    assert len(segments_of(p_map, nothing, gap_m=0.7)[0].truncated) == 0
    assert len(segments_of(p_map, nothing, beams=4.8)[0].truncated) == 0


@pytest.mark.parametrize(("length", "count"), [(4.5, 1), (11.0, 1), (30.0, 0)])
def test_where_no_image_looks_a_lorry_is_an_object_and_a_wall_is_not(length, count):
    p_map = side(0.0, 5.0, length, height=3.0)
    nothing = np.zeros(len(p_map), bool)
    segments, voxel = segments_of(p_map, nothing)
    assert len(segments.truncated) == count
    assert (segments.of_points(voxel) == count - 1).all()


def test_what_is_asked_of_a_segment_is_what_its_points_say():
    p_map = np.concatenate([side(0.0, 5.0, 4.5), side(0.0, -5.0, 4.0), side(-30.0, 12.0, 60.0, height=9.0)])
    east = p_map[:, 0] > 2.0
    segments, voxel = segments_of(p_map, east & (p_map[:, 1] < 8))
    whole, of_points = segments.whole, segments.of_points(voxel)
    assert len(segments.truncated) == 2
    np.testing.assert_array_equal(of_points < 0, p_map[:, 1] > 8)
    for number in range(2):
        points = p_map[of_points == number]
        assert whole.points[number] == len(points)
        assert whole.labelled[number] == np.count_nonzero(points[:, 0] > 2.0)
        np.testing.assert_allclose(whole.sums[number], points.sum(axis=0))
        outline = segments.outline(number)
        np.testing.assert_allclose(outline.min(axis=0), points[:, :2].min(axis=0), atol=VOXEL_M)
        np.testing.assert_allclose(outline.max(axis=0), points[:, :2].max(axis=0), atol=VOXEL_M)


def test_of_a_wall_that_the_image_half_calls_a_vehicle_the_named_points_are_a_cut_segment():
    p_map = side(0.0, 5.0, 30.0)
    labelled = p_map[:, 0] < 4.05
    segments, voxel = segments_of(p_map, labelled)
    np.testing.assert_array_equal(segments.of_points(voxel), np.where(labelled, 0, -1))
    assert segments.truncated.tolist() == [True]


def test_a_mover_that_passes_a_parked_car_closely_is_taken_off_it():
    parked, mover = side(0.0, 5.0, 4.5), side(2.0, 4.5, 4.5)
    p_map = np.concatenate([parked, mover])
    is_mover = np.arange(len(p_map)) >= len(parked)
    segments, voxel = segments_of(p_map, np.ones(len(p_map), bool))
    assert (segments.of_points(voxel) == 0).all()
    of_mover = np.bincount(voxel, is_mover) > 0
    apart = split_segments(segments, np.full(len(of_mover), 20), np.where(of_mover, 30, 0), 0.7, 0.25)
    np.testing.assert_array_equal(apart.of_points(voxel), is_mover)


def test_one_object_stays_whole_whatever_is_said_of_its_parts():
    """Half of a car seen through, as by poor poses, is still connected to the other half; a few points say nothing."""
    car, far = side(0.0, 5.0, 4.5), side(0.0, 5.0, 4.5, step=0.3)
    for p_map in (car, far):
        segments, voxel = segments_of(p_map, np.ones(len(p_map), bool))
        east = segments.parts.sums[:, 0] > 2.2 * segments.parts.points
        apart = split_segments(segments, np.full(len(east), 20), np.where(east, 30, 0), 0.7, 0.25)
        np.testing.assert_array_equal(apart.of_points(voxel), 0)
