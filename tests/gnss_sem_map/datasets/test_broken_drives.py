"""A drive with a broken file is refused with the file and what was expected; a broken scan or image when it is read."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import street
from street import Street

from gnss_sem_map.datasets import open_drive
from gnss_sem_map.errors import DataError


def remove(name: str) -> Callable[[Path], None]:
    return lambda drive: (drive / name).resolve().unlink()


def rewrite(name: str, old: str, new: str) -> Callable[[Path], None]:
    def change(drive: Path) -> None:
        path = (drive / name).resolve()
        content = path.read_text()
        assert old in content
        path.write_text(content.replace(old, new, 1))

    return change


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (remove("../calib_velo_to_cam.txt"), "calib_velo_to_cam.txt: missing calibration file"),
        (remove("../calib_imu_to_velo.txt"), "calib_imu_to_velo.txt: missing calibration file"),
        (rewrite("../calib_cam_to_cam.txt", "P_rect_02", "P_rect_07"), "row 'P_rect_02': found nothing"),
        (rewrite("../calib_velo_to_cam.txt", "R: ", "R: 1 "), "row 'R': found 10 numbers, expected 9"),
        (rewrite("../calib_imu_to_velo.txt", "R: 1.0", "R: 3.0"), "R: found a matrix of determinant 3"),
        (remove("oxts/timestamps.txt"), "oxts/timestamps.txt: missing; expected stamps"),
        (rewrite("oxts/timestamps.txt", "2011-09-26", "26.9.2011"), "line 1: found '26.9.2011"),
    ],
)
def test_a_broken_drive_is_refused_with_the_file_and_what_was_expected(
    copy: Path, damage: Callable[[Path], None], says: str
) -> None:
    damage(copy)
    with pytest.raises(DataError, match=says):
        open_drive(copy)


def test_a_truncated_scan_is_named_when_it_is_read(copy: Path) -> None:
    path = copy / "velodyne_points/data/0000000003.bin"
    path.write_bytes(path.read_bytes()[:-7])
    with pytest.raises(DataError, match=r"0000000003\.bin: truncated scan"):
        next(scan for scan in open_drive(copy).scans if scan.number == 3).read()


def test_a_damaged_image_and_one_of_another_size_are_named_when_read(copy: Path) -> None:
    path = copy / "image_02/data/0000000002.png"
    small = street.cv2.imread(str(path))[:40]
    path.write_bytes(path.read_bytes()[:100])
    log = open_drive(copy)
    with pytest.raises(DataError, match="damaged image"):
        log.images[2].read()
    street.cv2.imwrite(str(path), small)
    with pytest.raises(DataError, match="found 300 x 40 pixels, expected 300 x 96"):
        log.images[2].read()


@pytest.mark.parametrize("channels", [1, 3])
def test_an_image_of_16_bits_is_refused_and_not_made_white(copy: Path, channels: int) -> None:
    values = np.linspace(0, 40950, 300 * 96 * channels).astype(np.uint16)
    street.cv2.imwrite(str(copy / "image_02/data/0000000002.png"), values.reshape(96, 300, channels))
    with pytest.raises(DataError, match=r"0000000002\.png: found uint16 .*expected 8 bits a channel"):
        open_drive(copy).images[2].read()


def test_a_folder_that_is_no_drive_says_what_a_drive_looks_like(tmp_path: Path) -> None:
    (tmp_path / "holiday.jpg").write_text("")
    with pytest.raises(DataError, match=r"found \['holiday.jpg'\], expected .*oxts/"):
        open_drive(tmp_path)
    with pytest.raises(DataError, match="no such folder"):
        open_drive(tmp_path / "nowhere")


@pytest.mark.parametrize(
    ("name", "old", "new", "says"),
    [
        ("poses.txt", "e+00", "x+00", "poses.txt: line 1"),
        ("times.txt", "5.000000000e-02\n", "", "poses and 14 times|15 poses and"),
        ("calib.txt", "Tr:", "Tx:", "row 'Tr': found nothing"),
    ],
)
def test_a_broken_sequence_is_refused(
    small_drive: Street, tmp_path: Path, name: str, old: str, new: str, says: str
) -> None:
    sequence = street.write_odometry(tmp_path, small_drive)
    rewrite(name, old, new)(sequence)
    with pytest.raises(DataError, match=says):
        open_drive(sequence)


@pytest.mark.parametrize(
    ("name", "old", "new", "says"),
    [
        ("imu.csv", "stamp_s,ax", "when,ax", "imu.csv:.*expected numbers in columns stamp_s,ax"),
        ("gnss.csv", "std_u_m", "quality_u", "gnss.csv:.*stddevs_m"),
        ("log.yaml", '"K"', '"k"', "log.yaml: k: .*known keys are"),
        ("log.yaml", '"image_size": [300, 96], ', "", "a camera needs all of"),
    ],
)
def test_a_broken_table_log_is_refused(
    small_drive: Street, tmp_path: Path, name: str, old: str, new: str, says: str
) -> None:
    drive = street.write_table_log(tmp_path, small_drive)
    content = (drive / name).read_text()
    if old not in content:
        pytest.fail(f"{old!r} is not in {name}: {content[:200]}")
    (drive / name).write_text(content.replace(old, new, 1))
    with pytest.raises(DataError, match=says):
        open_drive(drive)


@pytest.mark.parametrize("key", ["lidars", "cameras"])
@pytest.mark.parametrize("name", ["../../secret", "/tmp", "front\n"])
def test_a_sensor_of_a_table_log_is_in_a_folder_of_the_drive(
    small_drive: Street, tmp_path: Path, key: str, name: str
) -> None:
    """Of the only one as well, whose name is not used otherwise."""
    drive = street.write_table_log(tmp_path, small_drive)
    eye = np.eye(4).tolist()
    one = (
        {"T_imu_lidar": eye}
        if key == "lidars"
        else {"T_imu_camera": eye, "K": np.eye(3).tolist(), "image_size": [9, 9]}
    )
    (drive / "log.yaml").write_text(json.dumps({key: {name: one}}))
    with pytest.raises(DataError, match=rf"log\.yaml: {key}\..*expected a name of letters") as caught:
        open_drive(drive)
    assert "\n" not in str(caught.value)
