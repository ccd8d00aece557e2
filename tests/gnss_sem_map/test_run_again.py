"""From the command line: a run that is killed and resumed, shared by processes, or merged with another."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from street import Street

from gnss_sem_map.voxels import tiles


def command(*arguments: str | Path) -> list[str]:
    return [sys.executable, "-m", "gnss_sem_map.cli", *map(str, arguments)]


def run(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command(*arguments), capture_output=True, text=True, check=False)


def run_of(small_drive: Street, out: Path, *more: str) -> list[str | Path]:
    return ["run", small_drive.drive, "--segmenter", f"labels:{small_drive.labels}", "-o", out, *more]


@pytest.fixture(scope="module")
def whole(small_drive: Street, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("whole") / "out"
    done = run(*run_of(small_drive, out))
    assert done.returncode == 0, done.stderr
    assert [path.name for path in out.parent.iterdir()] == ["out"], "nothing stays beside the results"
    return out


def assert_same_maps(a: Path, b: Path) -> None:
    for name in ("map", "refined"):
        files = sorted(path.name for path in (a / name).iterdir())
        assert files == sorted(path.name for path in (b / name).iterdir())
        for file in files:
            assert (a / name / file).read_bytes() == (b / name / file).read_bytes(), file


@pytest.mark.slow
def test_a_run_killed_at_several_moments_and_resumed_gives_the_same_bytes(
    small_drive: Street, whole: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    for seconds in (1.0, 2.0, 3.0, 4.0):
        with subprocess.Popen(command(*run_of(small_drive, out, "--resume"))) as process:
            time.sleep(seconds)
            process.kill()
        if out.exists():  # the machine was quick: then everything is there, for it appears at once
            assert_same_maps(out, whole)
    done = run(*run_of(small_drive, out, "--resume", "--workers", "2"))
    assert done.returncode == 0, done.stderr
    assert_same_maps(out, whole)


def test_two_halves_of_a_drive_merge_into_the_whole(small_drive: Street, whole: Path, tmp_path: Path) -> None:
    """The halves have one frame and one trajectory, so every voxel, hit and look of the whole comes back exactly.

    What moved, and LiDAR odometry, are found from all scans of a run: half a drive knows less, so they are off.
    """
    off = ("--set", "refinement.vehicles=off", "--set", "trajectory.lidar_odometry=false")
    for name, frames in (("a", "0:6"), ("b", "6:12"), ("both", "0:12")):
        done = run(*run_of(small_drive, tmp_path / name, "--frames", frames, *off))
        assert done.returncode == 0, done.stderr
    done = run("merge", tmp_path / "a", tmp_path / "b", "-o", tmp_path / "merged", "--no-match", "--json")
    assert done.returncode == 0, done.stderr
    both, merged = (tiles.read(tmp_path / name / "map").voxels for name in ("both", "merged"))
    for name in ("keys", "evidence", "hits"):
        np.testing.assert_array_equal(getattr(merged, name), getattr(both, name))
    assert json.loads(done.stdout)["map"]["voxels"] == len(both)
    assert (tmp_path / "merged/map.laz").is_file()
    done = run("merge", tmp_path / "a", small_drive.labels, "-o", tmp_path / "no")
    assert done.returncode == 1
    assert "no run folder here" in done.stderr
