"""Movers: a car is placed by what it shows of itself, standing ones are not listed, one object is one row."""

from dataclasses import replace

import numpy as np
import pytest

from gnss_sem_map.dynamics.motion_state import Motion, TrackedObject
from gnss_sem_map.dynamics.movers import class_by_shape, movers_of
from gnss_sem_map.dynamics.object_track import ObjectTrack, courses, track_of
from gnss_sem_map.dynamics.sweep_delays import SweepDelays, delays_towards
from gnss_sem_map.dynamics.tracking import Segment

LENGTH, WIDTH, HEIGHT = 4.2, 1.8, 1.5
SPEED = 8.0


def visible_part(centre, heading, lidar):
    """The sides of a car that are turned to the LiDAR, as points every 0.2 m."""
    c, s = np.cos(heading), np.sin(heading)
    turn = np.array([[c, -s], [s, c]])
    along, across = np.linspace(-LENGTH / 2, LENGTH / 2, 21), np.linspace(-WIDTH / 2, WIDTH / 2, 9)
    faces = {
        (1, 0): np.stack([np.full(9, LENGTH / 2), across], axis=1),
        (-1, 0): np.stack([np.full(9, -LENGTH / 2), across], axis=1),
        (0, 1): np.stack([along, np.full(21, WIDTH / 2)], axis=1),
        (0, -1): np.stack([along, np.full(21, -WIDTH / 2)], axis=1),
    }
    seen = [
        face for normal, face in faces.items()
        if turn @ normal @ (lidar - centre - turn @ face.mean(axis=0)) > 0
    ]  # fmt: skip
    return centre + np.concatenate(seen) @ turn.T


def segments(place, heading, lidar, scans=40, delay=lambda t: 0.0):
    """Of a car at `place(t)`, in scans 0.1 s apart that meet it `delay(t)` later."""
    found = []
    for k in range(scans):
        t = 0.1 * k + delay(0.1 * k)
        outline = visible_part(np.array(place(t)), heading(t), np.array(lidar(t)))
        found.append(
            Segment(
                k, 0.1 * k, outline.mean(axis=0), len(outline), True, False, outline.copy, np.array(lidar(t)),
                (0.2, HEIGHT), len(outline) // 2, SweepDelays(np.full(72, delay(0.1 * k))),
            )
        )  # fmt: skip
    return found


def tracked(track, motion=Motion.MOVING, lidar="", chunk=0):
    return TrackedObject(motion, 1.0, True, "went", (), 500, 0.0, 1.0, np.zeros((0, 2)), track, lidar, chunk)


def only(track):
    (mover,) = movers_of([tracked(track)], {"vehicle": "vehicle"})
    return mover


def passing(t):
    """Along the x axis, past the LiDAR at the origin."""
    return -16.0 + SPEED * t, 4.0


def still(t):
    return 0.0, 0.0


def straight(t):
    return 0.0


def test_a_car_that_passes_has_its_own_speed_not_that_of_its_visible_part() -> None:
    seen = segments(passing, straight, still)
    centroids = np.gradient([one.centroid[0] for one in seen], 0.1)
    mover = only(track_of(seen))
    assert np.abs(centroids - SPEED).max() > 1.0  # its visible part moves along the car
    np.testing.assert_allclose(mover.speeds, SPEED, atol=0.3)
    assert (np.abs(mover.speeds - SPEED) < 2 * mover.speed_stddevs).all()
    np.testing.assert_allclose(mover.headings_deg, 90.0, atol=3.0)  # to the east
    np.testing.assert_allclose(mover.positions[:, 0], [passing(t)[0] for t in mover.stamps], atol=0.3)
    np.testing.assert_allclose(mover.size_m, (LENGTH, WIDTH, HEIGHT), atol=0.2)


def test_of_a_car_whose_rear_alone_is_seen_the_middle_is_hardly_known_along_its_way() -> None:
    def ahead(t):
        return 15.0 + SPEED * t, 0.0

    mover = only(track_of(segments(ahead, straight, lambda t: (SPEED * t, 0.0))))
    off = np.abs(mover.positions[:, :2] - [ahead(t) for t in mover.stamps])
    assert (off[:, 0] > LENGTH / 2 - 0.3).all()
    assert (off < 2 * mover.position_stddevs).all()
    assert mover.position_stddevs[:, 1].max() < 0.3  # across it, both edges are seen
    whole = only(track_of(segments(passing, straight, still)))
    assert whole.position_stddevs.max() < 0.5
    np.testing.assert_allclose(
        mover.speed_stddevs.max(), 0.0, atol=0.5
    )  # what is alike in all scans moves nothing


def test_a_curve_is_followed() -> None:
    def place(t):
        return 15 * np.sin(t / 2.5), 20 - 15 * np.cos(t / 2.5)

    mover = only(track_of(segments(place, lambda t: t / 2.5, still)))
    np.testing.assert_allclose(mover.speeds[3:-3], 15 / 2.5, atol=0.4)
    np.testing.assert_allclose(mover.headings_deg[5:-5], 90 - np.degrees(mover.stamps[5:-5] / 2.5), atol=8.0)


def test_time_within_the_sweep_counts() -> None:
    """A car that passes is met 50 ms before the stamp in front of the LiDAR, and 50 ms after it behind."""
    sliding = segments(passing, straight, still, delay=lambda t: 0.05 * np.tanh((t - 2.0) / 0.4))
    ignored = [replace(one, delays=None) for one in sliding]
    assert np.abs(only(track_of(sliding)).speeds - SPEED).max() < 0.3
    assert np.abs(only(track_of(ignored)).speeds - SPEED).max() > 0.5


def test_what_stands_is_not_listed() -> None:
    """However it is passed, and whatever it is called."""
    for aside in (3.0, 6.0, 12.0):
        parked = segments(lambda t: (0.0, 0.0), straight, lambda t, y=aside: (-18.0 + 9.0 * t, y))
        for motion in Motion:
            assert not movers_of([tracked(track_of(parked), motion)], {"vehicle": "vehicle"})


def test_what_moves_but_is_not_judged_to_is_not_listed() -> None:
    track = track_of(segments(passing, straight, still))
    assert not movers_of(
        [tracked(track, Motion.PARKED), tracked(track, Motion.UNKNOWN)], {"vehicle": "vehicle"}
    )
    assert not movers_of([tracked(None)], {"vehicle": "vehicle"})


def part(track, rows):
    return ObjectTrack(
        track.stamps[rows], track.positions[rows], track.variances[rows], track.size_m, track.labelled,
        track.points[rows],
    )  # fmt: skip


def test_tracks_of_two_chunks_are_one_object_and_each_scan_counts_once() -> None:
    whole = track_of(segments(passing, straight, still))
    first, second = part(whole, slice(0, 28)), part(whole, slice(15, None))
    (mover,) = movers_of([tracked(first, chunk=0), tracked(second, chunk=1)], {"vehicle": "vehicle"})
    np.testing.assert_array_equal(mover.stamps, whole.stamps)
    np.testing.assert_allclose(mover.speeds, only(whole).speeds)
    assert mover.points == whole.points.sum()


@pytest.mark.parametrize("hidden", [slice(0, 2), slice(-2, None)], ids=["first", "last"])
def test_who_shows_no_feet_at_first_or_at_last_is_on_the_ground(hidden) -> None:
    track = track_of(segments(passing, straight, still))
    track.positions[:, 2] = 5.0
    track.positions[hidden, 2] += 1.2
    np.testing.assert_allclose(only(track).heights, 5.0)


@pytest.mark.parametrize("chunk", [0, 1])
def test_a_part_of_a_car_that_was_a_segment_of_its_own_is_no_object(chunk) -> None:
    """Its rear, seen for some scans; what drives as close before or beside the car is an object."""
    car = track_of(segments(lambda t: (SPEED * t, 9.0), straight, still))

    def small(along, across=0.0):
        off = np.array([along, across, 0.0])
        return replace(car, positions=car.positions + off, size_m=(0.4, 0.6, 0.5), points=np.full(40, 3))

    def count(other):
        return len(movers_of([tracked(car), tracked(part(other, slice(9, 21)), chunk=chunk)], {}))

    assert count(small(-LENGTH / 2)) == 1
    assert count(small(LENGTH / 2, WIDTH / 3)) == 1
    assert count(small(-LENGTH / 2 - 1.0)) == 2
    assert count(small(0.0, WIDTH)) == 2


@pytest.mark.parametrize(
    ("behind_m", "size_m", "count"),
    [
        (2.0, (0.4, 1.9, 1.1), 1),
        (2.0, (0.2, 1.9, 0.3), 1),
        (3.0, (0.4, 1.9, 1.1), 2),
        (2.0, (1.7, 0.6, 1.8), 2),
    ],
    ids=["another part of the lorry", "a flat part", "the next car", "a cyclist"],
)
def test_what_follows_a_lorry_closer_than_a_car_could_is_a_part_of_it(behind_m, size_m, count) -> None:
    """Of the lorry, its rear alone is seen."""
    car = track_of(segments(lambda t: (SPEED * t, 9.0), straight, still))
    lorry = replace(car, size_m=(0.3, 2.2, 2.4), points=car.points + 100, labelled=0.0)
    other = replace(car, size_m=size_m, positions=car.positions - (behind_m, 0.0, 0.0), labelled=0.0)
    movers = movers_of([tracked(lorry), tracked(other)], {"vehicle": "vehicle"})
    assert len(movers) == count
    assert movers[-1].name == "vehicle"


def test_two_lidars_that_see_one_car_list_it_once() -> None:
    left = track_of(segments(passing, straight, still))
    right = track_of(segments(passing, straight, lambda t: (1.0, 9.0)))
    ahead = np.array([0.05 * SPEED, 0.0, 0.0])
    right = replace(right, stamps=right.stamps + 0.05, positions=right.positions + ahead)
    (mover,) = movers_of([tracked(left, lidar="left"), tracked(right, lidar="right")], {"vehicle": "vehicle"})
    assert mover.lidars == ("left", "right")
    assert len(mover.stamps) == 80
    np.testing.assert_allclose(mover.speeds, SPEED, atol=0.3)


def test_two_cars_of_one_chunk_stay_two_and_so_do_those_of_two_chunks_behind_each_other() -> None:
    one = track_of(segments(passing, straight, still))
    behind = replace(one, positions=one.positions - (6.0, 0.0, 0.0))
    assert len(movers_of([tracked(one), tracked(behind)], {})) == 2
    assert len(movers_of([tracked(one), tracked(behind, chunk=1)], {})) == 2
    assert len(movers_of([tracked(one), tracked(replace(one, positions=one.positions + 0.3))], {})) == 2


@pytest.mark.parametrize(
    ("size_m", "speed_mps", "name"),
    [((4.5, 1.8, 1.5), 0.0, "vehicle"), ((0.5, 0.7, 1.75), 1.4, "person"), ((1.7, 0.6, 1.8), 6.0, "cyclist"),
     ((9.0, 2.5, 3.2), 9.0, "vehicle"), ((2.0, 3.0, 0.4), 0.0, "unknown"), ((0.3, 1.8, 1.2), 9.0, "vehicle"),
     ((1.1, 2.2, 2.4), 9.0, "vehicle"), ((0.3, 1.8, 0.3), 9.0, "unknown"), ((0.5, 1.4, 1.8), 1.2, "cyclist")],
)  # fmt: skip
def test_class_by_shape(size_m, speed_mps, name) -> None:
    assert class_by_shape(size_m, speed_mps) == name


def test_labels_tell_the_class_only_where_one_class_moves() -> None:
    track = track_of(segments(passing, straight, still))
    assert movers_of([tracked(track)], {"vehicle": "vehicle"})[0].is_labelled
    both = movers_of([tracked(track)], ("person", "vehicle"))[0]
    assert (both.is_labelled, both.name) == (False, "vehicle")
    assert both.labelled == pytest.approx(0.5, abs=0.02)


def test_courses_are_unit_vectors_along_the_way() -> None:
    stamps = np.arange(30) / 10
    places = np.column_stack([5 * stamps, 0 * stamps])
    np.testing.assert_allclose(courses(places), [(1.0, 0.0)] * 30)
    assert np.isfinite(courses(np.zeros((4, 2)))).all()


def test_delays_are_those_of_the_points_of_a_direction() -> None:
    angles = np.linspace(-np.pi, np.pi, 7200, endpoint=False)
    points = np.column_stack([-10 * np.sin(angles), 10 * np.cos(angles), 0 * angles]).astype(np.float32)
    points[::7] = np.nan
    usable = np.isfinite(points[:, 0])
    turn = np.array(
        [[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    )  # the LiDAR's y axis is the map's x axis
    delays = SweepDelays.of(points, 7.0 - 0.1 * angles / (2 * np.pi), usable, turn, 7.0)
    ways = np.array([(1.0, 0.1), (0.0, 2.0), (-1.0, -1.0)])
    expected = -0.1 * np.arctan2(ways[:, 1], ways[:, 0]) / (2 * np.pi)
    np.testing.assert_allclose(delays_towards(ways, [delays], np.array([3])), expected, atol=1e-3)
    twice = delays_towards(ways, [SweepDelays.none(), delays], np.array([1, 2]))
    np.testing.assert_allclose(twice, [0.0, *expected[1:]], atol=1e-3)


def test_a_track_comes_back_from_json() -> None:
    track = track_of(segments(passing, straight, still))
    again = ObjectTrack.from_dict(track.as_dict())
    for name, value in vars(track).items():
        np.testing.assert_array_equal(getattr(again, name), value)
