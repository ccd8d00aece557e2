"""What a track is of: segments that are too large for what moved are of something beside it."""

import numpy as np
import pytest

from gnss_sem_map.dynamics.motion_state import GONE, Motion, MotionSettings, classify_motion
from gnss_sem_map.dynamics.tracking import Segment


def segment(scan, x, length, width=0.0):
    """A segment of 50 points along x, 8 m aside."""
    across = np.tile([8.0, 8.0 + width], 10)
    outline = np.column_stack([np.linspace(x - length / 2, x + length / 2, 20), across])
    return Segment(scan, 0.1 * scan, np.array([x, 8.0]), 50, False, False, outline.copy, np.zeros(2))


def test_a_person_who_comes_off_a_hedge_leaves_the_hedge():
    """In the first scans both are one cluster, and so one track."""
    segments = [segment(scan, 0.12 * scan, 5.0 if scan < 8 else 0.5) for scan in range(24)]
    hits = np.where(np.arange(24) < 8, 2000.0, 100.0)
    misses = np.where(np.arange(24) < 8, 150.0, 5000.0)
    objects = classify_motion(segments, hits, misses, MotionSettings(), is_sharp=True)
    motions = {n: one.motion for one in objects for n in one.segments}
    assert all(motions[n] == Motion.PARKED for n in range(8))
    assert all(motions[n] == Motion.MOVING for n in range(8, 24))


def test_a_car_that_waits_and_drives_on_is_one_object():
    """It is as large while it waits, and others do not see through it there."""
    places = [3.0] * 8 + [3.0 + 0.8 * scan for scan in range(16)]
    segments = [segment(scan, x, 4.3) for scan, x in enumerate(places)]
    hits = np.where(np.arange(24) < 8, 2000.0, 100.0)
    misses = np.where(np.arange(24) < 8, 150.0, 5000.0)
    (one,) = classify_motion(segments, hits, misses, MotionSettings(), is_sharp=True)
    assert one.motion == Motion.MOVING
    assert one.segments == tuple(range(24))


def test_a_wall_that_is_never_seen_through_leaves_the_track_of_a_walker():
    """An image calls parts of the wall a person; the walker comes from behind it, and the track goes over to him."""
    wall = [segment(scan, 0.1 * scan, 2.5) for scan in range(8)]
    walker = [segment(scan, 1.0, 0.5) for scan in range(8, 13)]
    hits, misses = np.array([600.0] * 8 + [1300.0] * 5), np.array([0.0] * 8 + [2500.0] * 5)
    objects = classify_motion(wall + walker, hits, misses, MotionSettings(), is_sharp=True)
    motions = {n: one.motion for one in objects for n in one.segments}
    assert all(motions[n] == Motion.PARKED for n in range(8))
    assert all(motions[n] in GONE for n in range(8, 13))


def test_what_is_beside_something_that_moved_is_in_time_order():
    """A person whose segments are too large in two scans, and are never seen through in two earlier ones."""
    large, occupied = (6, 8), (1, 3)
    segments = [segment(scan, 0.02 * scan, 5.0 if scan in large else 0.5) for scan in range(12)]
    hits = np.where(np.isin(np.arange(12), [*large, *occupied]), 2000.0, 100.0)
    misses = np.where(np.isin(np.arange(12), [*large, *occupied]), 0.0, 5000.0)
    objects = classify_motion(segments, hits, misses, MotionSettings(), is_sharp=True)
    assert (1, 3, 6, 8) in [one.segments for one in objects]
    assert all(one.segments == tuple(sorted(one.segments)) for one in objects)


def test_a_parked_car_behind_which_another_passes_stays():
    """In four scans both are one segment; the part of it that is seen grows as it is passed."""
    segments = [segment(scan, 0.08 * scan, 4.3) for scan in range(24)]
    hits = np.full(24, 2000.0)
    misses = np.where(np.isin(np.arange(24), (17, 19, 21, 23)), 1500.0, 10.0)
    objects = classify_motion(segments, hits, misses, MotionSettings(), is_sharp=True)
    assert not any(one.motion in GONE for one in objects)


@pytest.mark.parametrize(("width", "moves"), [(1.8, True), (6.0, False)])
def test_what_comes_closer_and_waits_is_no_wider_than_a_vehicle(width, moves):
    """It hides the place that it left. Of bushes and cars that stand, scans see now these and now those."""
    places = [3.7 * min(scan / 12, 1.0) for scan in range(40)]
    segments = [segment(scan, x, 5.0, width) for scan, x in enumerate(places)]
    hits, misses = np.full(40, 2000.0), np.full(40, 60.0)
    objects = classify_motion(
        segments,
        hits,
        misses,
        MotionSettings(),
        is_sharp=True,
        counted_in=lambda number, scans: (100.0, 50.0),
    )
    assert any(one.motion == Motion.MOVING for one in objects) == moves
