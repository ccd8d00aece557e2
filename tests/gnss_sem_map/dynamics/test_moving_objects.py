"""Moving objects in streets of boxes, ray-cast exactly: every case has one right answer."""

import numpy as np
import pytest

from gnss_sem_map.dynamics.image_rows import Rows
from gnss_sem_map.dynamics.motion_state import MotionSettings
from gnss_sem_map.dynamics.moving_objects import decide, moved_points
from gnss_sem_map.dynamics.observation import observe
from gnss_sem_map.dynamics.visibility import KeyframeScans
from gnss_sem_map.errors import DataError
from gnss_sem_map.refinement.vehicles import Motion

LIDAR_HEIGHT_M, SCAN_S = 1.7, 0.1
CAR, PERSON = (4.2, 1.8, 1.5), (0.3, 0.5, 1.7)
AZIMUTHS, ELEVATIONS = np.radians(np.arange(-180, 180, 0.4)), np.radians(np.arange(-24.8, 2.0, 0.42))
RAYS = np.stack(
    [
        np.outer(np.cos(ELEVATIONS), np.cos(AZIMUTHS)).ravel(),
        np.outer(np.cos(ELEVATIONS), np.sin(AZIMUTHS)).ravel(),
        np.outer(np.sin(ELEVATIONS), np.ones_like(AZIMUTHS)).ravel(),
    ],
    axis=1,
)
ROWS = Rows.of([20 * RAYS])


def cast(origin, boxes):
    """Points (n, 3) where the rays first meet flat ground or a box (low, high), and which: 0 ground, 1 the first."""
    with np.errstate(divide="ignore"):
        inverse = 1 / np.where(RAYS == 0, 1e-12, RAYS)
    best = np.where(RAYS[:, 2] < 0, -origin[2] * inverse[:, 2], np.inf)
    what = np.zeros(len(RAYS), int)
    for number, (low, high) in enumerate(boxes, start=1):
        a, b = (low - origin) * inverse, (high - origin) * inverse
        near, far = np.minimum(a, b).max(1), np.maximum(a, b).min(1)
        hit = (near < far) & (near > 0) & (near < best)
        best[hit], what[hit] = near[hit], number
    seen = best < 80
    return origin + RAYS[seen] * best[seen, None], what[seen]


def box_at(x, y, size, floor=0.2):
    return np.array([x - size[0] / 2, y - size[1] / 2, floor]), np.array(
        [x + size[0] / 2, y + size[1] / 2, size[2]]
    )


def car_at(x, y):
    return box_at(x, y, CAR)


def drive(cars, scans=40, ego_speed=6.0, view_deg=180.0, drift_m=0.0, settings=None, size=CAR):
    """Drive along x past facades and cars (functions of time -> x, y or None); the points of each car that went.

    Returns, for each car, the share of its points in all scans that was removed, that share of everything else, and
    the objects. A camera sees `view_deg` ahead and calls exactly the cars vehicles.
    """
    settings, scans_seen = settings or MotionSettings(), []
    facades = [(np.array([-40.0, y - 0.2, 0.0]), np.array([110.0, y + 0.2, 9.0])) for y in (-11.0, 12.0)]
    kept = []
    for scan in range(scans):
        t = scan * SCAN_S
        places = [car(t) for car in cars]
        boxes = facades + [box_at(*(place or (1e4, 0)), size) for place in places]
        origin = np.array([ego_speed * t, 0.0, LIDAR_HEIGHT_M])
        p_map, what = cast(origin, boxes)
        offset = p_map - origin
        known = abs(np.degrees(np.arctan2(offset[:, 1], offset[:, 0]))) <= view_deg / 2
        T_map_lidar = np.eye(4)
        T_map_lidar[:3, 3] = origin + drift_m * np.array([np.sin(t), np.cos(1.7 * t), 0.3 * np.sin(2 * t)])
        p_map = p_map + T_map_lidar[:3, 3] - origin
        scans_seen.append(observe(scan, t, p_map, T_map_lidar, (what > 2) & known, known, settings, ROWS))
        kept.append(what)
    moving, objects = decided(scans_seen, settings)
    removed, total = np.zeros(len(cars) + 3), np.zeros(len(cars) + 3)
    for scan, what in enumerate(kept):
        total += np.bincount(what, minlength=len(total))
        removed += np.bincount(what[moving[scan]], minlength=len(total))
    share = removed / np.maximum(total, 1)
    return share[3:], removed[:3].sum() / total[:3].sum(), objects


def decided(seen, settings=None, first=0, last=None, window=1000):
    """The points of the scans from `first` to `last` that moved, by scan number, and the objects.

    `seen` are the results of `observe` of a whole drive; up to `window` scans before and after are evidence.
    """
    settings, last = settings or MotionSettings(), len(seen) if last is None else last
    before = [observation.seen for observation, _ in seen[max(first - window, 0) : first]]
    observations = [observation for observation, _ in seen[first : last + window]]
    images = KeyframeScans.of(before) if before else None
    decision = decide(observations, last - first, images, settings)
    moving = {
        observation.number: near.indices[moved_points(near, moved, stands, settings.grow_m)]
        for (observation, near), moved, stands in zip(
            seen[first:last], decision.moved, decision.stands, strict=True
        )
    }
    return moving, decision.objects


def parked(x, y):
    return lambda t: (x, y)


def going(x, y, speed, start=0.0, stop=np.inf):
    return lambda t: (x + speed * (np.clip(t, start, stop) - start), y)


ROW = [parked(x, 4.5) for x in (8, 13.5, 19, 24.5, 30)]


def test_a_row_of_parked_cars_stays_to_the_last_point():
    share, others, objects = drive(ROW)
    np.testing.assert_array_equal(share, 0)
    assert others == 0
    assert {o.motion for o in objects} <= {Motion.PARKED, Motion.UNKNOWN}
    assert sum(o.motion == Motion.PARKED for o in objects) >= len(ROW)


@pytest.mark.parametrize(
    ("name", "mover"),
    [
        ("ahead, as fast as the ego vehicle", going(15, 0, 6.0)),
        pytest.param("ahead, slow", going(18, -3.0, 1.5), marks=pytest.mark.slow),
        pytest.param("oncoming", going(60, -3.5, -9.0), marks=pytest.mark.slow),
        ("waits, then leaves", going(14, -3.5, 5.0, start=2.0)),
        pytest.param("comes, then waits", going(40, -3.5, -6.0, stop=2.0), marks=pytest.mark.slow),
    ],
)
def test_whatever_moves_between_parked_cars_goes_and_they_stay(name, mover):
    share, others, objects = drive([*ROW, mover])
    assert share[-1] > 0.98, name
    np.testing.assert_array_equal(share[:-1], 0, err_msg=name)
    assert others < 2e-4, name
    mover_seen = max(objects, key=lambda o: o.probability)
    assert mover_seen.motion in (Motion.MOVING, Motion.STOPPED_AND_LEFT)
    assert mover_seen.reason


TANKER = (15.0, 2.5, 3.5)


def in_queue(number, gap_m=2.5, length=TANKER[0]):
    """The vehicle of this place in a queue that goes, waits and goes again: each fills the place of the one before."""
    goes, late = [(0.5, 2.5), (4.0, 6.0)], 1.1 * number
    x = -number * (length + gap_m)
    return lambda t: (x + sum(1.8 * (np.clip(t, a + late, b + late) - a - late) for a, b in goes), -3.4)


@pytest.mark.slow
@pytest.mark.parametrize(("size", "passes_us"), [(CAR, [0, 1, 2]), (TANKER, [1])])
def test_a_queue_beside_goes_though_its_places_are_never_free_for_long(size, passes_us):
    queue = [in_queue(k, length=size[0]) for k in (-1, 0, 1)]
    share, others, _ = drive([parked(-8, 5.5), parked(8, 5.5), *queue], 80, 0.4, view_deg=0.0, size=size)
    np.testing.assert_array_equal(share[:2], 0)
    assert (share[2:][passes_us] > 0.95).all(), share
    assert others < 3e-3


@pytest.mark.slow
def test_an_overtaken_car_is_followed_around_after_the_camera_lost_it():
    share, others, _ = drive([*ROW, going(10, -3.5, 2.0)], view_deg=80.0)
    assert share[-1] > 0.95
    np.testing.assert_array_equal(share[:-1], 0)
    assert others < 2e-4


def test_a_car_that_no_camera_ever_shows_goes_when_it_moves_and_stays_when_it_is_parked():
    share, others, _ = drive([going(-12, -3.5, 5.0), parked(-8, 4.5)], view_deg=60.0)
    assert share[0] > 0.95
    assert share[1] == 0
    assert others < 2e-4


@pytest.mark.slow
def test_an_overtaking_car_is_followed_back_to_where_the_camera_had_not_seen_it():
    share, others, _ = drive([*ROW, going(-20, -3.5, 14.0)], view_deg=80.0)
    assert share[-1] > 0.95
    np.testing.assert_array_equal(share[:-1], 0)
    assert others < 2e-4


@pytest.mark.slow
@pytest.mark.parametrize("lengths", [0.3, 0.6])
def test_a_car_that_creeps_a_third_of_its_length_goes(lengths):
    scans = 60
    creeping = going(14, -3.5, lengths * CAR[0] / (scans * SCAN_S))
    share, others, _ = drive([*ROW, creeping], scans=scans, ego_speed=0.0)
    assert share[-1] > 0.9
    np.testing.assert_array_equal(share[:-1], 0)
    assert others < 2e-4


@pytest.mark.slow
def test_a_car_that_creeps_past_parked_cars_takes_nothing_of_them_along():
    """It passes so closely that it is one segment with them for some scans."""
    creeping = going(16, 4.5 - CAR[1] - 0.3, 0.5)
    share, others, _ = drive([*ROW, creeping], scans=60, ego_speed=0.0)
    assert share[-1] > 0.5
    np.testing.assert_array_equal(share[:-1], 0)
    assert others == 0


@pytest.mark.slow
def test_a_car_that_comes_closer_for_a_metre_and_waits_goes():
    """It hides the place that it left, and nearly all scans hit it where it waits."""
    share, others, _ = drive([*ROW, going(-9, 0, 3.0, stop=0.4)], scans=70, ego_speed=0.0, view_deg=0.0)
    assert share[-1] > 0.9
    np.testing.assert_array_equal(share[:-1], 0)
    assert others < 2e-4


@pytest.mark.slow
def test_a_car_that_no_scan_is_near_is_told_by_those_farther_away():
    """It comes from 62 m to 47 m, where no scan is within `farthest_m`; the lowest ring is too far from the next."""
    share, others, _ = drive([going(62, -3.5, -5.0), parked(60, 4.5)], scans=30, ego_speed=0.0)
    assert share[0] > 0.75
    assert (share[1], others) == (0, 0)


@pytest.mark.parametrize("start", [2.0, pytest.param(2.9, marks=pytest.mark.slow)])
def test_what_no_image_shows_goes_however_short_the_drive(start):
    """Half a second of driving of its own is enough; and the row of parked cars stays."""
    share, others, _ = drive([*ROW, going(20, -3.5, -6.0, start=start)], scans=40, view_deg=0.0)
    assert share[-1] > 0.95
    np.testing.assert_array_equal(share[:-1], 0)
    assert others < 2e-4


@pytest.mark.slow
def test_poses_that_drift_by_decimetres_remove_no_parked_car():
    share, _, _ = drive([*ROW, going(60, -3.5, -9.0)], drift_m=0.15)
    assert share[:-1].max() < 0.02
    assert share[-1] > 0.95


@pytest.mark.slow
def test_a_car_that_stood_and_was_gone_when_seen_again_has_left():
    def gone(t):
        return (25, -3.5) if t < 1.0 else None

    share, _, objects = drive([*ROW, gone], scans=50)
    assert share[-1] > 0.98
    assert Motion.STOPPED_AND_LEFT in {o.motion for o in objects}
    np.testing.assert_array_equal(share[:-1], 0)


@pytest.mark.slow
def test_a_drive_that_stands_still_tells_movers_from_parked_cars():
    share, others, _ = drive([*ROW, going(-30, -3.5, 8.0)], ego_speed=0.0)
    assert share[-1] > 0.98
    np.testing.assert_array_equal(share[:-1], 0)
    assert others < 2e-4


@pytest.mark.parametrize("y", [-10.35, pytest.param(11.35, marks=pytest.mark.slow)])
def test_a_person_close_to_a_wall_goes_and_the_wall_stays_whole(y):
    """20 cm lie between them: no cluster tells them apart, and no image."""
    share, others, objects = drive([going(8, y, 1.4)], view_deg=0.0, size=PERSON)
    assert share[0] > 0.97
    assert others == 0
    assert any(one.motion == Motion.MOVING and one.track is not None for one in objects)


def test_a_person_who_stands_at_a_wall_stays():
    share, others, _ = drive([parked(12, 11.3)], view_deg=0.0, size=PERSON)
    assert share[0] == 0
    assert others == 0


def test_one_scan_alone_removes_nothing():
    share, others, objects = drive([*ROW, going(60, -3.5, -9.0)], scans=1)
    assert not share.any()
    assert others == 0
    assert {o.motion for o in objects} == {Motion.UNKNOWN}


def test_without_vehicles_nothing_is_removed():
    share, others, objects = drive([])
    assert len(share) == 0
    assert others == 0
    assert objects == ()


def test_only_points_of_the_mover_are_removed_and_no_scans_are_no_error():
    assert decided([]) == ({}, ())
    mover, scans_seen = {}, []
    for scan in range(20):
        p_map, what = cast(np.array([0.0, 0.0, LIDAR_HEIGHT_M]), [car_at(30 - scan, 3.0)])
        scans_seen.append(seen(scan, p_map, pose(0.0), what == 1))
        mover[scan] = what == 1
    moving, _ = decided(scans_seen)
    for scan, points in moving.items():
        assert mover[scan][points].all()
    assert sum(map(len, moving.values())) > 0


def seen(scan, p_map, T_map_lidar, is_object):
    """A scan of a camera that counts all around."""
    known = np.ones(len(p_map), bool)
    return observe(scan, scan * SCAN_S, p_map, T_map_lidar, is_object, known, MotionSettings(), ROWS)


def pose(x):
    T = np.eye(4)
    T[:3, 3] = x, 0, LIDAR_HEIGHT_M
    return T


def test_every_point_called_vehicle_is_no_error():
    scans_seen = []
    for scan in range(5):
        p_map, what = cast(np.array([scan, 0.0, LIDAR_HEIGHT_M]), [car_at(12, 3.0)])
        scans_seen.append(seen(scan, p_map, pose(scan), np.ones(len(what), bool)))
    moving, _ = decided(scans_seen)
    assert sum(map(len, moving.values())) == 0


@pytest.mark.slow
def test_deciding_chunk_by_chunk_says_nearly_what_deciding_a_whole_drive_says():
    """Chunks of twenty scans, with ten before and ten after each as evidence; every object is said once."""
    scans_seen = []
    for scan in range(50):
        t = scan * SCAN_S
        cars = [car_at(12, 4.5), car_at(20, 4.5), car_at(60 - 12 * t, -3.5)]
        p_map, what = cast(np.array([6 * t, 0.0, LIDAR_HEIGHT_M]), cars)
        scans_seen.append(seen(scan, p_map, pose(6 * t), what > 0))
    whole, _ = decided(scans_seen)
    parts = {}
    for first, last in ((0, 20), (20, 40), (40, 50)):
        moving, objects = decided(scans_seen, first=first, last=last, window=10)
        assert all(first * SCAN_S <= one.first_stamp < last * SCAN_S for one in objects)
        parts.update(moving)
    assert list(parts) == list(whole) == list(range(50))
    count = sum(map(len, whole.values()))
    differ = sum(len(np.setxor1d(whole[scan], parts[scan])) for scan in whole)
    assert count > 1000
    assert differ < 0.02 * count


def test_empty_scans_and_scans_out_of_order():
    empty = seen(7, np.empty((0, 3)), np.eye(4), np.zeros(0, bool))
    with pytest.raises(DataError, match="time order"):
        decided([empty, empty])
    moving, objects = decided([empty])
    assert moving[7].shape == (0,)
    assert objects == ()
