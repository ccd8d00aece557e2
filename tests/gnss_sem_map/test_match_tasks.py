"""LiDAR odometry of sections, here and in other processes: the same relative poses, to the bit."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from counted_reads import counted

from factor_graphs.relative_poses import RelativePoses
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.config import Settings
from gnss_sem_map.errors import DataError
from gnss_sem_map.evaluation.map_sharpness import SweepSample, of_sample
from gnss_sem_map.files.work_folder import SWEEPS, clear
from gnss_sem_map.mapping.labelled_scans import Drive
from gnss_sem_map.process.execution import Executor, InProcess
from gnss_sem_map.process.run_stats import silent
from gnss_sem_map.process.worker_processes import Processes
from gnss_sem_map.runs import match_tasks
from gnss_sem_map.runs.match_tasks import SavedMatches
from gnss_sem_map.runs.source import Source
from gnss_sem_map.scans.lidar_odometry import ScanMatches, match_scans, sections_of
from gnss_sem_map.scans.local_maps import LocalMaps, sweeps_along
from gnss_sem_map.sensor_log import SensorLog

SETTINGS = Settings.model_validate({"trajectory": {"scan_matching": {"section_scans": 3, "min_points": 20}}})
MATCHING = SETTINGS.trajectory.scan_matching


@pytest.fixture(scope="module")
def expected(small_log: SensorLog, small_track: Trajectory) -> ScanMatches:
    found = match_scans(small_log, small_track, MATCHING)
    assert found.counts["scans matched"] > 3
    assert len(sections_of(len(small_log.scans), MATCHING)) > 1
    return found


def assert_same(found: ScanMatches, expected: ScanMatches) -> None:
    for field in fields(RelativePoses):
        one, other = (getattr(some.relative_poses, field.name) for some in (found, expected))
        np.testing.assert_array_equal(one, other, err_msg=field.name)
    assert (found.skips, found.counts) == (expected.skips, expected.counts)


@pytest.mark.parametrize("executor", [None, InProcess()])
def test_what_is_saved_comes_back(
    small_log: SensorLog,
    small_track: Trajectory,
    expected: ScanMatches,
    small_source: Source,
    tmp_path: Path,
    executor: Executor | None,
) -> None:
    assert_same(
        SavedMatches(small_source, tmp_path / "w", executor)(small_log, small_track, SETTINGS, silent),
        expected,
    )
    clear(tmp_path / "w")
    assert not (tmp_path / "w").exists()


@pytest.mark.slow
@pytest.mark.integration
def test_processes_find_the_same(
    small_log: SensorLog, small_track: Trajectory, expected: ScanMatches, small_source: Source, tmp_path: Path
) -> None:
    assert_same(
        SavedMatches(small_source, tmp_path, Processes(2))(small_log, small_track, SETTINGS, silent), expected
    )


@pytest.mark.parametrize(
    ("file", "damage"),
    [
        ("1.npz", b"no archive"),
        ("1.json", b"{"),
        *(
            pytest.param(*one, marks=pytest.mark.slow)
            for one in (("1.npz", b""), ("1.json", b"[]"), ("1.json", b"{}"))
        ),
    ],
)
def test_an_interrupted_run_matches_only_what_is_missing_or_damaged(
    small_log: SensorLog, small_track: Trajectory, expected: ScanMatches, small_source: Source, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch, file: str, damage: bytes,
) -> None:  # fmt: skip
    match = SavedMatches(small_source, tmp_path, resume=True)
    match(small_log, small_track, SETTINGS, silent)
    (tmp_path / "matches" / file).write_bytes(damage)
    matched: list[int] = []
    save = match_tasks._save

    def noted(found: ScanMatches, folder: Path, number: int, fingerprint: str) -> None:
        matched.append(number)
        save(found, folder, number, fingerprint)

    monkeypatch.setattr(match_tasks, "_save", noted)
    assert_same(match(small_log, small_track, SETTINGS, silent), expected)
    assert matched == [1]
    matched.clear()
    again = replace(match, resume=False)
    assert_same(again(small_log, small_track, SETTINGS, silent), expected)
    assert matched == list(range(len(sections_of(len(small_log.scans), MATCHING))))


def test_matches_of_another_first_trajectory_are_not_taken(
    small_log: SensorLog, small_track: Trajectory, small_source: Source, tmp_path: Path
) -> None:
    match = SavedMatches(small_source, tmp_path, resume=True)
    match(small_log, small_track, SETTINGS, silent)
    T = small_track.T_map_imu.copy()
    T[:, 0, 3] += 0.01 * (small_track.stamps - small_track.start)
    moved = Trajectory(small_track.stamps, T)
    assert_same(match(small_log, moved, SETTINGS, silent), match_scans(small_log, moved, MATCHING))


def test_later_stages_take_what_was_saved_of_a_sweep(
    small_log: SensorLog, small_track: Trajectory, small_source: Source, tmp_path: Path, expected: ScanMatches
) -> None:
    log, reads = counted(small_log)
    assert_same(SavedMatches(small_source, tmp_path)(log, small_track, SETTINGS, silent), expected)
    assert reads == dict.fromkeys((scan.number for scan in log.scans), 1), "though its sections overlap"
    saved, places = tmp_path / SWEEPS, small_track.stamps[[2, 5, 9]]
    along, sharpness = sweeps_along(log, small_track, saved), SweepSample(log, folder=saved)
    for sweeps in (along, sharpness.sweeps):
        for number in sorted(sweeps.numbers):
            thinned = sweeps.thin(small_log.scans[number].read())
            np.testing.assert_array_equal(sweeps[number].rows, thinned.rows)
    maps = LocalMaps(along, small_track, places)
    assert all(maps.at(place).size() for place in range(len(places)))
    of_sample(sharpness, [small_track])
    _ = Drive(log, small_track, None, SETTINGS, saved).image_rows
    assert max(reads.values()) == 1


def test_sweeps_of_other_files_are_not_taken(
    small_log: SensorLog, small_track: Trajectory, small_source: Source, tmp_path: Path
) -> None:
    match = SavedMatches(small_source, tmp_path, resume=True)
    match(small_log, small_track, SETTINGS, silent)
    (file,) = (tmp_path / SWEEPS).glob("0.sharpness.npz")
    file.write_bytes(b"of another drive")
    match(small_log, small_track, SETTINGS, silent)
    assert file.read_bytes() == b"of another drive"  # of this one, as far as anyone can tell
    later = replace(small_track, stamps=small_track.stamps + 1e-3)
    match(small_log, later, SETTINGS, silent)
    assert len(file.read_bytes()) > 100


def test_a_worker_that_finds_another_drive_says_so(
    small_log: SensorLog, small_track: Trajectory, small_source: Source, tmp_path: Path
) -> None:
    shorter = replace(small_log, scans=small_log.scans[:-1])
    with pytest.raises(DataError, match="a worker finds another drive"):
        SavedMatches(small_source, tmp_path, InProcess())(shorter, small_track, SETTINGS, silent)


def test_of_a_drive_that_is_not_mapped_next_only_what_binds_it_is_saved(
    small_log: SensorLog, small_track: Trajectory, small_source: Source, tmp_path: Path, expected: ScanMatches
) -> None:
    match = SavedMatches(small_source, tmp_path, resume=True, mapped_next=False)
    assert_same(match(small_log, small_track, SETTINGS, silent), expected)
    uses = {path.name.split(".")[1] for path in (tmp_path / SWEEPS).glob("*.npz")}
    assert uses == {"odometry", "surroundings"}
    again = replace(match, mapped_next=True)
    assert_same(again(small_log, small_track, SETTINGS, silent), expected)
