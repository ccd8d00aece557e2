"""Sweeps that scan matching leaves out: each with its reason, and the others are bound all the same."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from exact_street import SWEEPS, errors, street, with_scan
from scipy.spatial.transform import Rotation

from factor_graphs.trajectory import Trajectory
from gnss_sem_map.errors import DataError
from gnss_sem_map.scans.lidar_odometry import ScanMatchingSettings, match_scans
from gnss_sem_map.sensor_log import Points


def test_a_sweep_with_a_handful_of_points_is_left_out_and_bridged() -> None:
    log, truth = street()
    points = log.scans[7].read()
    few = points[np.arange(len(points.xyz)) < 40]
    found = match_scans(with_scan(log, 7, few), truth)
    assert [skip.where for skip in found.skips] == ["frame 7"]
    assert "points after downsampling, expected at least 300" in found.skips[0].reason
    assert not np.isclose(found.relative_poses.stamps, log.scans[7].stamp).any()
    spans = [tuple(np.round(pair / 0.1 - 0.5).astype(int)) for pair in found.relative_poses.stamps]
    assert (6, 8) in spans
    off = errors(found.relative_poses, truth)
    assert np.linalg.norm(off[:, 3:], axis=1).max() < 0.02


def test_empty_and_unreadable_sweeps_are_left_out() -> None:
    log, truth = street()
    nothing = Points(np.empty((0, 3), np.float32), np.empty(0, np.float32), np.empty(0))
    broken = with_scan(log, 2, nothing)

    def damaged() -> Points:
        raise DataError("000005.bin: found 17 bytes, expected a multiple of 16")

    scans = tuple(replace(s, read=damaged) if s.number == 5 else s for s in broken.scans)
    found = match_scans(replace(broken, scans=scans), truth)
    assert [skip.where for skip in found.skips] == ["frame 2", "frame 5"]
    assert "17 bytes" in found.skips[1].reason
    assert found.counts["scans not matched"] == 2


@pytest.mark.parametrize("height_m", [4.0, 50.0])
def test_a_sweep_of_another_place_is_dropped(height_m: float) -> None:
    log, truth = street()
    elsewhere = log.scans[4].read()
    R = Rotation.from_euler("z", 40, degrees=True).as_matrix()
    turned = Points(
        (elsewhere.xyz @ R.T + [3, 9, height_m]).astype(np.float32),
        elsewhere.intensity,
        elsewhere.stamps,
    )
    found = match_scans(with_scan(log, 4, turned), truth)
    assert [skip.where for skip in found.skips] == ["frame 4"]
    assert found.skips[0].what == "scan matching"
    off = errors(found.relative_poses, truth)
    assert np.linalg.norm(off[:, 3:], axis=1).max() < 0.02


def test_a_registration_that_runs_away_from_its_start_is_dropped() -> None:
    log, truth = street()
    T = truth.T_map_imu.copy()
    late = truth.stamps > 0.8
    T[late, :3, 3] += [0.25, 0.0, 0.0]
    strict = ScanMatchingSettings(max_correction_m=0.1)
    found = match_scans(log, Trajectory(truth.stamps, T), strict)
    assert found.skips
    assert "from its initial guess, expected at most 0.1 m" in found.skips[0].reason


def test_sweeps_outside_the_trajectory_are_left_out() -> None:
    log, truth = street()
    short = Trajectory(truth.stamps[:80], truth.T_map_imu[:80])
    found = match_scans(log, short)
    assert found.skips[-1].where == f"frame {SWEEPS - 1}"
    assert "leave the trajectory" in found.skips[-1].reason
    assert found.counts["scans matched"] + found.counts["scans not matched"] == SWEEPS


def test_a_drive_without_sweeps_has_no_relative_poses() -> None:
    log, truth = street()
    found = match_scans(replace(log, scans=()), truth)
    assert len(found.relative_poses) == 0
    assert found.counts["local maps"] == 0
