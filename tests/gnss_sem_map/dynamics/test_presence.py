"""What is there only while a mover is there is of the mover; what is there at other times stands."""

import numpy as np
import pytest

from gnss_sem_map.dynamics.clusters import PointSets, Segments
from gnss_sem_map.dynamics.motion_state import Motion, TrackedObject
from gnss_sem_map.dynamics.presence import (
    PERSON_REACH_M,
    PERSON_S,
    PREDICTED_S,
    near_movers,
    presence,
    unusually_large,
)
from gnss_sem_map.dynamics.tracking import Segment

REACH_M, STEP_S = 0.35, 0.1


def seen_in(scans, with_mover, looks):
    """Whether one place is of a mover, and whether it stands: found in some of 40 scans, a mover near in others."""
    places = [np.zeros(int(scan in scans), np.int32) for scan in range(40)]
    near = [np.full(int(scan in scans), scan in with_mover) for scan in range(40)]
    of_mover, stands, _ = presence(places, np.array([[looks], [0]], np.int32), near)
    return any(part.any() for part in of_mover), any(part.any() for part in stands)


def test_a_place_that_is_found_only_with_a_mover_is_of_it():
    assert seen_in(range(5, 8), with_mover=range(4, 10), looks=38) == (True, False)


def test_a_place_that_is_found_before_and_after_stands():
    assert seen_in(range(40), with_mover=range(4, 10), looks=38) == (False, True)


def test_a_place_that_nobody_looked_at_without_the_mover_is_left_alone():
    assert seen_in(range(5, 8), with_mover=range(4, 10), looks=4) == (False, False)


def test_a_place_without_a_mover_is_of_none():
    assert seen_in(range(5, 7), with_mover=(), looks=38) == (False, False)


@pytest.mark.parametrize(("hits", "misses", "expected"), [(35, 0, True), (22, 0, False), (35, 5, False)])
def test_what_scans_hit_before_a_mover_came_beside_it_stands(hits, misses, expected):
    """The last 20 scans show it beside the mover; one that comes to a stop is within the margin of a hit before."""
    places = [np.zeros(int(scan >= 20), np.int32) for scan in range(40)]
    near = [np.ones(len(place), np.bool_) for place in places]
    *_, occupied = presence(places, np.array([[hits], [misses]], np.int32), near)
    assert [part.tolist() for part in occupied] == [[]] * 20 + [[expected]] * 20


def test_a_segment_that_is_much_larger_than_most_of_its_track_holds_something_else():
    def segment(scan, length):
        outline = np.array([(0.0, 0.0), (length, 0.0)])
        return Segment(scan, 0.1 * scan, outline.mean(axis=0), 20, False, False, outline.copy, np.zeros(2))

    lengths = [1.9] * 6 + [5.7, 2.2, 5.7]
    listed = [segment(scan, length) for scan, length in enumerate(lengths)]
    for motion, expected in ((Motion.MOVING, [6, 8]), (Motion.PARKED, [])):
        one = TrackedObject(motion, 1.0, True, "", tuple(range(9)), 180, 0.0, 0.8, np.zeros((9, 2)))
        assert np.flatnonzero(unusually_large([one], listed)).tolist() == expected


def test_a_lorry_whose_cab_is_seen_first_is_as_long_as_its_trailer():
    """From afar, in most scans, a few points show the cab; close by, many show both."""
    lengths, points = [3.9] * 12 + [15.5] * 8, [200] * 12 + [30_000] * 8
    listed = [
        Segment(
            scan,
            0.1 * scan,
            np.zeros(2),
            count,
            False,
            False,
            np.array([(0.0, 0.0), (m, 0.0)]).copy,
            np.zeros(2),
        )
        for scan, (m, count) in enumerate(zip(lengths, points, strict=True))
    ]
    one = TrackedObject(
        Motion.MOVING, 1.0, True, "", tuple(range(20)), sum(points), 0.0, 1.9, np.zeros((20, 2))
    )
    assert not unusually_large([one], listed).any()


def points_at(p):
    """Segments of one scan: the points (n, 3) m, each a voxel; those at y < 5 are the only segment."""
    p = np.asarray(p, np.float64)
    none = np.empty((len(p), 0))
    ones = np.ones(len(p), np.int32)
    number = np.where(p[:, 1] < 5, 0, -1).astype(np.int32)
    count = int(number.max(initial=-1)) + 1
    parts = PointSets(ones, 0 * ones, p, none, none)
    return Segments(np.arange(len(p)), parts, number, np.zeros(count, np.bool_))


def walk(seen, scans=60, speed=1.5, motion=Motion.MOVING, height=0.0):
    """Where something of this height is near: it is found in the scans `seen`; a row of voxels lies along its way."""
    rng = np.random.default_rng(1)
    stamps = STEP_S * np.arange(scans)
    body = rng.uniform(-0.2, 0.2, (20, 3)) + np.array([0, 4.7, 1.0])
    row = np.stack([np.arange(-4, 12, 0.2), np.full(80, 5.1), np.ones(80)], axis=1)
    segments, listed = [], []
    for scan, t in enumerate(stamps):
        him = body + np.array([speed * t, 0, 0])
        segments.append(points_at(np.concatenate([him, row]) if scan in seen else row))
        if scan in seen:
            middle = him[:, :2].mean(axis=0)
            listed.append(
                Segment(scan, t, middle, 20, False, False, him[:, :2].copy, np.zeros(2), (0.2, 0.2 + height))
            )
    one = TrackedObject(
        motion, 1.0, False, "", tuple(range(len(listed))), 20 * len(listed), 0.0, 1.0,
        np.array([segment.centroid for segment in listed]),
    )  # fmt: skip
    near = near_movers([one], listed, segments, stamps, REACH_M)
    distance = [
        np.linalg.norm(row[:, None] - (body + np.array([speed * t, 0, 0]))[None], axis=2).min(axis=1)
        for t in stamps
    ]
    return [part[-80:] for part in near], distance


@pytest.mark.parametrize("speed", [1.5, -1.0])
@pytest.mark.parametrize(
    ("height", "seconds", "reach"), [(0.3, PREDICTED_S, REACH_M), (1.6, PERSON_S, PERSON_REACH_M)]
)
def test_a_track_tells_where_its_object_is_in_scans_that_do_not_show_it(speed, height, seconds, reach):
    """That of a person, who is higher than long, tells it for longer, and reaches farther."""
    seen, told_scans = [20, 21, 22, 25, 26, 27, 30], seconds / STEP_S
    near, distance = walk(seen, speed=speed, height=height)
    for scan, (part, away) in enumerate(zip(near, distance, strict=True)):
        is_told = min(seen) - told_scans < scan < max(seen) + told_scans
        if abs(scan - 25) != 5 + told_scans:  # rounding decides there
            np.testing.assert_array_equal(part, (away < reach) & is_told, err_msg=f"scan {scan}")


@pytest.mark.parametrize("change", [{"motion": Motion.PARKED}, {"seen": [10, 11]}])
def test_what_stands_and_what_is_hardly_seen_tells_nothing(change):
    near, _ = walk(**{"seen": [10, 11, 12], **change})
    assert not any(part.any() for part in near)
