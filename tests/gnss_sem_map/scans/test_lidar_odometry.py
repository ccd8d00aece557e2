"""Scan matching against exact motion: what it finds, and how sure it is."""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
import scenes
from exact_street import SWEEPS, errors, street, with_scan
from numpy.typing import NDArray
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from factor_graphs.accuracy import anees_band, nees
from factor_graphs.relative_poses import RelativePoses
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.scans import lidar_odometry
from gnss_sem_map.scans.lidar_odometry import ScanMatches, ScanMatchingSettings, match_scans
from gnss_sem_map.sensor_log import Points, Scan, SensorLog

Array = NDArray[np.float64]


@cache
def matched() -> ScanMatches:
    log, truth = street()
    return match_scans(log, truth)


def nudged(truth: Trajectory, metres: Array) -> Trajectory:
    """A first guess that is wrong by so much, growing evenly over time."""
    T = truth.T_map_imu.copy()
    T[:, :3, 3] += (truth.stamps - truth.start)[:, None] * metres
    return Trajectory(truth.stamps, T)


def test_relative_poses_are_those_of_the_exact_motion() -> None:
    off = errors(matched().relative_poses, street()[1])
    assert np.abs(off[:, :3]).max() < 1e-3
    assert np.linalg.norm(off[:, 3:], axis=1).max() < 0.015


def test_every_sweep_is_bound_to_the_one_before_and_to_the_last_anchor_and_anchors_to_three(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert matched().counts["scans matched"] == SWEEPS
    assert matched().counts["local maps"] == 1
    assert pairs_of(matched()) == {
        *((k - 1, k) for k in range(1, SWEEPS)), *((0, k) for k in range(1, 11)), *((10, k) for k in range(11, SWEEPS))
    }  # fmt: skip
    monkeypatch.setattr(lidar_odometry, "ANCHOR_SCANS", 2)
    assert pairs_of(match_scans(*street())) == {
        *((k - 1, k) for k in range(1, SWEEPS)),
        *((k - back, k) for k in range(0, SWEEPS, 2) for back in (2, 4, 6) if k >= back),
    }


def pairs_of(found: ScanMatches) -> set[tuple[int, int]]:
    """The numbers of the sweeps that are bound; raises AssertionError if two are bound twice."""
    pairs = np.round(found.relative_poses.stamps / scenes.SWEEP_S - 0.5).astype(int).tolist()
    assert len(pairs) == len(set(map(tuple, pairs)))
    return {(earlier, later) for earlier, later in pairs}


def whole_sweep_errors(seed: int, settings: ScanMatchingSettings) -> SensorLog:
    """The street, where every sweep lies a little off as a whole: between two of them, by what the settings say."""
    log, _ = street()
    rng = np.random.default_rng(seed)

    def moved(points: Points) -> Points:
        turn, shift = (
            rng.normal(0, stddev / np.sqrt(2), 3)
            for stddev in (settings.rotation_stddev_rad, settings.translation_stddev_m)
        )
        xyz = points.xyz @ Rotation.from_rotvec(turn).as_matrix().T + shift
        return replace(points, xyz=xyz.astype(np.float32))

    points = {scan.number: moved(scan.read()) for scan in log.scans}
    return replace(log, scans=tuple(replace(s, read=partial(points.get, s.number)) for s in log.scans))


@cache
def of_shifted_sweeps() -> list[RelativePoses]:
    """What is found in six drives with errors of whole sweeps, with every other sweep an anchor."""
    settings = ScanMatchingSettings()
    with patch.object(lidar_odometry, "ANCHOR_SCANS", 2):
        return [
            match_scans(whole_sweep_errors(seed, settings), street()[1]).relative_poses for seed in range(6)
        ]


@pytest.mark.parametrize(("step", "apart"), [(1, 2), (6, 8)])
def test_covariances_are_honest(step: int, apart: int) -> None:
    """Only pairs that share no sweep: they are independent, and their mean NEES has known bounds."""
    squares = []
    for pairs in of_shifted_sweeps():
        first, second = np.round(pairs.stamps / scenes.SWEEP_S - 0.5).astype(int).T
        rows = (second - first == step) & (first % apart == 0)
        squares.append(nees(errors(pairs, street()[1]), pairs.covariances)[rows])
    assert [len(of_drive) for of_drive in squares] == [SWEEPS // apart] * 6
    low, high = anees_band(6, 6 * SWEEPS // apart)
    assert low < np.mean(squares) < high


def test_covariances_are_small_in_a_street_and_not_below_the_floor() -> None:
    stddevs = np.sqrt(np.einsum("kii->ki", matched().relative_poses.covariances))
    floor = ScanMatchingSettings()
    assert floor.translation_stddev_m <= stddevs[:, 3:].min() <= stddevs[:, 3:].max() < 0.05
    assert floor.rotation_stddev_rad <= stddevs[:, :3].min() <= stddevs[:, :3].max() < 2e-3


def test_a_wrong_first_guess_is_corrected() -> None:
    log, truth = street()
    wrong = nudged(truth, np.array([0.6, -0.5, 0.3]))
    off = errors(match_scans(log, wrong).relative_poses, truth)
    started = errors(replace_poses(matched().relative_poses, wrong), truth)
    assert np.linalg.norm(off[:, 3:], axis=1).max() < 0.05
    assert np.linalg.norm(started[:, 3:], axis=1).max() > 0.7


def replace_poses(pairs: RelativePoses, trajectory: Trajectory) -> RelativePoses:
    T = np.linalg.inv(trajectory.at(pairs.stamps[:, 0])) @ trajectory.at(pairs.stamps[:, 1])
    return RelativePoses(pairs.stamps, T, pairs.covariances)


def test_where_the_trajectory_begins_and_which_way_it_looks_does_not_matter() -> None:
    log, truth = street()
    T_other_map = np.eye(4)
    T_other_map[:3, :3] = Rotation.from_euler("z", 1.1).as_matrix()
    T_other_map[:3, 3] = 120.0, -340.0, 15.0
    moved = Trajectory(truth.stamps, T_other_map @ truth.T_map_imu, truth.velocities @ T_other_map[:3, :3].T)
    found = match_scans(log, moved).relative_poses
    np.testing.assert_allclose(found.T_imu_imu, matched().relative_poses.T_imu_imu, atol=1e-3)


def test_the_same_drive_gives_the_same_bits() -> None:
    log, truth = street()
    again = match_scans(log, truth).relative_poses
    np.testing.assert_array_equal(again.T_imu_imu, matched().relative_poses.T_imu_imu)
    np.testing.assert_array_equal(again.covariances, matched().relative_poses.covariances)


def test_moving_vehicles_hardly_matter() -> None:
    cars: tuple[scenes.Box, ...] = (
        ((8.0, -1.2, 0.3), (12.5, 0.8, 2.2), (8.0, 0, 0)),
        ((30.0, 2.2, 0.2), (34.0, 4.0, 1.8), (-11.0, 0, 0)),
    )
    log, truth = street(cars)
    off = errors(match_scans(log, truth).relative_poses, truth)
    assert np.linalg.norm(off[:, 3:], axis=1).max() < 0.03


def test_slow_traffic_all_around_does_not_drag_the_sweep_along() -> None:
    """Cars that go a third of a metre per sweep still lie beside where they were, and would be taken for walls."""
    cars: tuple[scenes.Box, ...] = (
        ((8.0, -1.2, 0.3), (12.5, 1.2, 3.2), (3.0, 0, 0)),
        ((14.0, 2.2, 0.2), (18.0, 4.0, 1.8), (3.0, 0, 0)),
        ((8.0, -4.2, 0.2), (12.0, -2.0, 1.8), (3.0, 0, 0)),
    )
    log, truth = street(cars)
    off = errors(match_scans(log, truth).relative_poses, truth)
    assert np.linalg.norm(off[:, 3:], axis=1).max() < 0.01


@cache
def tunnel() -> tuple[SensorLog, Trajectory]:
    motion = scenes.drive(SWEEPS * 0.1)
    points = {k: scenes.sweep(motion, scenes.tunnel(), k) for k in range(SWEEPS)}
    truth = scenes.trajectory_of(motion, SWEEPS)
    return scenes.log_of(points, truth), truth


def test_a_tunnel_leaves_the_way_ahead_to_the_first_guess() -> None:
    log, truth = tunnel()
    guess = nudged(truth, np.array([0.8, 0.4, 0.0]))
    found = match_scans(log, guess)
    assert found.counts["scans with an open direction"] == SWEEPS - 1
    R = truth.at(found.relative_poses.stamps[:, 1])[:, :3, :3]  # the car swerves, the tunnel does not
    ahead, across, up = along_map_axes(found.relative_poses.covariances, R).T
    assert ahead.min() > 5.0
    assert max(across.max(), up.max()) < 0.05
    off = np.einsum("kij,kj->ki", R, errors(found.relative_poses, truth)[:, 3:])
    wrong = np.einsum("kij,kj->ki", R, errors(replace_poses(found.relative_poses, guess), truth)[:, 3:])
    assert np.abs(off[:, 1:]).max() < 0.02
    assert np.abs(wrong[:, 1]).max() > 0.03
    np.testing.assert_allclose(off[:, 0], wrong[:, 0], atol=0.01)


def along_map_axes(covariances: Array, R: Array) -> Array:
    """Standard deviations of the translations along east, north and up, (k, 3)."""
    return np.sqrt(np.einsum("kij,kjl,kil->ki", R, covariances[:, 3:, 3:], R))


def test_across_a_tunnel_only_neighbours_are_bound() -> None:
    log, truth = tunnel()
    steps = np.diff(match_scans(log, truth).relative_poses.stamps, axis=1)
    assert steps.max() < 1.5 * scenes.SWEEP_S


def test_an_open_field_holds_height_and_level_only() -> None:
    motion = scenes.drive(0.5)
    log = scenes.log_of(
        {k: scenes.sweep(motion, [], k) for k in range(5)}, truth := scenes.trajectory_of(motion, 5)
    )
    found = match_scans(log, truth).relative_poses
    stddevs = np.sqrt(np.einsum("kii->ki", found.covariances))
    assert stddevs[:, 3:5].min() > 5.0
    assert stddevs[:, 5].max() < 0.5
    assert stddevs[:, :2].max() < 0.05 < 0.1 < stddevs[:, 2].min()


def test_a_standing_vehicle_stands() -> None:
    log, truth = street()
    still = Trajectory(truth.stamps, np.tile(truth.T_map_imu[:1], (len(truth), 1, 1)))
    points = log.scans[3].read()
    same = Points(points.xyz, points.intensity, None)
    scans = tuple(replace(scan, read=lambda: same) for scan in log.scans)
    found = match_scans(replace(log, scans=scans), still)
    assert found.counts["scans matched"] == SWEEPS
    np.testing.assert_allclose(
        found.relative_poses.T_imu_imu, np.tile(np.eye(4), (len(found.relative_poses), 1, 1)), atol=1e-3
    )


def test_a_jump_in_stamps_begins_a_new_local_map() -> None:
    log, truth = street()
    shift = np.where(truth.stamps > 0.8, 5.0, 0.0)
    later = Trajectory(truth.stamps + shift, truth.T_map_imu)

    def moved(number: int) -> Points:
        points = log.scans[number].read()
        assert points.stamps is not None
        return Points(points.xyz, points.intensity, points.stamps + 5.0)

    scans = tuple(
        scan
        if scan.number < 8
        else replace(scan, stamp=scan.stamp + 5.0, read=lambda k=scan.number: moved(k))
        for scan in log.scans
    )
    found = match_scans(replace(log, scans=scans), later)
    assert found.counts["local maps"] == 2
    assert np.diff(found.relative_poses.stamps, axis=1).max() < 1.5


@pytest.mark.parametrize("setting", [{"voxel_size_m": 0}, {"section_scans": 0}, {"voxel_sise_m": 1}])
def test_settings_that_make_no_sense_are_refused(setting: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        ScanMatchingSettings.model_validate(setting)


@pytest.mark.slow
def test_two_halves_of_the_sweeps_of_a_real_drive_agree_within_the_covariances(real_data: Path) -> None:
    """Half their difference is the error of the whole sweep, as far as they are independent of each other."""
    from gnss_sem_map.datasets import open_drive

    log = open_drive(real_data / "kitti_raw/2011_09_26/2011_09_26_drive_0005_sync")
    assert log.reference is not None
    whole, one, other = (
        match_scans(some, log.reference).relative_poses for some in (log, half_of(log, 0), half_of(log, 1))
    )
    np.testing.assert_array_equal(one.stamps, whole.stamps)
    np.testing.assert_array_equal(other.stamps, whole.stamps)
    off = np.linalg.inv(one.T_imu_imu) @ other.T_imu_imu
    half = np.column_stack([Rotation.from_matrix(off[:, :3, :3]).as_rotvec(), off[:, :3, 3]]) / 2
    squares = np.einsum("ki,kij,kj->k", half, np.linalg.inv(whole.covariances), half)
    over_a_second = np.diff(whole.stamps, axis=1)[:, 0] > 0.5
    assert 0.5 < squares[~over_a_second].mean() < 6
    assert 0.5 < squares[over_a_second].mean() < 6


def half_of(log: SensorLog, which: int) -> SensorLog:
    """The drive with every other 2000 points of its sweeps, as the file has them: other beams, other places."""

    def read(scan: Scan) -> Points:
        points = scan.read()
        return points[np.arange(len(points.xyz)) // 2000 % 2 == which]

    return replace(log, scans=tuple(replace(s, read=partial(read, s)) for s in log.scans))


@pytest.mark.parametrize(
    "section_scans", [pytest.param(5, marks=pytest.mark.slow), 8, pytest.param(16, marks=pytest.mark.slow)]
)
def test_sections_bind_every_sweep_as_closely_as_the_whole_drive(
    section_scans: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each pair of sweeps is bound once, whichever sections they are in."""
    monkeypatch.setattr(lidar_odometry, "WARM_UP_SCANS", 11)
    monkeypatch.setattr(lidar_odometry, "ANCHOR_SCANS", 3)
    log, truth = street()
    whole = match_scans(log, truth)
    found = match_scans(log, truth, ScanMatchingSettings(section_scans=section_scans))
    assert pairs_of(found) == pairs_of(whole)
    assert found.counts["scans matched"] == whole.counts["scans matched"]
    off, of_whole = (errors(one.relative_poses, truth) for one in (found, whole))
    assert np.abs(off).max() < 1.5 * np.abs(of_whole).max()


def test_a_sweep_before_a_section_is_reported_once() -> None:
    log, truth = street()
    few = Points(np.ones((3, 3), np.float32), np.zeros(3, np.float32), None)
    found = match_scans(with_scan(log, 7, few), truth, ScanMatchingSettings(section_scans=8))
    assert [skip.where for skip in found.skips] == ["frame 7"]
    assert found.counts["scans not matched"] == 1
    assert found.counts["scans matched"] == SWEEPS - 1


def test_a_skipped_sweep_names_its_lidar_where_there_are_several() -> None:
    log, truth = street()
    few = Points(np.ones((3, 3), np.float32), np.zeros(3, np.float32), None)
    found = match_scans(replace(with_scan(log, 7, few), lidar="roof"), truth)
    assert [skip.where for skip in found.skips] == ["frame 7 of roof"]
