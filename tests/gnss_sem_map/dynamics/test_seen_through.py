"""What other scans see through goes, if it is as high as an object; single returns from glass and edges stay."""

import numpy as np
import pytest

from gnss_sem_map.dynamics.clusters import find_segments
from gnss_sem_map.dynamics.seen_through import LEAST_MISSES, free_groups, with_free_groups

EPS_M = 0.7


def block(x, y, length, low, high, step=0.1):
    """Points on the side of a thing along x."""
    xs, zs = np.meshgrid(np.arange(x, x + length, step), np.arange(low, high, step))
    return np.column_stack([xs.ravel(), np.full(xs.size, y), zs.ravel()])


def beside_a_wall(thing):
    """Segments of a scan of a wall and a thing 30 cm before it, the voxel of every point, and which are its."""
    wall = block(-20.0, 5.3, 40.0, 0.3, 3.0)
    p_map, n = np.concatenate([wall, thing]), len(wall) + len(thing)
    segments, voxel = find_segments(p_map, np.zeros(n, bool), np.zeros(n), np.ones(n), EPS_M)
    return segments, voxel, np.arange(n) >= len(wall)


def counts(voxel, is_thing, hits, misses):
    """Hits and misses of the voxels: so many of the thing; the wall was always hit."""
    of_thing = np.bincount(voxel, is_thing) > 0
    return np.where(of_thing, hits, 30), np.where(of_thing, misses, 0)


def test_a_person_before_a_wall_is_a_segment_once_others_saw_through():
    segments, voxel, is_person = beside_a_wall(block(0.0, 5.0, 0.4, 0.3, 1.7))
    assert len(segments.truncated) == 0
    groups = free_groups(segments, *counts(voxel, is_person, 4, 8), EPS_M)
    apart = with_free_groups(segments, groups)
    np.testing.assert_array_equal(groups[voxel] >= 0, is_person)
    np.testing.assert_array_equal(apart.of_points(voxel), np.where(is_person, 0, -1))
    assert apart.whole.points.tolist() == [is_person.sum()]
    assert apart.truncated.tolist() == [False]


def test_what_is_low_goes_only_if_hardly_anything_hit_it():
    """One ring on a far person, not a few returns from a window."""
    segments, voxel, is_low = beside_a_wall(block(0.0, 5.0, 0.4, 1.0, 1.2))
    assert (free_groups(segments, *counts(voxel, is_low, 4, 8), EPS_M) < 0).all()
    groups = free_groups(segments, *counts(voxel, is_low, 4, 21), EPS_M)
    np.testing.assert_array_equal(groups[voxel] >= 0, is_low)


def test_what_is_as_often_hit_as_seen_through_or_seldom_seen_stays():
    segments, voxel, is_person = beside_a_wall(block(0.0, 5.0, 0.4, 0.3, 1.7))
    for hits, misses in ((8, 8), (0, LEAST_MISSES - 1)):
        groups = free_groups(segments, *counts(voxel, is_person, hits, misses), EPS_M)
        assert (groups < 0).all()
        assert with_free_groups(segments, groups) is segments


def test_two_people_apart_are_two_segments():
    two = np.concatenate([block(0.0, 5.0, 0.4, 0.3, 1.7), block(3.0, 5.0, 0.4, 0.3, 1.7)])
    segments, voxel, is_person = beside_a_wall(two)
    apart = with_free_groups(segments, free_groups(segments, *counts(voxel, is_person, 4, 8), EPS_M))
    assert len(apart.truncated) == 2
    assert len(apart.levels()) == 2
    for number, (low, high) in enumerate(apart.levels()):
        outline = apart.outline(number)
        assert np.ptp(outline[:, 0]) < 0.5
        assert 0.3 <= low < high <= 1.7


def test_of_a_car_a_person_beside_it_is_told_apart_and_a_window_is_not():
    """Both are as often seen through; what is behind a window is long and low."""
    for length, high, goes in ((0.5, 1.7, True), (1.7, 1.7, True), (3.0, 1.4, False)):
        car, other = block(0.0, 5.0, 4.5, 0.3, 1.5), block(0.5, 4.8, length, 0.7 if high < 1.5 else 0.3, high)
        p_map, n = np.concatenate([car, other]), len(car) + len(other)
        segments, voxel = find_segments(p_map, np.zeros(n, bool), np.zeros(n), np.ones(n), EPS_M)
        assert len(segments.truncated) == 1
        is_other = np.arange(n) >= len(car)
        groups = free_groups(segments, *counts(voxel, is_other, 10, 30), EPS_M)
        np.testing.assert_array_equal(groups[voxel] >= 0, is_other & goes)


@pytest.mark.parametrize(("misses", "goes"), [(15, False), (30, True)])
def test_in_an_object_only_what_is_seldom_hit_goes_however_small(misses, goes):
    """A window is as small as a person; some views show the car, others what is behind the window."""
    car, part = block(0.0, 5.0, 4.5, 0.3, 1.5), block(2.0, 4.8, 0.5, 0.7, 1.4)
    p_map, n = np.concatenate([car, part]), len(car) + len(part)
    segments, voxel = find_segments(p_map, np.zeros(n, bool), np.zeros(n), np.ones(n), EPS_M)
    is_part = np.arange(n) >= len(car)
    groups = free_groups(segments, *counts(voxel, is_part, 10, misses), EPS_M)
    np.testing.assert_array_equal(groups[voxel] >= 0, is_part & goes)
