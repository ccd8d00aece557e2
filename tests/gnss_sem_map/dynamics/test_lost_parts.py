"""Two tracks of one car that creeps: the one that is not seen to move is joined to the one that is."""

import numpy as np
import pytest

from gnss_sem_map.dynamics.clusters import PointSets, Segments
from gnss_sem_map.dynamics.lost_parts import MISSES_PER_HIT, MOVED_SHARE, joined_to_movers
from gnss_sem_map.dynamics.motion_state import Motion, TrackedObject

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
