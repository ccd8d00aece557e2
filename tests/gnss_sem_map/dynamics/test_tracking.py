"""Tracks, and the motion states that follow from hits and misses."""

from dataclasses import replace

import numpy as np

from gnss_sem_map.dynamics.motion_state import MotionSettings, classify_motion
from gnss_sem_map.dynamics.tracking import Segment, track
from gnss_sem_map.refinement.vehicles import Motion


def segment(scan, x, y=0.0, length=4.0, points=50, shown=True, truncated=False):
    centre, half = np.array([x, y]), np.array([length / 2, 0.9])
    corners = centre + half * [[-1, -1], [-1, 1], [1, -1], [1, 1]]
    return Segment(scan, scan * 0.1, centre, points, shown, truncated, corners.copy, np.array([-20.0, 0.0]))


def test_two_cars_that_pass_each_other_keep_their_tracks():
    segments = [
        s for scan in range(30) for s in (segment(scan, scan * 0.8), segment(scan, 24 - scan * 0.8, 2.5))
    ]
    tracks = track(segments, 1.5, np.zeros(60, bool))
    assert [t.segments for t in tracks] == [list(range(0, 60, 2)), list(range(1, 60, 2))]
    np.testing.assert_allclose(tracks[0].velocity, [8.0, 0.0], atol=0.1)


def test_a_track_survives_five_scans_out_of_sight_and_not_six():
    for gap, count in ((5, 1), (6, 2)):
        scans = [*range(10), *range(10 + gap, 20 + gap)]
        segments = [segment(scan, scan * 0.5) for scan in scans]
        assert len(track(segments, 1.5, np.zeros(len(segments), bool))) == count


def test_no_track_lasts_through_a_pause_of_the_sensor():
    """A car stands where another one stood a minute before; one comes fast, and another one is far away then."""
    for before, after, mostly_free in (((0.0, 0.0), (0.0, 0.0), False), ((0.0,), (2000.0,), True)):
        count = len(before)
        segments = [segment(scan, x) for scan, x in enumerate((*before, *after))]
        segments[count:] = [replace(each, stamp=each.stamp + 60.0) for each in segments[count:]]
        found = track(segments, 1.5, np.full(len(segments), mostly_free))
        assert [len(t.segments) for t in found] == [count, count]


def test_on_a_highway_a_fleeting_segment_is_followed_as_far_as_it_drives_and_a_standing_one_is_not():
    for speed, mostly_free, count in ((33.0, True, 1), (33.0, False, 8), (60.0, True, 8)):
        segments = [segment(scan, scan * 0.1 * speed) for scan in range(8)]
        assert len(track(segments, 1.5, np.full(8, mostly_free))) == count


def test_oncoming_traffic_keeps_its_tracks_at_any_speed():
    segments = [
        s
        for scan in range(10)
        for s in (
            segment(scan, scan * 2.5),
            segment(scan, 20 + scan * 2.5),
            segment(scan, 40 - scan * 3.3, 4.0),
        )
    ]
    tracks = track(segments, 1.5, np.ones(30, bool))
    assert [t.segments for t in tracks] == [list(range(k, 30, 3)) for k in range(3)]
    np.testing.assert_allclose(tracks[2].velocity, [-33.0, 0.0], atol=0.5)


def motion_states(segments, hits, misses):
    objects = classify_motion(segments, np.asarray(hits, float), np.asarray(misses, float), MotionSettings())
    return [(o.motion, len(o.segments)) for o in objects]


def test_motion_states_follow_hits_and_misses():
    parked = [segment(scan, 0.0) for scan in range(10)]
    going = [segment(scan, scan * 0.8) for scan in range(10)]
    many, none = np.full(10, 500.0), np.zeros(10)
    assert motion_states(parked, many, none) == [(Motion.PARKED, 10)]
    assert motion_states(parked, none, none) == [(Motion.UNKNOWN, 10)]
    assert motion_states(parked, many / 10, many) == [(Motion.STOPPED_AND_LEFT, 10)]
    assert motion_states(going, many, many / 2) == [(Motion.MOVING, 10)]
    assert motion_states(going, many, none) == [(Motion.PARKED, 10)], (
        "a window between others, never seen through"
    )


def test_what_no_image_shows_needs_both_motion_and_free_space():
    going = [segment(scan, scan * 0.8, shown=False) for scan in range(10)]
    parked = [segment(scan, 0.0, shown=False) for scan in range(10)]
    many, few = np.full(10, 500.0), np.full(10, 50.0)
    assert motion_states(going, few, many) == [(Motion.MOVING, 10)]
    assert motion_states(going, many, few) == []
    assert motion_states(parked, few, many) == []


def test_the_last_scan_of_a_fast_car_goes_with_it_though_nobody_saw_its_place_empty():
    going = [segment(scan, scan * 2.8) for scan in range(10)]
    misses = np.full(10, 50.0)
    misses[-1] = 0.0
    assert motion_states(going, np.full(10, 5.0), misses) == [(Motion.MOVING, 10)]


def test_probability_grows_with_the_evidence():
    parked = [segment(scan, 0.0) for scan in range(10)]
    probabilities = [
        classify_motion(parked, np.full(10, 2.0 * n), np.full(10, 6.0 * n), MotionSettings())[0].probability
        for n in (0.1, 1, 10)
    ]
    assert 0.5 < probabilities[0] < probabilities[1] < probabilities[2] < 1
