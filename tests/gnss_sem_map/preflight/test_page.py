"""What a user sees of the pre-flight: in the terminal, on the page, in run.json, and when it stops a run."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import pytest
from street import Street
from typer.testing import CliRunner

from gnss_sem_map.cli import app
from gnss_sem_map.errors import DataError
from gnss_sem_map.preflight.findings import Level, Preflight, PreflightError, amber, green, red
from gnss_sem_map.runs import finished_run
from gnss_sem_map.runs.check_page import check_writable, write_check_page

RED = red("IMU axes", "mean specific force -9.8 m/s² along z", "z points down: FRD?", "set imu_axes: frd")
AMBER = amber("GNSS", "5 % of the fixes stand still", "frozen receiver", "leave them out")


def upside_down(street: Street, folder: Path) -> Path:
    """The drive with an IMU that points forward, right, down."""
    shutil.copytree(street.drive.parent, folder / "date")
    drive = folder / "date" / street.drive.name
    for path in (drive / "oxts/data").iterdir():
        row = path.read_text().split()
        for column in (12, 13, 18, 19):
            row[column] = str(-float(row[column]))
        path.write_text(" ".join(row))
    return drive


def test_a_page_is_as_bad_as_its_worst_finding() -> None:
    assert Preflight((), 0.1).level is Level.GREEN
    assert Preflight((green("a", "b"), AMBER), 0.1).level is Level.AMBER
    page = Preflight((AMBER, RED, green("a", "b")), 0.1)
    assert page.level is Level.RED
    assert page.of(Level.RED) == (RED,)
    said = str(PreflightError("drive 5", page))
    assert "z points down" in said
    assert "--force" in said
    assert "\n" not in said


def test_the_page_says_mistake_and_remedy_and_replaces_only_pages_of_ours(tmp_path: Path) -> None:
    path, page = tmp_path / "check.html", Preflight((RED, AMBER), 0.5)
    write_check_page(path, "<b>drive</b>", page)
    write_check_page(path, "<b>drive</b>", page)
    text = path.read_text()
    assert "set imu_axes: frd" in text
    assert "<b>drive</b>" not in text
    path.write_text("my own notes")
    with pytest.raises(DataError, match="no page of gnss-sem-map"):
        write_check_page(path, "drive", page)
    assert path.read_text() == "my own notes"


def test_a_pipe_is_refused_and_of_a_large_file_only_the_start_is_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(DataError, match="pipe: found a pipe, expected a file"):
        check_writable(tmp_path / "pipe")
    with (tmp_path / "big.bag").open("wb") as file:
        file.truncate(1 << 43)  # more than any memory
    with pytest.raises(DataError, match=r"big\.bag: exists and is no page of gnss-sem-map"):
        check_writable(tmp_path / "big.bag")


def test_check_ends_with_1_where_something_is_red_and_0_on_a_good_drive(
    small_drive: Street, tmp_path: Path
) -> None:
    page = str(tmp_path / "check.html")
    good = CliRunner().invoke(app, ["check", str(small_drive.drive), "-o", page, "--json"])
    assert good.exit_code == 0, good.output
    assert json.loads(good.stdout)["level"] != "red"
    bad = CliRunner().invoke(app, ["check", str(upside_down(small_drive, tmp_path)), "-o", page])
    assert bad.exit_code == 1
    assert "imu_axes" in bad.output
    assert "imu_axes" in Path(page).read_text()


def test_check_names_what_is_left_out_of_a_drive_and_says_where_no_scan_is_there(
    small_drive: Street, tmp_path: Path
) -> None:
    date = shutil.copytree(small_drive.drive.parent, tmp_path / small_drive.drive.parent.name)
    drive = date / small_drive.drive.name
    first, *others = sorted((drive / "velodyne_points/data").iterdir())
    for path in others:
        path.unlink()
    words = ["check", str(drive), "-o", str(tmp_path / "check.html")]
    lines = CliRunner().invoke(app, words).output.splitlines()
    missing = f"{len(others)} files missing"
    assert [line for line in lines if line.startswith("left out: scan, ") and line.endswith(missing)]
    first.unlink()
    assert (
        "scans: no LiDAR scan: the drive has a trajectory, but makes no map"
        in CliRunner().invoke(app, words).output
    )


def test_a_red_drive_is_mapped_only_when_it_is_forced(small_drive: Street, tmp_path: Path) -> None:
    drive, out = upside_down(small_drive, tmp_path), tmp_path / "out"
    words = ["trajectory", str(drive), "-o", str(out), "--set", "trajectory.lidar_odometry=false"]
    stopped = CliRunner().invoke(app, words)
    assert isinstance(stopped.exception, PreflightError)
    assert not out.exists()
    forced = CliRunner().invoke(app, [*words, "--force"])
    assert forced.exit_code == 0, forced.output
    about = json.loads((out / "run.json").read_text())
    assert about["preflight"]["level"] == "red"
    assert any("imu_axes" in warning for warning in about["warnings"])


def test_run_is_checked_from_python_too(small_drive: Street, tmp_path: Path) -> None:
    from gnss_sem_map import config

    with pytest.raises(PreflightError, match="imu_axes"):
        finished_run.run(upside_down(small_drive, tmp_path), tmp_path / "out", settings=config.load())


def test_another_time_offset_than_that_of_the_smoother_is_said() -> None:
    page = Preflight((), 0.0, gnss_lag_s=-0.6)
    assert page.other_clock(-0.55) is None
    assert "-1.77 s after their stamps in the trajectory, -0.60 s by the pre-flight" in (
        page.other_clock(-1.77) or ""
    )
    assert Preflight((), 0.0).other_clock(-1.77) is None
