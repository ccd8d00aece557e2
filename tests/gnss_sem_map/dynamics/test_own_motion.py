"""Motion of a track against the hypothesis that it stands: a box in the plane, seen exactly as far as it faces us."""

from dataclasses import replace

import numpy as np
import pytest

from gnss_sem_map.dynamics.own_motion import motion_of
from gnss_sem_map.dynamics.tracking import Segment

LENGTH, WIDTH = 4.2, 1.8
FACES = {  # outward normal -> its points, in the car
    (-1, 0): [(-LENGTH / 2, y) for y in np.linspace(-WIDTH / 2, WIDTH / 2, 10)],
    (1, 0): [(LENGTH / 2, y) for y in np.linspace(-WIDTH / 2, WIDTH / 2, 10)],
    (0, -1): [(x, -WIDTH / 2) for x in np.linspace(-LENGTH / 2, LENGTH / 2, 22)],
    (0, 1): [(x, WIDTH / 2) for x in np.linspace(-LENGTH / 2, LENGTH / 2, 22)],
}


def seen(scan, centre, heading, lidar, truncated=False, grazing_deg=3.0):
    """What a LiDAR sees of a car: the faces turned to it, unless they are nearly edge-on."""
    c, s = np.cos(heading), np.sin(heading)
    turn = np.array([[c, -s], [s, c]])
    points = []
    for normal, face in FACES.items():
        towards = lidar - (centre + turn @ np.mean(face, axis=0))
        if turn @ normal @ towards > np.sin(np.radians(grazing_deg)) * np.linalg.norm(towards):
            points += [centre + turn @ point for point in face]
    outline = np.array(points)
    return Segment(
        scan, 0.1 * scan, outline.mean(axis=0), len(outline), True,
        truncated, outline.copy, np.asarray(lidar, float),
    )  # fmt: skip


def track(place, lidar, heading=0.0, scans=40, **options):
    return [
        seen(k, np.array(place(0.1 * k)), heading, np.array(lidar(0.1 * k)), **options) for k in range(scans)
    ]


@pytest.mark.parametrize("heading", [0.0, 0.3, np.pi / 4, np.pi / 2, 2.0])
@pytest.mark.parametrize("aside", [2.9, 4.5, 12.0])
def test_a_parked_car_does_not_move_however_it_is_passed(heading, aside):
    for start in (-30.0, -12.0, -3.0):
        moved = motion_of(track(lambda t: (0.0, 0.0), lambda t, x=start: (x + 9.0 * t, aside), heading))
        assert moved is None or not moved.is_moving


@pytest.mark.parametrize("scans", [8, 15, 40])
def test_a_parked_car_of_which_only_one_side_was_seen_for_some_time_does_not_move(scans):
    for start in np.arange(-20.0, 15.0, 2.5):
        moved = motion_of(track(lambda t: (0.0, 0.0), lambda t, x=start: (x + 9.0 * t, 2.5), scans=scans))
        assert moved is None or not moved.is_moving


@pytest.mark.parametrize("speed", [0.4, 2.0, 8.0, 20.0])
@pytest.mark.parametrize(
    "lidar", [lambda t: (-15.0, -2.0), lambda t: (-15.0 + 3.0 * t, -3.5), lambda t: (25 - 2.0 * t, 3.5)]
)
def test_a_mover_is_displaced_by_its_way(speed, lidar):
    moved = motion_of(track(lambda t: (speed * t, 0.0), lidar))
    assert moved.is_moving
    assert moved.shift_m == pytest.approx(speed * 3.9, abs=0.3 + 0.03 * speed * 3.9)


def test_a_car_that_goes_and_then_waits_for_long_is_displaced_all_the_same():
    moved = motion_of(track(lambda t: (3.0 * min(t, 2.0), 0.0), lambda t: (-12.0, 3.0), scans=100))
    assert moved.is_moving
    assert moved.shift_m == pytest.approx(6.0, abs=0.3)


def test_a_car_that_turns_is_displaced():
    def turning(t):
        return 8 * np.sin(0.4 * t), 8 - 8 * np.cos(0.4 * t)

    parts = [seen(k, np.array(turning(0.1 * k)), 0.04 * k, np.array([-15.0, 4.0])) for k in range(40)]
    assert motion_of(parts).is_moving


def test_a_cluster_that_grows_by_what_stands_beside_it_does_not_move():
    """Over three scans, as the view opens: its end is elsewhere then, and it stays so."""
    parts = track(lambda t: (0.0, 0.0), lambda t: (-15.0, 3.0))
    longer = np.arange(0.0, 3.6, 0.2)
    for k, one in enumerate(parts[20:]):
        beside = np.column_stack([-LENGTH / 2 - longer[: 6 * (k + 1)], np.full(min(6 * (k + 1), 18), 0.5)])
        outline = np.vstack([one.outline(), beside])
        parts[20 + k] = replace(one, outline=outline.copy, centroid=outline.mean(axis=0))
    moved = motion_of(parts)
    assert moved is None or not moved.is_moving


def test_what_is_abeam_and_hidden_at_both_ends_has_no_place():
    """A lorry of 15 m that passes, of which for a while some metres beside the LiDAR are seen only."""
    lorry = np.column_stack([np.linspace(-7.5, 7.5, 76), np.full(76, -1.2)])

    def passing(hidden):
        parts = []
        for k in range(60):
            outline, lidar = lorry + np.array([20.0 - 0.6 * k, 5.0]), np.array([0.0, 2.0])
            if hidden and 25 <= k < 36:
                outline = outline[abs(outline[:, 0]) < 2.0]
            centroid = outline.mean(axis=0)
            parts.append(Segment(k, 0.1 * k, centroid, len(outline), True, False, outline.copy, lidar))
        return motion_of(parts)

    assert passing(False).is_moving
    assert passing(True).is_moving
    assert passing(True).shift_m == pytest.approx(passing(False).shift_m, abs=0.5)


def test_a_jump_from_one_object_to_another_is_no_motion():
    places = [0.0] * 20 + [2.0] * 20
    assert not motion_of(track(lambda t: (places[round(10 * t)], 0.0), lambda t: (-15.0, 3.0))).is_moving


def test_noise_of_the_edges_is_no_motion():
    rng = np.random.default_rng(0)
    for _ in range(200):
        wander = rng.normal(0, 0.25, (40, 2))
        moved = motion_of(track(lambda t, w=wander: w[round(10 * t)], lambda t: (-15.0, 3.0)))
        assert not moved.is_moving


def test_what_is_cut_off_says_nothing_of_motion():
    assert motion_of(track(lambda t: (5 * t, 0.0), lambda t: (-15.0, 3.0), truncated=True)) is None
    assert motion_of(track(lambda t: (5 * t, 0.0), lambda t: (-15.0, 3.0), scans=3)) is None
