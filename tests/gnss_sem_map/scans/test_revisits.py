"""Two passes of one street, one of them with poses that are wrong by metres: where registration finds them."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import scenes
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from factor_graphs.condensing import CondensedDrive
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.errors import DataError
from gnss_sem_map.scans.local_maps import cloud_of, normals, sweeps_along
from gnss_sem_map.scans.revisits import Pass, RevisitSettings, candidates, pass_of, register_passes
from gnss_sem_map.sensor_log import Points, SensorLog

Array = NDArray[np.float64]
SWEEPS, SPEED, LATER_S = 30, 8.0, 1000.0
SETTINGS = RevisitSettings(every_m=5.0)
COME: tuple[scenes.Box, ...] = (
    scenes.still(6.0, 3.4, 0.0, 4.2, 1.8, 1.5),
    scenes.still(20.0, 3.5, 0.0, 4.0, 1.7, 1.6),
)
"""Cars that are parked there at the second pass."""


@cache
def passed(cars: tuple[scenes.Box, ...] = ()) -> tuple[SensorLog, Trajectory]:
    motion, boxes = scenes.drive(SWEEPS * 0.1), scenes.street(cars)
    points = {k: scenes.sweep(motion, boxes, k) for k in range(SWEEPS)}
    truth = scenes.trajectory_of(motion, SWEEPS)
    return scenes.log_of(points, truth), truth


def condensed(trajectory: Trajectory) -> CondensedDrive:
    """Anchors every half second."""
    stamps = trajectory.stamps[::50]
    return CondensedDrive(stamps, trajectory.at(stamps), (), np.zeros(3))


def pass_with(log: SensorLog, trajectory: Trajectory) -> Pass:
    return pass_of(sweeps_along(log, trajectory), trajectory, condensed(trajectory), SETTINGS)


def wrong_by(trajectory: Trajectory, metres: Array, degrees: float) -> Trajectory:
    G = np.eye(4)
    G[:3, :3] = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    G[:3, 3] = metres
    return trajectory.moved(G)


@pytest.mark.parametrize("metres", [[0.3, -0.2, 0.1], [1.5, 1.0, -0.8], [-2.0, 1.2, 0.5]])
def test_places_are_found_from_metres_away_though_cars_have_come(metres: list[float]) -> None:
    (first, truth), (second, _) = passed(), passed(COME)
    moved = wrong_by(truth, np.array(metres), 0.5)
    found = register_passes([pass_with(first, truth), pass_with(second, moved)], SETTINGS)
    assert len(found.pairs) >= 3
    assert found.refused == 0
    stamps = condensed(truth).stamps
    for n, (i, j) in enumerate(found.pairs.anchors.tolist()):
        expected = np.linalg.inv(truth.at(stamps[[i]])[0]) @ truth.at(stamps[[j]])[0]
        off = np.linalg.inv(expected) @ found.pairs.T[n]
        assert np.linalg.norm(off[:3, 3]) < 0.03
        assert np.degrees(Rotation.from_matrix(off[:3, :3]).magnitude()) < 0.15
        assert 0.004 < np.sqrt(np.linalg.eigvalsh(found.pairs.covariances[n][3:, 3:])).max() < 0.03
        # the surfaces lie as far apart as they were moved, across each: never farther than the whole
        before, after = found.distances(n, found.guesses[n]), found.distances(n, expected)
        assert 0.1 * np.linalg.norm(metres) < np.median(before) < np.linalg.norm(metres) + 0.5
        assert np.median(after) < 0.02


def test_a_place_is_registered_to_the_nearest_of_each_earlier_pass_and_to_no_neighbour_in_time() -> None:
    log, truth = passed()
    drive = pass_with(log, truth)
    assert list(candidates([drive], SETTINGS)) == []
    pairs = list(candidates([drive, drive, drive], SETTINGS))
    places = len(drive.anchors)
    assert [(a, b) for a, _, b, _ in pairs] == [(0, 1)] * places + [
        (a, 2) for _ in range(places) for a in (0, 1)
    ]
    assert all(i == j for _, i, _, j in pairs)
    one = RevisitSettings(every_m=5.0, passes=1)
    assert [(a, b) for a, _, b, _ in candidates([drive, drive, drive], one)] == [(0, 1)] * places + [
        (0, 2)
    ] * places


def test_a_drive_that_comes_again_is_paired_with_its_first_pass() -> None:
    log, truth = passed()
    drive = pass_with(log, truth)
    twice = replace(
        drive,
        anchors=np.concatenate([drive.anchors, drive.anchors + 100]),
        stamps=np.concatenate([drive.stamps, drive.stamps + LATER_S]),
        T_map_imu=np.concatenate([drive.T_map_imu] * 2),
    )
    places = len(drive.anchors)
    assert [(i, j) for _, i, _, j in candidates([twice], SETTINGS)] == [
        (k, k + places) for k in range(places)
    ]


def test_drives_of_other_streets_are_no_pairs() -> None:
    log, truth = passed()
    elsewhere = pass_with(log, wrong_by(truth, np.array([0.0, 50.0, 0.0]), 0.0))
    assert list(candidates([pass_with(log, truth), elsewhere], SETTINGS)) == []


def test_another_place_does_not_match() -> None:
    """Of an open field and a street, too few points find a surface."""
    log, truth = passed()
    motion = scenes.drive(SWEEPS * 0.1)
    field = [scenes.still(-500, 4, 0, 1000, 8, 3)]
    other = scenes.log_of({k: scenes.sweep(motion, field, k) for k in range(0, SWEEPS, 5)}, truth)
    found = register_passes(
        [pass_with(other, truth), pass_with(log, truth)], RevisitSettings(min_inlier_share=0.9)
    )
    assert len(found.pairs) == 0
    assert found.refused > 0


def test_sweeps_that_cannot_be_read_make_no_pair() -> None:
    log, truth = passed()

    def damaged() -> Points:
        raise DataError("torn")

    torn = replace(log, scans=tuple(replace(scan, read=damaged) for scan in log.scans))
    found = register_passes([pass_with(log, truth), pass_with(torn, truth)], SETTINGS)
    assert len(found.pairs) == 0
    assert found.refused == len(pass_with(torn, truth).anchors)


def test_normals_are_across_the_surface_and_keep_nothing_else() -> None:
    """A view of all three axes would hold a megabyte for each place of a long drive."""
    floor = np.random.default_rng(5).uniform(-9, 9, (600, 3)) * (1, 1, 0)
    across = normals(cloud_of(floor), 3)
    np.testing.assert_allclose(np.abs(across), np.tile([0.0, 0.0, 1.0], (200, 1)), atol=1e-6)
    assert across.base is None
