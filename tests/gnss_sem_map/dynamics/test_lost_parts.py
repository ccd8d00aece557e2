"""Two tracks of one car that creeps: the one that is not seen to move is joined to the one that is."""

import numpy as np
import pytest

from gnss_sem_map.dynamics.clusters import PointSets, Segments
from gnss_sem_map.dynamics.lost_parts import (
    MISSES_PER_HIT,
    MOVED_SHARE,
    joined_to_movers,
    with_next_parts,
)
from gnss_sem_map.dynamics.motion_state import Motion, TrackedObject
from gnss_sem_map.dynamics.tracking import Segment

POINTS, CREPT = 10, 3
"""Points of the car in every scan, each a voxel, and how many of its own voxels it has left in the end."""


def track(motion, segments):
    return TrackedObject(
        motion, 0.0, False, "seen", segments, POINTS * len(segments), 0.0, 1.0, np.zeros((len(segments), 2))
    )


def joined(crept=CREPT, misses_per_hit=2 * MISSES_PER_HIT, scans=(2, 2), motion=Motion.PARKED):
    """The motion of the first track of a car: found in so many scans before it creeps, and in others as it has crept.

    Its second track is that of a mover.
    """
    before, after = scans
    ones, none = np.ones(POINTS, np.int32), np.empty((POINTS, 0))
    parts = PointSets(ones, 0 * ones, np.zeros((POINTS, 3)), none, none)
    segments = [Segments(np.arange(POINTS), parts, 0 * ones, np.zeros(1, np.bool_))] * (before + after)
    start = np.arange(POINTS, dtype=np.int32)
    places = [start] * before + [start + np.int32(crept)] * after
    moved = [np.full(POINTS, scan >= before) for scan in range(before + after)]
    objects = [
        track(motion, tuple(range(before))),
        track(Motion.MOVING, tuple(range(before, before + after))),
    ]
    hits = np.full(before + after, 100.0)
    first, second = joined_to_movers(objects, segments, places, moved, hits, misses_per_hit * hits)
    assert second is objects[1]
    return first.motion


def test_a_part_that_the_mover_covers_and_that_is_seen_through_moves_too():
    assert joined() == Motion.MOVING


@pytest.mark.parametrize(
    "change",
    [
        {"crept": round(POINTS * (1 - MOVED_SHARE)) + 1},
        {"misses_per_hit": 0.9 * MISSES_PER_HIT},
        {"scans": (1, 2)},
    ],
    ids=["mostly elsewhere", "seen through as seldom as what stands", "one scan"],
)
def test_what_may_stand_stays(change):
    assert joined(**change) == Motion.PARKED


def test_what_is_not_known_is_not_joined():
    assert joined(motion=Motion.UNKNOWN) == Motion.UNKNOWN


REAR_M = np.array([(0.0, 0.2 * k) for k in range(9)])
SIDE_M = np.array([(0.2 * k, 0.0) for k in range(23)])


def seen(outline, place, scans):
    """Segments of what shows this outline, and is at `place(t)`."""
    found = []
    for scan in scans:
        points = np.array(place(scan / 10)) + outline
        found.append(
            Segment(scan, scan / 10, points.mean(axis=0), len(points), False, False, points.copy, np.zeros(2))
        )
    return found


def objects_of(*tracks, motion=Motion.MOVING):
    """Objects of segments that are listed scan by scan, and that list."""
    listed = sorted((one for track in tracks for one in track), key=lambda one: one.scan)
    found = []
    for track in tracks:
        members = tuple(listed.index(one) for one in track)
        path = np.array([one.centroid for one in track])
        points = sum(one.points for one in track)
        found.append(
            TrackedObject(motion, 1.0, True, "went", members, points, track[0].stamp, track[-1].stamp, path)
        )
    return found, listed


def straight(t):
    return 8.0 * t, 3.0


def test_a_car_that_shows_its_side_after_its_rear_is_one_object():
    """Also when some scans show nothing of it; its segments are those of both, in the order of time."""
    for pause in (0, 4):
        rear, side = seen(REAR_M, straight, range(12)), seen(SIDE_M, straight, range(12 + pause, 30))
        objects, listed = objects_of(rear, side)
        (car,) = with_next_parts(objects, listed, 0.7)
        assert [listed[n].scan for n in car.segments] == [*range(12), *range(12 + pause, 30)]
        assert (car.points, car.first_stamp, car.last_stamp) == (12 * 9 + (18 - pause) * 23, 0.0, 2.9)
        np.testing.assert_array_equal(car.path, [listed[n].centroid for n in car.segments])


def test_what_is_elsewhere_or_moves_otherwise_or_at_the_same_time_is_another_object():
    rear = seen(REAR_M, straight, range(12))
    others = {
        "two metres ahead": seen(REAR_M, lambda t: (8.0 * t + 2.0, 3.0), range(12, 24)),
        "oncoming": seen(REAR_M, lambda t: (19.2 - 8.0 * t, 3.0), range(12, 24)),
        "at the same time": seen(REAR_M, straight, range(11, 24)),
        "later": seen(REAR_M, straight, range(20, 30)),
        "few scans": seen(REAR_M, straight, range(12, 16)),
    }
    for name, other in others.items():
        objects, listed = objects_of(rear, other)
        assert with_next_parts(objects, listed, 0.7) == objects, name
    objects, listed = objects_of(rear, seen(REAR_M, straight, range(12, 24)), motion=Motion.PARKED)
    assert with_next_parts(objects, listed, 0.7) == objects
