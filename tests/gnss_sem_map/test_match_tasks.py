"""LiDAR odometry of sections, here and in other processes: the same relative poses, to the bit."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from street import Street

from factor_graphs.relative_poses import RelativePoses
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.config import Settings
from gnss_sem_map.datasets import open_drive
from gnss_sem_map.errors import DataError
from gnss_sem_map.files.work_folder import clear
from gnss_sem_map.mapping.execution import Executor, InProcess
from gnss_sem_map.mapping.worker_processes import Processes
from gnss_sem_map.run_stats import silent
from gnss_sem_map.runs import match_tasks
from gnss_sem_map.runs.match_tasks import SavedMatches
from gnss_sem_map.runs.source import Source, source_of
from gnss_sem_map.scans.lidar_odometry import ScanMatches, match_scans, sections_of
from gnss_sem_map.sensor_log import SensorLog

SETTINGS = Settings.model_validate({"trajectory": {"scan_matching": {"section_scans": 3, "min_points": 20}}})
MATCHING = SETTINGS.trajectory.scan_matching


@pytest.fixture(scope="module")
def source(small_drive: Street) -> Source:
    return source_of(small_drive.drive)


@pytest.fixture(scope="module")
def log(source: Source) -> SensorLog:
    return open_drive(source.drive)


@pytest.fixture(scope="module")
def guess(log: SensorLog) -> Trajectory:
    assert log.reference is not None
    return log.reference


@pytest.fixture(scope="module")
def expected(log: SensorLog, guess: Trajectory) -> ScanMatches:
    found = match_scans(log, guess, MATCHING)
    assert found.counts["scans matched"] > 3
    assert len(sections_of(len(log.scans), MATCHING)) > 1
    return found


def assert_same(found: ScanMatches, expected: ScanMatches) -> None:
    for field in fields(RelativePoses):
        one, other = (getattr(some.relative_poses, field.name) for some in (found, expected))
        np.testing.assert_array_equal(one, other, err_msg=field.name)
    assert (found.skips, found.counts) == (expected.skips, expected.counts)


@pytest.mark.parametrize("executor", [None, InProcess()])
def test_what_is_saved_comes_back(
    log: SensorLog,
    guess: Trajectory,
    expected: ScanMatches,
    source: Source,
    tmp_path: Path,
    executor: Executor | None,
) -> None:
    assert_same(SavedMatches(source, tmp_path / "w", executor)(log, guess, SETTINGS, silent), expected)
    clear(tmp_path / "w")
    assert not (tmp_path / "w").exists()


@pytest.mark.integration
def test_processes_find_the_same(
    log: SensorLog, guess: Trajectory, expected: ScanMatches, source: Source, tmp_path: Path
) -> None:
    assert_same(SavedMatches(source, tmp_path, Processes(2))(log, guess, SETTINGS, silent), expected)


@pytest.mark.parametrize(
    ("file", "damage"),
    [("1.npz", b""), ("1.npz", b"no archive"), ("1.json", b"[]"), ("1.json", b"{"), ("1.json", b"{}")],
)
def test_an_interrupted_run_matches_only_what_is_missing_or_damaged(
    log: SensorLog, guess: Trajectory, expected: ScanMatches, source: Source, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch, file: str, damage: bytes,
) -> None:  # fmt: skip
    match = SavedMatches(source, tmp_path, resume=True)
    match(log, guess, SETTINGS, silent)
    (tmp_path / "matches" / file).write_bytes(damage)
    matched: list[int] = []
    save = match_tasks._save

    def noted(found: ScanMatches, folder: Path, number: int, fingerprint: str) -> None:
        matched.append(number)
        save(found, folder, number, fingerprint)

    monkeypatch.setattr(match_tasks, "_save", noted)
    assert_same(match(log, guess, SETTINGS, silent), expected)
    assert matched == [1]
    matched.clear()
    again = replace(match, resume=False)
    assert_same(again(log, guess, SETTINGS, silent), expected)
    assert matched == list(range(len(sections_of(len(log.scans), MATCHING))))


def test_matches_of_another_first_trajectory_are_not_taken(
    log: SensorLog, guess: Trajectory, source: Source, tmp_path: Path
) -> None:
    match = SavedMatches(source, tmp_path, resume=True)
    match(log, guess, SETTINGS, silent)
    T = guess.T_map_imu.copy()
    T[:, 0, 3] += 0.01 * (guess.stamps - guess.start)
    moved = Trajectory(guess.stamps, T)
    assert_same(match(log, moved, SETTINGS, silent), match_scans(log, moved, MATCHING))


def test_a_worker_that_finds_another_drive_says_so(
    log: SensorLog, guess: Trajectory, source: Source, tmp_path: Path
) -> None:
    shorter = replace(log, scans=log.scans[:-1])
    with pytest.raises(DataError, match="a worker finds another drive"):
        SavedMatches(source, tmp_path, InProcess())(shorter, guess, SETTINGS, silent)
