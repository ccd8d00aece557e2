"""KITTI as it is downloaded: `_extract` drives, other cameras, poses beside sequences, and the folder above a drive."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import street
from street import Street

from gnss_sem_map.datasets import open_drive
from gnss_sem_map.errors import DataError

UNRECTIFIED = np.array([-0.3, 0.1, 0.001, 0.0005, -0.02])
BIGGER = (400, 160)
TURN = cv2.Rodrigues(np.array([0.01, -0.02, 0.005]))[0]
K_RAW = np.array([[190.0, 0, 201.0], [0, 191.0, 81.0], [0, 0, 1]])


def as_text(scan: Path) -> None:
    """Four numbers a line, as in `_extract` drives."""
    rows = np.fromfile(scan, "<f4").reshape(-1, 4)
    np.savetxt(scan.with_suffix(".txt"), rows, fmt="%.9g")
    scan.unlink()


def extracted(drive: Path, camera: str = "02") -> Path:
    """A drive as it was before it was rectified: text scans, images of the sensor, and its calibration."""
    for scan in (drive / "velodyne_points/data").glob("*.bin"):
        as_text(scan)
    for image in (drive / "image_02/data").glob("*.png"):
        cv2.imwrite(str(image), np.full((BIGGER[1], BIGGER[0], 3), 80, np.uint8))
    named = drive.rename(drive.with_name(drive.name.replace("_sync", "_extract")))
    if camera != "02":
        (named / "image_02").rename(named / f"image_{camera}")
    add_rows(named.parent, camera, S=BIGGER, K=K_RAW, D=UNRECTIFIED, R=TURN, T=[0.06, 0.0, 0.0])
    return named


def add_rows(date: Path, camera: str, **rows: object) -> None:
    """Rows of a camera, those that are rectified by the numbers of camera 02."""
    file = date / "calib_cam_to_cam.txt"
    text = file.read_text().rstrip("\n")
    if f"P_rect_{camera}" not in text:
        text += "".join(
            "\n" + line.replace("_02", f"_{camera}") for line in text.splitlines() if "rect_02" in line
        )
    for name, values in rows.items():
        text += f"\n{name}_{camera}: " + " ".join(f"{v:.9e}" for v in np.ravel(np.asarray(values)))
    file.write_text(text + "\n")


@pytest.mark.parametrize("camera", ["02", "01"])
def test_an_extracted_drive_is_the_same_but_for_its_lens(
    small_drive: Street, copy: Path, camera: str
) -> None:
    plain, found = open_drive(small_drive.drive), open_drive(extracted(copy, camera))
    assert [scan.stamp for scan in found.scans] == [scan.stamp for scan in plain.scans]
    for one, other in zip(found.scans, plain.scans, strict=True):
        np.testing.assert_allclose(one.read().xyz, other.read().xyz, rtol=1e-7)
    [lens] = found.calibration.cameras
    assert lens.image_size == BIGGER
    np.testing.assert_allclose(lens.K, K_RAW)
    assert lens.distortion is not None
    assert lens.distortion.model == "brown"
    np.testing.assert_allclose(lens.distortion.coefficients, UNRECTIFIED)
    assert {image.read().shape for image in found.images} == {(BIGGER[1], BIGGER[0], 3)}
    point = np.array(
        [8.0, 1.0, -0.5, 1.0]
    )  # of the LiDAR, as OpenCV sees it by the calibration's own numbers
    rows = {
        line.partition(":")[0]: np.array(line.partition(":")[2].split(), float)
        for line in (copy.parent / "calib_velo_to_cam.txt").read_text().splitlines()
    }
    in_camera0 = rows["R"].reshape(3, 3) @ point[:3] + rows["T"]
    in_camera = TURN @ in_camera0 + [0.06, 0.0, 0.0]
    np.testing.assert_allclose((lens.T_camera_lidar @ point)[:3], in_camera, atol=1e-6)


def test_fixes_of_an_extracted_drive_are_as_frequent_as_of_the_others(copy: Path) -> None:
    drive = extracted(copy)
    rows = sorted((drive / "oxts/data").glob("*.txt"))
    many = [row.read_text() for row in rows for _ in range(10)]
    for k, row in enumerate(many):
        (drive / f"oxts/data/{k:010d}.txt").write_text(row)
    street._write_stamps(drive / "oxts/timestamps.txt", [0.01 * k for k in range(len(many))])
    log = open_drive(drive)
    assert log.gnss is not None
    assert log.imu is not None
    assert len(log.gnss) == len(rows)
    assert len(log.imu) > 5 * len(rows)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("1 2 3\n", "found 3 numbers per line, expected 4"),
        ("1 2 3 x\n", "no rows of 4 numbers"),
        ("", "found 0 numbers per line, expected 4"),
        ("1 2 3 4\n1 2\n", "no rows of 4 numbers"),
    ],
)
@pytest.mark.filterwarnings("error")
def test_a_damaged_scan_of_text_is_refused(copy: Path, text: str, said: str) -> None:
    drive = extracted(copy)
    scan = min((drive / "velodyne_points/data").glob("*.txt"))
    scan.write_text(text)
    with pytest.raises(DataError, match=said):
        open_drive(drive).scans[0].read()


@pytest.mark.parametrize("camera", ["03", "00", "01"])
def test_another_camera_than_the_second_is_used_where_it_is_alone(
    small_drive: Street, copy: Path, camera: str
) -> None:
    (copy / "image_02").rename(copy / f"image_{camera}")
    add_rows(copy.parent, camera)
    plain, found = open_drive(small_drive.drive), open_drive(copy)
    assert [image.stamp for image in found.images] == [image.stamp for image in plain.images]
    np.testing.assert_allclose(found.cameras[0].K, plain.cameras[0].K)


def test_a_folder_of_a_camera_without_images_does_not_hide_another_one(copy: Path) -> None:
    (copy / "image_02").rename(copy / "image_03")
    (copy / "image_02" / "data").mkdir(parents=True)
    add_rows(copy.parent, "03")
    assert open_drive(copy).images


@pytest.mark.parametrize("place", [".", "../..", "../2011_09_26_calib/2011_09_26"])
def test_the_calibration_may_be_unpacked_elsewhere(small_drive: Street, copy: Path, place: str) -> None:
    (copy / place).mkdir(parents=True, exist_ok=True)
    for file in copy.parent.glob("calib*.txt"):
        file.rename(copy / place / file.name)
    found, plain = open_drive(copy).calibration, open_drive(small_drive.drive).calibration
    np.testing.assert_array_equal(found.T_imu_lidar, plain.T_imu_lidar)
    np.testing.assert_array_equal(found.cameras[0].K, plain.cameras[0].K)


@pytest.mark.parametrize("name", ["image_02/timestamps.txt", "velodyne_points/timestamps_end.txt"])
def test_stamps_that_others_tell_may_lack(small_drive: Street, copy: Path, name: str) -> None:
    (copy / name).unlink()
    found, plain = open_drive(copy), open_drive(small_drive.drive)
    assert [skip.what for skip in found.skips] == ["stamps"]
    for ours, theirs in ((found.images, plain.images), (found.scans, plain.scans)):
        np.testing.assert_allclose([one.stamp for one in ours], [one.stamp for one in theirs], atol=0.05)
    stamps, others = found.scans[1].read().stamps, plain.scans[1].read().stamps
    assert stamps is not None
    assert others is not None
    np.testing.assert_allclose(stamps, others, atol=2e-3)


@pytest.mark.parametrize("folder", ["velodyne_points", "oxts"])
def test_what_is_still_packed_is_named(copy: Path, folder: str) -> None:
    shutil.make_archive(str(copy / folder), "zip", copy / folder)
    shutil.rmtree(copy / folder)
    if folder == "oxts":
        with pytest.raises(DataError, match=r"unpack oxts\.zip"):
            open_drive(copy)
    else:
        assert any("unpack velodyne_points.zip" in skip.reason for skip in open_drive(copy).skips)


@pytest.mark.parametrize("camera", [3, 0])
def test_a_sequence_as_downloaded(small_drive: Street, tmp_path: Path, camera: int) -> None:
    sequence = street.write_odometry(tmp_path, small_drive)
    plain = open_drive(sequence)
    (tmp_path / "poses").mkdir()
    (sequence / "poses.txt").rename(tmp_path / "poses" / "99.txt")
    (sequence / "image_2").rename(sequence / f"image_{camera}")
    (sequence / "calib.txt").write_text((sequence / "calib.txt").read_text().replace("P2:", f"P{camera}:"))
    found = open_drive(sequence)
    assert found.given is not None
    assert plain.given is not None
    np.testing.assert_array_equal(found.given.positions, plain.given.positions)
    assert len(found.images) == len(plain.images) > 0
    shutil.rmtree(tmp_path / "poses")
    with pytest.raises(DataError, match=r"sequences/99/poses\.txt: missing, and so is .*poses/99\.txt"):
        open_drive(sequence)


def test_the_pose_of_the_lidar_has_two_names(small_drive: Street, tmp_path: Path) -> None:
    sequence = street.write_odometry(tmp_path, small_drive)
    plain, calib = open_drive(sequence), sequence / "calib.txt"
    calib.write_text(calib.read_text().replace("Tr:", "Tr_velo_to_cam:"))
    [found], [expected] = (log.calibration.cameras for log in (open_drive(sequence), plain))
    np.testing.assert_array_equal(found.T_camera_lidar, expected.T_camera_lidar)


@pytest.mark.parametrize("depth", [1, 2])
def test_the_folder_above_a_drive_offers_what_is_in_it(
    small_drive: Street, tmp_path: Path, depth: int
) -> None:
    for n in range(10):
        shutil.copytree(
            small_drive.drive / "oxts", tmp_path / "kitti/2011_09_26" / f"drive_{n:04d}_sync" / "oxts"
        )
    (tmp_path / "kitti/2011_09_26/loop").symlink_to(tmp_path / "kitti")
    where = tmp_path / ("kitti/2011_09_26" if depth == 1 else "kitti")
    with pytest.raises(
        DataError, match=r"a folder of drives; .*: \S*drive_0000_sync, .*drive_0007_sync and 2 more$"
    ):
        open_drive(where)


def test_sequences_and_a_data_set_of_kitti_360_are_offered(small_drive: Street, tmp_path: Path) -> None:
    sequence = street.write_odometry(tmp_path, small_drive)
    with pytest.raises(DataError, match=f"a folder of drives; .*: {sequence}$"):
        open_drive(tmp_path)
