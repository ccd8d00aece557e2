"""Absurd stamps, fixes and transforms: left out and said, or refused in one line, before anything is sized by them."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from faults.harness import gnss_sem_map

from factor_graphs.errors import MeasurementError
from factor_graphs.intervals import split
from factor_graphs.measurements import ImuSamples
from factor_graphs.stamps import far_off
from gnss_sem_map.datasets import open_drive
from gnss_sem_map.errors import SemMapError

ABSURD_S = ["1e9", "-1e9", "1e300", "1e18", "86400", "-100000", "nan"]
ABSURD_DATES = [
    "0001-01-01 00:00:00.0",
    "9999-12-31 23:59:59.9",
    "1999-01-01 00:00:00.0",
    "2011-09-27 23:00:00.0",
]


@pytest.fixture
def copies(drives: dict[str, Path], tmp_path: Path) -> dict[str, Path]:
    """Copies of them that a test may damage."""
    found = {}
    for layout, drive in drives.items():
        shutil.copytree(drive.parent, tmp_path / layout / drive.parent.name)
        found[layout] = tmp_path / layout / drive.parent.name / drive.name
    return found


def _change_cell(path: Path, line: int, column: int, value: str) -> None:
    lines = path.read_text().splitlines()
    cells = lines[line].split(",")
    cells[column] = value
    lines[line] = ",".join(cells)
    path.write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize("value", ABSURD_S)
@pytest.mark.parametrize("name", ["imu.csv", "gnss.csv", "lidar/stamps.csv", "images/stamps.csv"])
def test_one_absurd_stamp_costs_one_row(name, value, copies, trial) -> None:
    column = 1 if "stamps" in name else 0
    before = open_drive(copies["table"])
    _change_cell(copies["table"] / name, 3, column, value)
    log = open_drive(copies["table"])
    if name == "imu.csv":
        assert len(log.imu) == len(before.imu) - 1
        assert len(split(log.imu, log.gnss.stamps).nodes) < 10_000
    elif name == "gnss.csv":
        assert len(log.gnss) == len(before.gnss) - 1
    else:
        assert len(log.scans) + len(log.images) == 7
    assert log.skips
    trial("stamps")


@pytest.mark.parametrize("line", [1, 2, 3])
@pytest.mark.parametrize("date", ABSURD_DATES)
@pytest.mark.parametrize(
    "name", ["oxts/timestamps.txt", "velodyne_points/timestamps.txt", "velodyne_points/timestamps_end.txt",
             "velodyne_points/timestamps_start.txt", "image_02/timestamps.txt"],
)  # fmt: skip
def test_one_absurd_date_costs_one_frame(name, date, line, copies, trial) -> None:
    path = copies["kitti"] / name
    before = open_drive(copies["kitti"])
    lines = path.read_text().splitlines()
    lines[line] = date
    path.write_text("\n".join(lines) + "\n")
    log = open_drive(copies["kitti"])
    lost = [
        len(b) - len(a)
        for a, b in ((log.imu, before.imu), (log.scans, before.scans), (log.images, before.images))
    ]
    assert sorted(lost) == [0, 0, 1]
    assert len(log.skips) >= 1
    assert np.ptp(log.imu.stamps) < 10
    trial("stamps")


@pytest.mark.parametrize(
    ("unit", "scale"), [("milliseconds", 1e3), ("microseconds", 1e6), ("nanoseconds", 1e9)]
)
@pytest.mark.parametrize("name", ["imu.csv", "gnss.csv", "lidar/stamps.csv", "images/stamps.csv"])
def test_a_table_in_another_unit_is_refused_with_its_name(name, unit, scale, copies, trial) -> None:
    path, column = copies["table"] / name, 1 if "stamps" in name else 0
    lines = path.read_text().splitlines()
    for number in range(1, len(lines)):
        cells = lines[number].split(",")
        cells[column] = f"{float(cells[column]) * scale:.6f}"
        lines[number] = ",".join(cells)
    path.write_text("\n".join(lines) + "\n")
    with pytest.raises(SemMapError, match=f"are these {unit}"):
        open_drive(copies["table"])
    trial("stamps")


def test_an_imu_over_years_is_refused_before_it_is_cut_into_steps(trial) -> None:
    stamps = np.concatenate([np.arange(1000) * 0.01, 1e9 + np.arange(1000) * 0.01])
    imu = ImuSamples(stamps, np.ones((2000, 3)), np.ones((2000, 3)))
    with pytest.raises(MeasurementError, match="are its stamps in seconds"):
        split(imu, np.array([1.0]))
    trial("stamps")


def test_a_drive_with_a_long_break_stays_whole() -> None:
    stamps = np.concatenate([np.arange(1000) * 0.01, 7200 + np.arange(400) * 0.01])
    assert not far_off(stamps).any()
    assert far_off(np.append(stamps, 3600.0)).tolist() == [False] * 1400 + [True]


def _point_times(drive: Path, change) -> None:
    for path in (drive / "lidar").glob("*.bin"):
        rows = np.fromfile(path, "<f4").reshape(-1, 5)
        change(rows)
        rows.tofile(path)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e9, -5.0, 3e38])
def test_a_point_without_a_time_is_left_out_and_no_other(value, copies, trial) -> None:
    before = open_drive(copies["table"]).scans[1].read()
    _point_times(copies["table"], lambda rows: rows.__setitem__((7, 4), value))
    points = open_drive(copies["table"]).scans[1].read()
    assert np.isnan(points.xyz[7]).all()
    assert np.isfinite(points.stamps).all()
    others = np.arange(len(points.xyz)) != 7
    np.testing.assert_array_equal(points.xyz[others], before.xyz[others])
    np.testing.assert_array_equal(points.stamps[others], before.stamps[others])
    trial("stamps")


@pytest.mark.parametrize(
    ("scale", "later", "says"),
    [
        (1e3, 0.0, "in ms"),
        (1e6, 0.0, "in µs"),
        (1e9, 0.0, "in ns"),
        (1.0, 1e3, "absolute"),
        (1.0, 1.7e9, "absolute"),
    ],
)
def test_sweeps_in_another_unit_are_refused_with_its_name(scale, later, says, copies, trial) -> None:
    _point_times(copies["table"], lambda rows: rows.__setitem__((slice(None), 4), rows[:, 4] * scale + later))
    with pytest.raises(SemMapError, match=f"point times are {says}"):
        open_drive(copies["table"]).scans[1].read()
    trial("stamps")


FIXES = {
    "0, 0": ((1, "0"), (2, "0")), "beyond the pole": ((1, "91"),), "1,000 km off": ((1, "58"),),
    "no stddev": ((4, "0"),), "negative stddev": ((5, "-0.1"),), "NaN stddev": ((6, "nan"),),
    "infinite": ((1, "inf"),), "in orbit": ((3, "4e5"),), "endless stddev": ((4, "1e308"),),
}  # fmt: skip


@pytest.mark.parametrize("row", [1, 2, 6])
@pytest.mark.parametrize("kind", FIXES)
def test_one_row_that_is_no_fix_costs_that_row_and_never_makes_the_origin(kind, row, copies, trial) -> None:
    before = open_drive(copies["table"])
    for column, value in FIXES[kind]:
        _change_cell(copies["table"] / "gnss.csv", row, column, value)
    log = open_drive(copies["table"])
    assert len(log.gnss) == len(before.gnss) - 1
    assert sum(skip.frames for skip in log.skips if skip.what == "fix") == 1
    assert abs(log.frame.lat_deg - before.frame.lat_deg) < 1e-3
    if row > 1:
        assert log.frame == before.frame
    np.testing.assert_allclose(log.gnss.positions[-1], before.gnss.positions[-1], atol=3.0)
    trial("GNSS")


@pytest.mark.parametrize("frame", [0, 1, 3])
@pytest.mark.parametrize(
    ("column", "value"),
    [(23, "0"), (23, "-1"), (23, "nan"), (23, "inf"), (0, "58"), (0, "0"), (0, "95"), (2, "1e7")],
)
def test_an_oxts_row_that_is_no_fix_still_moves_the_vehicle(column, value, frame, copies, trial) -> None:
    path = copies["kitti"] / f"oxts/data/{frame:010d}.txt"
    before = open_drive(copies["kitti"])
    cells = path.read_text().split()
    cells[column] = value
    if (column, value) == (0, "0"):
        cells[1] = "0"
    path.write_text(" ".join(cells))
    log = open_drive(copies["kitti"])
    assert (len(log.imu), len(log.gnss)) == (len(before.imu), len(before.gnss) - 1)
    assert abs(log.frame.lat_deg - before.frame.lat_deg) < 1e-3
    assert log.epoch_ns == before.epoch_ns
    trial("GNSS")


def test_a_drive_without_any_fix_says_so(copies, trial) -> None:
    for path in (copies["kitti"] / "oxts/data").glob("*.txt"):
        cells = path.read_text().split()
        cells[23] = "-1"
        path.write_text(" ".join(cells))
    with pytest.raises(SemMapError, match=r"not one of .* rows is a fix; found .* standard deviation"):
        open_drive(copies["kitti"])
    trial("GNSS")


def _matrix(change: np.ndarray) -> str:
    return " ".join(f"{v:.9e}" for v in change.ravel())


TURNS = {
    "singular": np.zeros((3, 3)), "mirrored": np.diag([1.0, 1, -1]), "scaled": 1.01 * np.eye(3),
    "scaled in mm": 1000 * np.eye(3), "sheared": np.array([[1, 0.1, 0], [0, 1, 0], [0, 0, 1.0]]),
    "endless": np.full((3, 3), 1e308), "none": np.full((3, 3), np.nan),
}  # fmt: skip


@pytest.mark.parametrize("kind", TURNS)
@pytest.mark.parametrize(
    ("name", "row"),
    [("calib_imu_to_velo.txt", "R"), ("calib_velo_to_cam.txt", "R"), ("calib_cam_to_cam.txt", "R_rect_00")],
)
def test_a_calibration_that_is_no_rotation_is_refused_with_its_file(kind, name, row, copies, trial) -> None:
    path = copies["kitti"].parent / name
    lines = [
        f"{row}: {_matrix(TURNS[kind])}" if line.startswith(f"{row}:") else line
        for line in path.read_text().splitlines()
    ]
    path.write_text("\n".join(lines) + "\n")
    with pytest.raises(SemMapError, match=rf"{name}: .*{row}.*expected"):
        open_drive(copies["kitti"])
    trial("calibration")


CAMERAS = {
    "no focal length": np.diag([0.0, 0, 1]), "behind itself": np.diag([-180.0, -180, 1]), "all zero": np.zeros((3, 3)),
    "no camera": np.arange(9.0).reshape(3, 3), "endless": np.full((3, 3), 1e300),
}  # fmt: skip


@pytest.mark.parametrize("kind", CAMERAS)
def test_a_projection_that_is_none_is_refused(kind, copies, trial) -> None:
    P = _matrix(np.column_stack([CAMERAS[kind], np.zeros(3)]))
    for layout, name, row in (
        ("kitti", "../calib_cam_to_cam.txt", "P_rect_02"),
        ("odometry", "calib.txt", "P2"),
    ):
        path = (copies[layout] / name).resolve()
        lines = [
            f"{row}: {P}" if line.startswith(f"{row}:") else line for line in path.read_text().splitlines()
        ]
        path.write_text("\n".join(lines) + "\n")
        with pytest.raises(SemMapError, match=f"{row}.*expected"):
            open_drive(copies[layout])
        trial("calibration")


@pytest.mark.parametrize("kind", TURNS)
def test_a_pose_that_is_no_rotation_is_refused_with_its_line(kind, copies, trial) -> None:
    path = copies["odometry"] / "poses.txt"
    lines = path.read_text().splitlines()
    lines[2] = _matrix(np.column_stack([TURNS[kind], np.zeros(3)]))
    path.write_text("\n".join(lines) + "\n")
    with pytest.raises(SemMapError, match=r"poses\.txt: line 3: found"):
        open_drive(copies["odometry"])
    trial("poses")


@pytest.mark.parametrize("value", ["1e9", "-5", "0.05", "nan", "1e300", "x"])
def test_a_time_that_is_none_is_refused_with_its_line(value, copies, trial) -> None:
    path = copies["odometry"] / "times.txt"
    lines = path.read_text().splitlines()
    lines[-1] = value
    path.write_text("\n".join(lines) + "\n")
    with pytest.raises(SemMapError, match=rf"times\.txt: line {len(lines)}: "):
        open_drive(copies["odometry"])
    trial("poses")


@pytest.mark.faults
@pytest.mark.parametrize("value", ["1e9", "1e18", "50000"])
@pytest.mark.parametrize("name", ["imu.csv", "gnss.csv", "lidar/stamps.csv", "images/stamps.csv"])
def test_a_trajectory_with_one_absurd_stamp_takes_no_memory(
    name, value, copies, trial, tmp_path: Path
) -> None:
    _change_cell(copies["table"] / name, 3, 1 if "stamps" in name else 0, value)
    outcome = gnss_sem_map("trajectory", copies["table"], "-o", tmp_path / "out", folder=tmp_path / "run")
    slow = [f"{outcome.peak_mb:.0f} MB"] if outcome.peak_mb > 1500 else []
    trial("stamps", [*outcome.faults, *slow], outcome)
