"""Runs along a trajectory in a file: the map is that of the run that wrote it, and scans alone become a map."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import exact_street
import numpy as np
import pytest
import street
from commands import gnss_sem_map

from factor_graphs.trajectory import Trajectory
from factor_graphs.tum import write_tum
from gnss_sem_map import Run, Settings, open_drive, run
from gnss_sem_map.datasets.given_trajectory import read_tum
from gnss_sem_map.errors import DataError
from gnss_sem_map.mapping.trajectory import locate
from gnss_sem_map.process.run_stats import RunStats
from gnss_sem_map.runs.many_drives import HowMapped, add_drive, run_drives

pytestmark = pytest.mark.integration


@pytest.fixture(scope="module")
def table(small_drive: street.Street, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small street as a table log; read only."""
    return street.write_table_log(tmp_path_factory.mktemp("given"), small_drive)


@pytest.fixture(scope="module")
def truth(small_drive: street.Street, table: Path) -> Trajectory:
    """Its exact poses, in the frame of the log."""
    frame = open_drive(table).frame
    assert frame is not None
    stamps = np.arange(0.0, 1.3, 0.01)
    return Trajectory(stamps, small_drive.motion.poses(stamps)).moved(frame.pose_of(street.FRAME))


@pytest.fixture(scope="module")
def truth_file(truth: Trajectory, tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("truth") / "poses.tum"
    write_tum(truth, file)
    return file


@pytest.fixture(scope="module")
def smoothed(table: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run of the log by its own GNSS and IMU; read only."""
    return run(table, tmp_path_factory.mktemp("runs") / "smoothed", force=True).folder


def tiles_of(folder: Path) -> dict[str, bytes]:
    return {
        str(file.relative_to(folder)): file.read_bytes()
        for part in ("map", "refined")
        for file in sorted((folder / part).rglob("*.parquet"))
    }


def voxels_of(folder: Path) -> set[tuple[int, ...]]:
    return {tuple(row) for row in Run.open(folder).map().voxels.indices.tolist()}


def thickness_of(folder: Path) -> float:
    """Of surfaces, m."""
    return float(json.loads((folder / "metrics.json").read_text())["sharpness"]["map"]["thickness_m"])


def test_the_parquet_of_a_run_gives_the_same_bytes(table: Path, smoothed: Path, tmp_path: Path) -> None:
    run(table, tmp_path / "out", trajectory=smoothed / "trajectory.parquet", force=True)
    assert tiles_of(tmp_path / "out") == tiles_of(smoothed)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["trajectory.tum", "trajectory.sbet"])
def test_its_other_files_give_the_same_voxels_but_for_their_digits(
    table: Path, smoothed: Path, tmp_path: Path, name: str
) -> None:
    run(table, tmp_path / "out", trajectory=smoothed / name, force=True)
    found, known = voxels_of(tmp_path / "out"), voxels_of(smoothed)
    assert len(found ^ known) <= 1e-3 * len(known)


@pytest.mark.slow
def test_the_truth_gives_a_map_that_is_not_less_sharp(
    table: Path, smoothed: Path, truth_file: Path, tmp_path: Path
) -> None:
    made = run(table, tmp_path / "out", trajectory=truth_file, force=True)
    assert thickness_of(made.folder) <= thickness_of(smoothed) + 1e-3, (
        "by more than the straight lines between poses"
    )
    assert "poses of poses.tum" in json.dumps(made.about["preflight"])


def scans_alone(table: Path, folder: Path) -> Path:
    shutil.copytree(table / "lidar", folder / "alone" / "lidar")
    shutil.copyfile(table / "log.yaml", folder / "alone" / "log.yaml")
    return folder / "alone"


@pytest.mark.slow
def test_scans_alone_become_the_same_map(table: Path, truth_file: Path, tmp_path: Path) -> None:
    whole = run(table, tmp_path / "whole", trajectory=truth_file, force=True)
    drive = scans_alone(table, tmp_path)
    with pytest.raises(DataError, match=r"imu\.csv: missing"):
        open_drive(drive)
    done = gnss_sem_map("run", drive, "-o", tmp_path / "out", "--trajectory", truth_file, "--force")
    assert done.returncode == 0, done.stderr
    made = Run.open(tmp_path / "out")
    assert made.frame is None
    assert voxels_of(made.folder) == voxels_of(whole.folder)


@pytest.mark.slow
def test_a_run_is_resumed_where_the_files_content_is_the_same(
    table: Path, truth: Trajectory, tmp_path: Path
) -> None:
    file, out = tmp_path / "poses.tum", tmp_path / "out"

    def made(resume: bool) -> int:
        run(table, out, trajectory=file, force=True, resume=resume)
        return (out / "run.json").stat().st_mtime_ns

    write_tum(truth, file)
    first = made(False)
    write_tum(truth, file)
    assert made(True) == first
    write_tum(truth.moved(street.T_IMU_LIDAR), file)
    assert made(True) != first


@pytest.mark.slow
def test_a_run_is_relabelled_when_the_file_is_gone(
    small_drive: street.Street, table: Path, truth: Trajectory, tmp_path: Path
) -> None:
    file = tmp_path / "poses.tum"
    write_tum(truth, file)
    made = run(table, tmp_path / "out", trajectory=file, force=True)
    file.unlink()
    again = made.relabel(f"labels:{small_drive.labels}", tmp_path / "again")
    assert voxels_of(again.folder) == voxels_of(made.folder)
    assert sum(again.about["map"]["labelled"]["raw"].values()) > 0


@pytest.mark.slow
def test_a_drive_with_a_trajectory_is_added(
    table: Path, truth: Trajectory, truth_file: Path, smoothed: Path, tmp_path: Path
) -> None:
    other = tmp_path / "other"
    shutil.copytree(table, other)
    write_tum(truth, tmp_path / "other.tum")
    shutil.copyfile(truth_file, tmp_path / "own_drive.tum")
    how = HowMapped(force=True, trajectory=tmp_path / "{drive}.tum")
    both = run_drives([table, other], tmp_path / "both", Settings(), how)
    assert not both.failed
    shutil.copytree(
        run(table, tmp_path / "one", trajectory=tmp_path / "own_drive.tum", force=True).folder,
        tmp_path / "added",
    )
    add_drive(tmp_path / "added", other, how)
    assert tiles_of(tmp_path / "added") == tiles_of(tmp_path / "both")


def test_given_poses_are_measured_beside_lidar_odometry() -> None:
    log, truth = exact_street.street()
    T, phase = truth.T_map_imu.copy(), 2 * np.pi * truth.stamps
    T[:, :3, 3] += 0.1 * np.column_stack([np.sin(phase), np.cos(phase), 0 * phase])
    log = replace(log, given=replace(truth, T_map_imu=T))
    fixed = locate(log, Settings(), RunStats()).trajectory
    assert fixed is log.given
    found = locate(log, Settings().changed("trajectory.given_poses=measured"), RunStats())
    stamps = np.array([scan.stamp for scan in log.scans])
    before, after = (
        np.linalg.norm(np.diff(one.at(stamps)[:, :3, 3] - truth.at(stamps)[:, :3, 3], axis=0), axis=1).mean()
        for one in (fixed, found.trajectory)
    )
    assert after < 0.1 * before
    assert found.without_lidar is log.given


@pytest.mark.parametrize("command", ["run", "trajectory", "check"])
def test_a_wrong_file_is_one_line(table: Path, truth: Trajectory, tmp_path: Path, command: str) -> None:
    write_tum(replace(truth, stamps=truth.stamps + 5000.0), tmp_path / "late.tum")
    done = gnss_sem_map(command, table, "-o", tmp_path / "out", "--trajectory", tmp_path / "late.tum")
    assert done.returncode == 1
    assert "no time in common" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


def test_the_trajectory_command_and_the_dry_run_say_how_it_was_taken(
    table: Path, truth: Trajectory, truth_file: Path, tmp_path: Path
) -> None:
    done = gnss_sem_map("trajectory", table, "-o", tmp_path / "out", "--trajectory", truth_file, "--force")
    assert done.returncode == 0, done.stderr
    np.testing.assert_allclose(
        read_tum(tmp_path / "out" / "trajectory.tum").positions, truth.positions, atol=2e-6
    )
    plan = gnss_sem_map(
        "run", table, "-o", tmp_path / "plan", "--segmenter", "none", "--trajectory", truth_file, "--dry-run"
    )
    assert (
        "130 poses of poses.tum; its stamps are seconds of the log; in the frame of the fixes" in plan.stdout
    )


def test_a_run_does_not_replace_the_run_that_its_poses_are_of(table: Path, smoothed: Path) -> None:
    done = gnss_sem_map(
        "run", table, "-o", smoothed, "--segmenter", "none", "--trajectory", smoothed / "trajectory.tum"
    )
    assert done.returncode == 1
    assert "trajectory.tum" in done.stderr
