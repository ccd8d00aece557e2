"""Laps come back, and another day shows the same town but for the changes that its truth names."""

import csv
import json
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from factor_graphs.geodesy import LocalFrame
from factor_graphs.simulation import follow
from gnss_sem_map.datasets import kitti_raw
from gnss_sem_map.simulation import Change, Simulation, World, changes_between, prepare, simulate
from gnss_sem_map.simulation.oxts import Gnss, _renewed, oxts_rows
from gnss_sem_map.simulation.raycast import Scene, cast_ray
from gnss_sem_map.simulation.surfaces import Surface
from gnss_sem_map.simulation.town import Town
from gnss_sem_map.simulation.traffic import lap_length

Floats = npt.NDArray[np.float64]
FRAME = LocalFrame(49.0, 8.4, 115.0)
LANE_M = 3.3


@pytest.fixture(scope="module", params=[0, pytest.param(1, marks=pytest.mark.slow)])
def days(request: pytest.FixtureRequest) -> list[Simulation]:
    """Sessions 0 and 1 of a seed."""
    return [prepare(6.0, request.param, session=session) for session in (0, 1)]


def still(simulation: Simulation) -> tuple[Town, Scene]:
    """The town of a session without its traffic."""
    town = simulation.world.town
    return town, World(town, simulation.world.ego, []).scene(0.0, 0.0)


def things_inside(town: Town, scene: Scene, change: Change) -> list[str]:
    """Names of the things that rays through the box of a change meet in it, from all sides; leaves may hang into it."""
    c, s = np.cos(change.yaw), np.sin(change.yaw)
    R, rng, names = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), np.random.default_rng(0), []
    for _ in range(300):
        end, start = rng.uniform(-0.45, 0.45, 3), rng.uniform(-0.45, 0.45, 3)
        start[rng.integers(3)] = rng.choice([-0.5, 0.5])
        start[2] = abs(start[2])  # not from the ground
        o, d = R @ (start * change.size) + change.centre, R @ ((end - start) * change.size)
        t, thing, shape = cast_ray(scene, 1.0, False, 0.5, *(o - 1e-6 * d), *d)
        if t < 1.0 and thing >= 0 and int(scene.shapes[shape, 12]) not in (Surface.LEAVES, Surface.BARK):
            names.append(town.models[town.things[thing].model].name)
    return names


@pytest.mark.parametrize(
    "seed", [0, pytest.param(1, marks=pytest.mark.slow), pytest.param(2, marks=pytest.mark.slow)]
)
def test_a_lap_returns_to_the_same_lane(seed: int) -> None:
    drive = prepare(None, seed, laps=2)
    ego, length = drive.world.ego, lap_length(drive.world.town)
    way = ego.way(drive.stamps)
    assert way[-1] == pytest.approx(2 * length, abs=2.0)
    again = np.interp(way + length, ego.way(drive.oxts_stamps), drive.oxts_stamps)
    twice = way + length < way[-1]
    first, second = ego.poses(drive.stamps[twice]), ego.poses(again[twice])
    apart = np.linalg.norm(first[:, :3, 3] - second[:, :3, 3], axis=1)
    assert 0.05 < np.median(apart) < apart.max() < 0.5 * LANE_M
    assert (first[:, :2, 0] * second[:, :2, 0]).sum(axis=1).min() > 0.9


def test_errors_of_two_passes_are_independent_and_as_large_as_ever() -> None:
    rng, laps = np.random.default_rng(0), np.arange(0.0, 3.0, 0.05)
    error = _renewed(laps, lambda: np.tile(rng.standard_normal(4000), (len(laps), 1)))
    np.testing.assert_allclose(error.std(axis=1), 1.0, atol=0.05)
    between_passes = (error[:-20] * error[20:]).mean(axis=1)
    assert np.abs(between_passes).max() < 0.06
    assert (error[:-1] * error[1:]).mean(axis=1).min() > 0.95  # joined smoothly


@pytest.mark.parametrize(
    ("gnss", "claimed", "stddevs"), [("unit", 0.35, [0.35, 0.35, 0.5]), ("consumer", 1.0, [1.0, 1.0, 1.0])]
)
def test_positions_are_as_wrong_as_they_claim(gnss: Gnss, claimed: float, stddevs: list[float]) -> None:
    motion = follow(np.arange(0.0, 60.0, 6.0)[:, None] * [1.0, 0.0, 0.0], [0.0, 4.0], [5.0, 5.0])
    stamps, rng = np.arange(0.0, 4.0, 0.5), np.random.default_rng(0)
    errors = []
    for _ in range(200):
        rows = oxts_rows(motion, stamps, FRAME, rng, gnss)
        errors.append(FRAME.to_map(*rows[:, :3].T) - motion.poses(stamps)[:, :3, 3])
        np.testing.assert_array_equal(rows[:, 23], claimed)
    assert np.std(errors, axis=(0, 1)) == pytest.approx(stddevs, rel=0.1)


@pytest.mark.slow
def test_what_the_truth_says_is_there_on_its_day_and_not_on_the_other_one(days: list[Simulation]) -> None:
    scenes = [still(day) for day in days]
    near = [
        c
        for c in days[1].changes
        if np.linalg.norm(c.centre[:2] - days[1].world.ego.poses([0.0])[0, :2, 3]) < 120
    ]
    assert {c.cause for c in near} == {"parked", "built"}
    assert {c.appeared for c in near} == {True, False}
    for change in near:
        there, gone = (scenes[1], scenes[0]) if change.appeared else scenes
        with_it, without = set(things_inside(*there, change)), set(things_inside(*gone, change))
        assert with_it - without == {change.name}  # a sign may stand at a lamp post
        assert not without - with_it


def test_a_facade_comes_forward_and_all_kinds_of_things_change(days: list[Simulation]) -> None:
    changes = days[1].changes
    for name in ("oriel", "container", "sign"):
        assert any(change.appeared and change.name == name for change in changes), name
    assert {"sign", "wall"} <= {change.name for change in changes if not change.appeared}
    assert min(change.size[1] for change in changes if change.name == "oriel") > 0.5


def test_rays_that_meet_no_change_meet_the_same_town(days: list[Simulation]) -> None:
    (town, before), (_, after) = (still(day) for day in days)
    base = len(town.things)
    changed = {
        k for k, (a, b) in enumerate(zip(town.things, days[1].world.town.things, strict=False)) if a != b
    }
    assert 0 < len(changed) < 0.2 * base
    rng, same, other = np.random.default_rng(1), 0, 0
    origins = days[0].world.ego.poses(np.arange(0.0, 6.0, 1.0))[:, :3, 3] + [0.0, 0.0, 1.0]
    for origin in origins:
        for azimuth, slope in zip(rng.uniform(0, 2 * np.pi, 500), rng.uniform(-0.3, 0.3, 500), strict=True):
            ray = (*origin, np.cos(azimuth), np.sin(azimuth), slope)
            first, second = (
                cast_ray(before, 100.0, False, 0.5, *ray),
                cast_ray(after, 100.0, False, 0.5, *ray),
            )
            if first == second:
                same += 1
            else:
                other += 1
                assert first[1] in changed or second[1] >= base
    assert same > 2 * other > 0


def test_the_same_car_creeps_every_day_and_bays_stay(days: list[Simulation]) -> None:
    first, second = ([m for m in day.world.movers if m.name == "creeps"] for day in days)
    for one, other in zip(first, second, strict=True):
        stamp = [days[0].stamps[0]]
        np.testing.assert_allclose(one.motion.poses(stamp), other.motion.poses(stamp), atol=1e-9)


def test_another_day_has_other_traffic_errors_and_noise(days: list[Simulation]) -> None:
    zero, one = days
    assert [m.name for m in zero.world.movers] != [m.name for m in one.world.movers]
    stamps = zero.stamps
    apart = np.linalg.norm(
        zero.world.ego.poses(stamps)[:, :3, 3] - one.world.ego.poses(stamps)[:, :3, 3], axis=1
    )
    assert 0.01 < apart.max() < 0.5 * LANE_M
    errors = [
        day.frame.to_map(*day.oxts[day.sync, :3].T)
        - day.to_map(day.world.ego.poses(day.oxts_stamps[day.sync])[:, :3, 3])
        for day in days
    ]
    assert np.linalg.norm(errors[0].mean(axis=0) - errors[1].mean(axis=0)) > 0.1
    assert zero.day != one.day
    assert one.morning_ns - zero.morning_ns == 86_400 * 10**9


@pytest.mark.slow
def test_changes_between_two_later_days_are_those_of_the_way_back_reversed() -> None:
    there, back = changes_between(0, 1, 2), changes_between(0, 2, 1)
    places = [
        sorted((*c.centre, not c.appeared) for c in there),
        sorted((*c.centre, c.appeared) for c in back),
    ]
    assert places[0] == places[1] != []
    assert changes_between(0, 1, 1) == []


def test_two_days_share_one_earth(town_drive: Path, simulation: Simulation, tmp_path: Path) -> None:
    drive = simulate(tmp_path, 1.2, 0, lidar=simulation.lidar, camera=simulation.camera, workers=2, session=1)
    assert drive.parent.name == drive.name[:10] == "2026_04_19"
    log, before = kitti_raw.read(drive), kitti_raw.read(town_drive)
    assert log.skips == ()
    assert log.epoch_ns - before.epoch_ns == pytest.approx(86_400e9, abs=1e9)
    assert log.frame is not None
    assert before.frame is not None
    T = log.frame.pose_of(before.frame)
    truth = json.loads((drive / "truth" / "changes.json").read_text())
    assert (truth["session"], truth["since"]) == (1, 0)
    gone = {
        (c["x_m"], c["y_m"]) for c in truth["changes"] if c["change"] == "vanished" and c["cause"] == "parked"
    }
    old, new = (parked(folder) for folder in (town_drive, drive))
    moved = old @ T[:3, :3].T + T[:3, 3]
    to_new = np.linalg.norm(moved[:, None] - new[None], axis=-1).min(axis=1)
    to_gone = np.linalg.norm(moved[:, None, :2] - np.array(sorted(gone))[None], axis=-1).min(axis=1)
    assert np.all((to_new < 1e-3) ^ (to_gone < 0.05))
    assert min((to_new < 1e-3).sum(), (to_gone < 0.05).sum()) > 3


def parked(drive: Path) -> Floats:
    """Parked vehicles of a drive's truth within 100 m of its start, (k, 3) m in its map."""
    with (drive / "truth" / "vehicles.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["moving"] == "0"]
    first = [row for row in rows if row["stamp_s"] == rows[0]["stamp_s"]]
    places = np.array([[float(row[axis]) for axis in ("x_m", "y_m", "z_m")] for row in first])
    return places[np.hypot(*places[:, :2].T) < 100.0]
