"""What a reader leaves out of a drive: the damaged rows and frames, no others, each with its reason and count."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import street
from street import Street

from gnss_sem_map.datasets import open_drive
from gnss_sem_map.errors import DataError
from gnss_sem_map.sensor_log import SensorLog


def test_blank_stamp_lines_skip_their_frames_only(copy: Path, small_drive: Street) -> None:
    for name in ("", "_start", "_end"):
        path = copy / f"velodyne_points/timestamps{name}.txt"
        lines = path.read_text().splitlines()
        lines[2] = ""
        path.write_text("\n".join(lines) + "\n")
    log = open_drive(copy)
    assert [scan.number for scan in log.scans] == [n for n in range(12) if n != 2]
    assert log.scans[2].stamp == pytest.approx(0.07 + 0.3, abs=1e-6)
    assert any(skip.reason == "no stamp for this frame" for skip in log.skips)


def test_a_stamp_in_a_leap_second_skips_its_frame_only(copy: Path, small_drive: Street) -> None:
    path = copy / "image_02/timestamps.txt"
    lines = path.read_text().splitlines()
    lines[3] = "2016-12-31 23:59:60.500000000"
    path.write_text("\n".join(lines) + "\n")
    log = open_drive(copy)
    assert [image.number for image in log.images] == [n for n in small_drive.frames if n != 3]
    [skip] = [skip for skip in log.skips if skip.what == "stamp"]
    assert skip.where.endswith("timestamps.txt: line 4")
    assert "in a leap second" in skip.reason


def test_oxts_rows_that_are_damaged_or_repeated_are_left_out_and_counted(copy: Path) -> None:
    data = copy / "oxts/data"
    (data / "0000000003.txt").write_text("1 2 3\n")
    (data / "0000000005.txt").write_text(
        (data / "0000000005.txt").read_text().replace("0.050000000000", "nan")
    )
    lines = (copy / "oxts/timestamps.txt").read_text().splitlines()
    lines[8] = lines[7]
    (copy / "oxts/timestamps.txt").write_text("\n".join(lines) + "\n")
    log = open_drive(copy)
    assert [skip.reason for skip in log.skips if skip.what == "oxts"] == [
        "found 3 numbers, expected 30 finite ones",
        "repeated stamp",
    ]
    assert len(log.imu.stamps) == 14 - 2
    assert len(log.gnss.stamps) == 14 - 3, "a row without an accuracy is no fix, but its IMU counts"


def left_out(log: SensorLog) -> list[tuple[str, int, str]]:
    return [(skip.what, skip.frames, skip.reason) for skip in log.skips]


def test_lost_rows_and_repeated_frame_numbers_are_listed(copy: Path) -> None:
    for number in (3, 4, 9):
        (copy / f"oxts/data/{number:010d}.txt").unlink()
    scans = copy / "velodyne_points/data"
    shutil.copyfile(scans / "0000000007.bin", scans / "7.bin")
    log = open_drive(copy)
    assert len(log.scans) == 12
    assert left_out(log) == [
        ("oxts", 2, "2 files missing"),
        ("oxts", 1, "1 files missing"),
        ("scan", 1, "frame 7 has another file, 0000000007.bin"),
    ]
    shutil.rmtree(scans)
    assert ("scan", 12, "12 files missing") in left_out(open_drive(copy))


def test_frames_of_a_sequence_without_a_file_are_listed(small_drive: Street, tmp_path: Path) -> None:
    sequence = street.write_odometry(tmp_path, small_drive)
    (sequence / "velodyne/000004.bin").unlink()
    (sequence / "image_2/000000.png").unlink()
    assert left_out(open_drive(sequence)) == [
        ("scan", 1, "1 files missing"),
        ("scan", 3, "3 files missing"),
        ("image", 1, "1 files missing"),
        ("image", 3, "3 files missing"),
    ]


def test_lines_of_a_stamp_table_that_are_left_out_are_listed(small_drive: Street, tmp_path: Path) -> None:
    drive = street.write_table_log(tmp_path, small_drive)
    stamps = drive / "lidar/stamps.csv"
    stamps.write_text(stamps.read_text() + "5,0.66\n6,\n40,4.05\ngarbage\n7,later\n7,0.7,0.7\n")
    log = open_drive(drive)
    assert len(log.scans) == 12
    assert left_out(log) == [
        ("scan", 1, "frame 5 has a stamp already"),
        *[("scan", 1, "no number, or no stamp")] * 4,
        ("scan", 1, "1 files missing"),
    ]
    assert [scan.stamp for scan in log.scans if scan.number == 5] == [0.55]


def test_damaged_rows_of_a_table_are_left_out_and_counted(small_drive: Street, tmp_path: Path) -> None:
    drive = street.write_table_log(tmp_path, small_drive)
    before = open_drive(drive)
    for name in ("imu.csv", "gnss.csv"):
        lines = (drive / name).read_text().splitlines()
        lines[8] = "garbage"
        (drive / name).write_text("\n".join(lines) + "\n")
    log = open_drive(drive)
    assert (len(log.imu or ()), len(log.gnss or ())) == (
        len(before.imu or ()) - 1,
        len(before.gnss or ()) - 1,
    )
    told = {skip.where.rpartition("/")[2]: skip.reason for skip in log.skips}
    assert "1 not finite, dropped" in told["imu.csv"]
    assert told["gnss.csv"] == "1 rows: no stamp, or one far off all others"


def test_what_a_table_log_without_log_yaml_lacks_is_said(small_drive: Street, tmp_path: Path) -> None:
    drive = street.write_table_log(tmp_path, small_drive)
    (drive / "log.yaml").unlink()
    log = open_drive(drive)
    assert not log.cameras
    np.testing.assert_array_equal(log.calibration.T_imu_lidar, np.eye(4))
    assert left_out(log) == [
        ("pose of the LiDAR", 1, "not given: taken as that of the IMU; give T_imu_lidar in log.yaml"),
        ("image", len(log.images), f"no camera in log.yaml: {len(log.images)} images not used"),
    ]
    (drive / "log.yaml").write_text(json.dumps({"T_imu_lidar": np.eye(4).tolist()}))
    assert [skip.what for skip in open_drive(drive).skips] == ["image"]


def test_rows_of_the_imu_that_fill_a_gap_are_left_out_and_counted(copy: Path) -> None:
    twin = copy.with_name(copy.name.replace("_sync", "_extract"))
    shutil.copytree(copy / "oxts", twin / "oxts")
    files = sorted((twin / "oxts/data").iterdir())
    rows = np.array([np.loadtxt(path) for path in files])
    rows[:, 11:20] += np.random.default_rng(0).standard_normal((len(rows), 9))
    rows[4:9, 11:20] = np.linspace(rows[3, 11:20], rows[9, 11:20], 7)[1:-1]
    for path, row in zip(files, rows, strict=True):
        path.write_text(" ".join(f"{value:.12f}" for value in row))
    log = open_drive(copy)
    np.testing.assert_allclose(log.imu.specific_force, np.delete(rows[:, 11:14], range(4, 9), axis=0))
    assert left_out(log) == [("oxts", 5, "5 rows on straight lines that fill gaps")]


@pytest.mark.parametrize("ending", [".pcd", ".ply"])
def test_scans_in_another_format_are_named_with_how_to_write_ours(
    small_drive: Street, tmp_path: Path, ending: str
) -> None:
    drive = street.write_table_log(tmp_path, small_drive)
    for path in drive.glob("lidar/*.bin"):
        path.rename(path.with_suffix(ending))
    assert any(ending in skip.reason and "tofile" in skip.reason for skip in open_drive(drive).skips)


def test_frames_that_are_named_otherwise_are_counted_and_named(small_drive: Street, tmp_path: Path) -> None:
    """A log without a scan says why; images that are not found make no map without classes in silence."""
    drive = street.write_table_log(tmp_path, small_drive)
    scans, images = (sorted(drive.glob(pattern)) for pattern in ("lidar/*.bin", "images/*.png"))
    for path in (*scans, *images):
        path.rename(path.with_name(f"frame_{path.name}"))
    for folder in ("lidar", "images"):
        (drive / folder / "stamps.csv").unlink()
    log = open_drive(drive)
    assert [skip[::2] for skip in left_out(log)] == [
        ("scan", "found 12 others; scans are named by their numbers, such as 0000000007.bin"),
        ("image", f"found {len(images)} others; images are named by their numbers, such as 0000000007.png"),
    ]
    assert [skip.frames for skip in log.skips] == [len(scans), len(images)]
    with pytest.raises(DataError, match=r"no LiDAR scan.*lidar: found 12 others; scans are named by"):
        log.check_scans()
