"""Sharpness: surfaces of known thickness, wrong trajectories, and the figures known for real data."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import scenes
from counted_reads import counted
from numpy.typing import NDArray

from factor_graphs.trajectory import Trajectory
from gnss_sem_map.errors import DataError
from gnss_sem_map.evaluation import map_sharpness
from gnss_sem_map.evaluation.map_sharpness import SharpnessSettings, SweepSample
from gnss_sem_map.scans.lidar_odometry import match_scans
from gnss_sem_map.sensor_log import Points, SensorLog

Array = NDArray[np.float64]
FEW = SharpnessSettings(min_scans=3, every_nth_point=1)


def plate(rng: np.random.Generator, normal: int, stddev: float, n: int = 4000) -> Array:
    """Points of a 4 m plate through the middle of cubes, blurred along one axis."""
    points = rng.uniform(-2, 2, (n, 3))
    points[:, normal] = 0.25 + rng.normal(0, stddev, n)
    return points


@pytest.mark.parametrize("stddev", [0.005, 0.02, 0.05])
def test_thickness_is_the_standard_deviation_across_the_surface(stddev: float) -> None:
    rng = np.random.default_rng(0)
    ground = map_sharpness.of_clouds([plate(rng, 2, stddev) for _ in range(12)], 10.0, FEW)
    assert ground.ground_thickness_m == pytest.approx(stddev, rel=0.03)
    assert ground.thickness_m == ground.ground_thickness_m
    assert np.isnan(ground.wall_thickness_m)
    blurred = map_sharpness.of_clouds([plate(rng, 2, stddev + 0.1) for _ in range(12)], 10.0, FEW)
    assert blurred.voxels_per_m > 1.5 * ground.voxels_per_m
    wall = map_sharpness.of_clouds([plate(rng, 1, stddev) for _ in range(12)], 10.0, FEW)
    assert wall.wall_thickness_m == pytest.approx(stddev, rel=0.03)


@pytest.mark.parametrize("slots", [1 << 14, 4])
def test_cubes_agree_with_numpy_in_a_large_table_and_in_one_that_grows(
    slots: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(map_sharpness, "SMALLEST_TABLE", slots)
    rng = np.random.default_rng(1)
    clouds = [rng.normal((70.0, -30.0, 4.0), 0.4, (3000, 3)) for _ in range(5)]
    found = map_sharpness.of_clouds(clouds, 10.0, FEW)
    thickness, entropies = [], []
    cubes = np.floor(np.concatenate(clouds) / 0.5).astype(int)
    frames = np.repeat(np.arange(5), 3000)
    for cube in np.unique(cubes, axis=0):
        inside = (cubes == cube).all(axis=1)
        if inside.sum() >= 30 and len(np.unique(frames[inside])) >= 3:
            covariance = np.cov(np.concatenate(clouds)[inside].T, bias=True)
            thickness.append(np.sqrt(np.linalg.eigvalsh(covariance)[0]))
            entropies.append(0.5 * np.linalg.slogdet(2 * np.pi * np.e * covariance)[1])
    assert found.cells == len(thickness)
    assert found.thickness_m == pytest.approx(np.median(thickness))
    assert found.mean_map_entropy == pytest.approx(np.mean(entropies))
    assert found.voxels == len(np.unique(np.floor(np.concatenate(clouds) / 0.2), axis=0))
    assert found.voxels_per_m == found.voxels / 10.0


def test_the_order_of_the_sweeps_does_not_matter() -> None:
    rng = np.random.default_rng(2)
    clouds = [rng.normal(0, 0.4, (1000, 3)) for _ in range(6)]
    forward, backward = (map_sharpness.of_clouds(c, 5.0, FEW) for c in (clouds, clouds[::-1]))
    assert forward.thickness_m == pytest.approx(backward.thickness_m, rel=1e-9)
    assert (forward.cells, forward.voxels) == (backward.cells, backward.voxels)


def test_what_few_sweeps_saw_does_not_count() -> None:
    rng = np.random.default_rng(3)
    found = map_sharpness.of_clouds([plate(rng, 2, 0.02) for _ in range(2)], 10.0, FEW)
    assert found.cells == 0
    assert found.voxels > 0
    assert np.isnan(found.thickness_m)
    assert found.as_dict()["thickness_m"] is None
    json.dumps(found.as_dict(), allow_nan=False)


@cache
def street() -> tuple[SensorLog, Trajectory]:
    motion = scenes.drive(1.6)
    points = {k: scenes.sweep(motion, scenes.street(), k) for k in range(16)}
    truth = scenes.trajectory_of(motion, 16)
    return scenes.log_of(points, truth), truth


def test_a_wrong_trajectory_blurs_the_map() -> None:
    log, truth = street()
    T = truth.T_map_imu.copy()
    T[:, :3, 3] += (
        np.random.default_rng(4).normal(0, 0.05, (len(T) // 10 + 1, 3)).repeat(10, axis=0)[: len(T)]
    )
    late = Trajectory(truth.stamps + 0.02, truth.T_map_imu)
    settings = SharpnessSettings(min_scans=5, every_nth_point=1)
    right, jittered, delayed = map_sharpness.of_drive(
        log, [truth, Trajectory(truth.stamps, T), late], settings
    )
    assert right.thickness_m < 0.02
    for wrong in (jittered, delayed):
        assert wrong.thickness_m > right.thickness_m
        assert wrong.wall_thickness_m > 1.2 * right.wall_thickness_m
        assert wrong.mean_map_entropy > right.mean_map_entropy
    assert right.scans == 16


def test_unreadable_sweeps_are_left_out() -> None:
    log, truth = street()

    def damaged() -> Points:
        raise DataError("no such file")

    scans = tuple(replace(s, read=damaged) if s.number == 3 else s for s in log.scans)
    (found,) = map_sharpness.of_drive(replace(log, scans=scans), [truth])
    assert found.scans == 15
    (nothing,) = map_sharpness.of_drive(replace(log, scans=()), [truth])
    assert (nothing.scans, nothing.voxels, nothing.as_dict()["voxels_per_m"]) == (0, 0, None)


def test_sweeps_that_were_read_for_odometry_are_not_read_again(tmp_path: Path) -> None:
    log, truth = street()
    listened, reads = counted(log)
    some = SharpnessSettings(max_scans=8, stretch_scans=4, min_scans=2)
    (expected,) = map_sharpness.of_drive(log, [truth], some)
    sample = SweepSample(listened, some, tmp_path)
    match_scans(sample.sweeps.listening(), truth)
    (found,) = map_sharpness.of_sample(sample, [truth])
    assert set(reads.values()) == {1}
    assert len(reads) == len(log.scans)
    assert found.as_dict() == expected.as_dict()


def test_a_long_drive_is_sampled_in_stretches() -> None:
    log, truth = street()
    short = SharpnessSettings(max_scans=8, stretch_scans=4, min_scans=2, every_nth_point=1)
    (found,) = map_sharpness.of_drive(log, [truth], short)
    (whole,) = map_sharpness.of_drive(log, [truth], SharpnessSettings(min_scans=2, every_nth_point=1))
    assert (found.scans, whole.scans) == (8, 16)
    assert 0 < found.cells < whole.cells


def test_scan_matching_reaches_the_known_sharpness_of_the_real_excerpt(real_data: Path) -> None:
    from gnss_sem_map.datasets import open_drive

    log = open_drive(real_data / "kitti_raw/2011_09_26/2011_09_26_drive_0005_sync")
    assert log.reference is not None
    found = match_scans(log, log.reference)
    assert not found.skips
    steps = found.relative_poses[np.diff(found.relative_poses.stamps, axis=1)[:, 0] < 0.15]
    T = [log.reference.at([steps.stamps[0, 0]])[0]]
    for T_imu_imu in steps.T_imu_imu:
        T.append(T[-1] @ T_imu_imu)
    odometry = Trajectory(np.append(steps.stamps[:, 0], steps.stamps[-1, 1]), np.array(T))
    unit, matched = map_sharpness.of_drive(log, [log.reference, odometry])
    assert matched.thickness_m <= 0.0225  # moving vehicles included; 2.1 cm without them
    assert matched.wall_thickness_m <= 0.038
    assert matched.mean_map_entropy < unit.mean_map_entropy - 0.4
    assert matched.voxels < 0.87 * unit.voxels
