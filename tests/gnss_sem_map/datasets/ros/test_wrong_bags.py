"""What is wrong with a bag is said in one line, with what to do."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import ros
from ros import START_NS, rig_yaml, sweep, with_camera
from scipy.spatial.transform import Rotation

from gnss_sem_map.datasets import open_drive
from gnss_sem_map.errors import DataError, PointTimesError

TIMES = np.linspace(-0.05, 0.05, 64)


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return ros.write(tmp_path_factory.mktemp("plain") / "drive", ros.drive())


def test_a_topic_of_another_type_than_said(plain: Path, tmp_path: Path) -> None:
    bag = tmp_path / "drive"
    shutil.copytree(plain, bag)
    rig_yaml(bag, lidars={"lidar": {"topic": "/imu"}})
    with pytest.raises(
        DataError, match=r"lidars.lidar: /imu is of sensor_msgs/msg/Imu, expected sensor_msgs/msg/PointCloud2"
    ):
        open_drive(bag)
    rig_yaml(bag, lidars={"lidar": {"topic": "/nowhere"}})
    with pytest.raises(
        DataError,
        match=r"rig.yaml: lidars.lidar: .*drive has no topic '/nowhere', expected one of .*: /points; ",
    ):
        open_drive(bag)
    rig_yaml(bag, cameras={"front": {"topic": "/nowhere"}})
    with pytest.raises(
        DataError, match=r"cameras.front: .*'/nowhere', .*: there is none; correct or remove it"
    ):
        open_drive(bag)
    rig_yaml(bag, lidar={"topic": "/points"})
    with pytest.raises(DataError, match=r"rig.yaml: lidar: Extra inputs"):
        open_drive(bag)


def test_a_few_wrong_header_stamps_are_skipped_and_counted(tmp_path: Path) -> None:
    rig = ros.drive()
    for number, header_ns in enumerate((0, START_NS + 3600 * 10**9)):
        rig.imu(START_NS + 2_010_000_000 + number * 10_000_000, header_ns)
    for k in range(20):
        rig.imu(START_NS + 2_030_000_000 + k * 10_000_000)
    log = open_drive(ros.write(tmp_path / "drive", rig))
    assert log.imu is not None
    assert len(log.imu) == 221
    [skip] = log.skips
    assert (skip.what, skip.frames) == ("stamp", 2)
    assert "1 of 223 header stamps are zero" in skip.reason
    assert "1 of 223 header stamps jump" in skip.reason


@pytest.mark.parametrize("header_ns", [lambda k: 0, lambda k: START_NS + k * 10**7 + (k > 100) * 5 * 10**9])
def test_wrong_header_stamps_are_refused_and_arrivals_offered(
    tmp_path: Path, header_ns: Callable[[int], int]
) -> None:
    rig = ros.drive()
    rig.messages = [one for one in rig.messages if one[0] != "/imu"]
    for k in range(201):
        rig.imu(START_NS + k * 10**7, header_ns(k))
    bag = ros.write(tmp_path / "drive", rig)
    with pytest.raises(
        DataError, match=r"/imu: .* of 201 header stamps .*set `stamps: received` for this topic"
    ):
        open_drive(bag)
    rig_yaml(bag, imu={"topic": "/imu", "stamps": "received"})
    log = open_drive(bag)
    assert log.imu is not None
    np.testing.assert_allclose(np.diff(log.imu.stamps), 0.01, atol=1e-9)


def test_wrong_header_stamps_of_clouds_are_refused_and_arrivals_offered(tmp_path: Path) -> None:
    rig = ros.drive()
    rig.messages = [one for one in rig.messages if one[0] != "/points"]
    for k in range(10):
        rig.cloud(START_NS + k * 10**8, sweep(TIMES), header_ns=0)
    bag = ros.write(tmp_path / "drive", rig)
    with pytest.raises(
        DataError, match=r"/points: 10 of 10 header stamps are zero.*set `stamps: received` for this topic"
    ):
        open_drive(bag)
    rig_yaml(bag, lidars={"lidar": {"topic": "/points", "stamps": "received"}})
    np.testing.assert_allclose(np.diff([scan.stamp for scan in open_drive(bag).scans]), 0.1, atol=1e-9)


def test_a_bag_that_is_played_at_half_speed_keeps_its_header_stamps(tmp_path: Path) -> None:
    rig = ros.Rig()
    for k in range(400):
        rig.imu(START_NS + 2 * k * 10**7, START_NS + k * 10**7)
    rig.fix(START_NS)
    log = open_drive(ros.write(tmp_path / "drive", rig))
    assert log.imu is not None
    assert log.imu.stamps[-1] == pytest.approx(3.99)


def test_a_cloud_without_times_is_refused_unless_it_is_compensated(tmp_path: Path) -> None:
    rig = ros.drive()
    rig.messages = [one for one in rig.messages if one[0] != "/points"]
    rig.cloud(START_NS, sweep(TIMES, name="ring"))
    bag = ros.write(tmp_path / "drive", rig)
    with pytest.raises(
        DataError, match=r"found fields x, y, z, intensity, ring, and none with the time of each point"
    ):
        open_drive(bag)
    rig_yaml(bag, lidars={"lidar": {"topic": "/points", "point_times": "compensated"}})
    assert open_drive(bag).scans[0].read().stamps is None


@pytest.mark.parametrize(
    ("times", "mistake"),
    [(TIMES * 1e5, "no seconds of one sweep"), (START_NS * 1e-9 + 37.0 + TIMES, "of another clock")],
)
def test_times_of_no_sweep_are_named(tmp_path: Path, times: np.ndarray, mistake: str) -> None:
    rig = ros.drive()
    rig.messages = [one for one in rig.messages if one[0] != "/points"]
    rig.cloud(START_NS, sweep(times, "<f8", "timestamp"))
    with pytest.raises(PointTimesError, match=mistake):
        open_drive(ros.write(tmp_path / "drive", rig)).scans[0].read()


def test_a_camera_info_of_zeros_is_refused(tmp_path: Path) -> None:
    rig = with_camera(focal=0.0)
    rig.image(START_NS, np.zeros((4, 6, 3), np.uint8), "rgb8")
    bag = ros.write(tmp_path / "drive", rig)
    with pytest.raises(
        DataError, match=r"/camera_info: its CameraInfo is all zero: the camera was not calibrated"
    ):
        open_drive(bag)
    rig_yaml(bag, cameras={})
    assert open_drive(bag).images == ()


def test_images_of_an_unknown_lens_are_refused(tmp_path: Path) -> None:
    rig = with_camera(d=(0.1,) * 4, model="omni")
    rig.image(START_NS, np.zeros((4, 6, 3), np.uint8), "rgb8", topic="/image_raw")
    with pytest.raises(DataError, match=r"/camera_info: found distortion model 'omni' with 4 coefficients"):
        open_drive(ros.write(tmp_path / "drive", rig))


def test_an_encoding_that_is_not_known_is_named(tmp_path: Path) -> None:
    rig = with_camera()
    rig.image(START_NS, np.zeros((4, 6), np.uint8), "32FC1")
    rig.image(START_NS + 1, np.zeros((4, 6), np.uint8), "")
    bag = ros.write(tmp_path / "drive", rig)
    rig_yaml(bag, cameras={"front": {"topic": "/image_rect", "info": "/camera_info"}})
    with pytest.raises(DataError, match="found encoding 'none'"):
        open_drive(bag).images[1].read()
    with pytest.raises(
        DataError, match=r"found encoding '32FC1', expected PNG, JPEG, or one of rgb8, bgr8, .*convert"
    ):
        open_drive(bag).images[0].read()


def test_missing_and_circular_transforms(tmp_path: Path) -> None:
    bag = ros.write(tmp_path / "none", ros.drive(frames=False))
    with pytest.raises(
        DataError,
        match=r"no fixed transform leads from 'lidar' to 'imu' \(found frames none\)",
    ):
        open_drive(bag)
    rig = ros.drive(frames=False)
    rig.transforms(("imu", "base", (0, 0, 0)), ("base", "lidar", (0, 0, 0)), ("lidar", "imu", (0, 0, 0)))
    with pytest.raises(DataError, match=r"a circle of frames, .*; give the poses in rig.yaml"):
        open_drive(ros.write(tmp_path / "circle", rig))


def turned(child: str, quaternion: tuple[float, float, float, float]) -> ros.Rig:
    """A drive whose static transform of one frame has a quaternion x y z w."""
    rig = ros.drive()
    for message in (message for topic, _, message in rig.messages if topic == "/tf_static"):
        for one in message.transforms:
            if one.child_frame_id == child:
                q = one.transform.rotation
                q.x, q.y, q.z, q.w = quaternion
    return rig


@pytest.mark.parametrize("quaternion", [(0.0, 0.0, 0.71, 0.71), (0.7, 0.0, 0.0, 0.7)])
def test_quaternions_of_two_digits_are_normalised(
    tmp_path: Path, quaternion: tuple[float, float, float, float]
) -> None:
    T = open_drive(ros.write(tmp_path / "drive", turned("lidar", quaternion))).calibration.T_imu_lidar
    np.testing.assert_allclose(T[:3, :3], Rotation.from_quat(quaternion).as_matrix(), atol=1e-12)


@pytest.mark.parametrize("quaternion", [(0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.5)])
def test_a_quaternion_that_is_none_stops_those_who_need_it_alone(
    tmp_path: Path, quaternion: tuple[float, float, float, float]
) -> None:
    bag = ros.write(tmp_path / "drive", turned("lidar", quaternion))
    with pytest.raises(DataError, match=r"/tf_static: base to lidar: found .*unit quaternion.*T_imu_lidar"):
        open_drive(bag)
    rig_yaml(bag, lidars={"lidar": {"topic": "/points", "T_imu_lidar": np.eye(4).tolist()}})
    assert open_drive(bag).scans


def test_fixes_without_heights_make_a_flat_trajectory_and_that_is_said(tmp_path: Path) -> None:
    rig = ros.drive()
    for message in (message for topic, _, message in rig.messages if topic == "/fix"):
        message.altitude = float("nan")
    log = open_drive(ros.write(tmp_path / "drive", rig))
    assert log.gnss is not None
    np.testing.assert_allclose(log.gnss.stddevs, np.tile([0.5, 0.5, 100.0], (5, 1)))
    assert [skip.what for skip in log.skips] == ["height"]


@pytest.mark.parametrize("model", ["Plumb Bob", "pinhole"])
def test_models_of_lenses_as_drivers_spell_them(tmp_path: Path, model: str) -> None:
    rig = with_camera(model=model, d=(0.1, 0.01, 0.001, 0.002, 0.0))
    rig.image(START_NS, np.zeros((4, 6, 3), np.uint8), "rgb8", topic="/image_raw")
    bag = ros.write(tmp_path / "drive", rig)
    rig_yaml(bag, cameras={"front": {"topic": "/image_raw", "info": "/camera_info"}})
    lens = open_drive(bag).calibration.cameras[0].distortion
    assert lens is not None
    assert lens.model == "brown"
    np.testing.assert_array_equal(lens.coefficients[:4], (0.1, 0.01, 0.001, 0.002))


def test_covariances_of_fixes_are_used_and_what_is_none_is_counted(tmp_path: Path) -> None:
    """Off-diagonals of all fixes but one whose matrix is not positive definite, and one that has none by its type."""
    rig = ros.drive()
    fixes = [message for topic, _, message in rig.messages if topic == "/fix"]
    for message, covariance in zip(fixes, (0.2, 0.3, 0.2, 0.2, 0.2), strict=True):
        message.position_covariance_type = 3
        message.position_covariance[[1, 3]] = covariance
    fixes[-1].position_covariance_type = 2
    log = open_drive(ros.write(tmp_path / "drive", rig))
    assert log.gnss is not None
    assert log.gnss.correlations is not None
    np.testing.assert_allclose(log.gnss.correlations[:, 0], [0.8, 0.0, 0.8, 0.8, 0.0])
    np.testing.assert_allclose(log.gnss.stddevs, np.tile([0.5, 0.5, 1.0], (5, 1)))
    [skip] = [skip for skip in log.skips if skip.what == "covariance"]
    assert (skip.where, skip.frames) == ("/fix", 1)


def test_fixes_without_fix_or_covariance_are_counted(tmp_path: Path) -> None:
    rig = ros.drive()
    rig.fix(START_NS + 50_000_000, status=-1)
    for k in range(2):
        rig.fix(START_NS + 60_000_000 + k, kind=0)
    bag = ros.write(tmp_path / "drive", rig)
    log = open_drive(bag)
    assert {skip.reason: skip.frames for skip in log.skips} == {
        "1 messages: no fix": 1,
        "2 messages: its covariance is unknown": 2,
    }
    assert log.gnss is not None
    assert len(log.gnss) == 5
    rig_yaml(bag, gnss={"topic": "/fix", "stddevs_m": [1, 1, 2]})
    again = open_drive(bag).gnss
    assert again is not None
    assert len(again) == 7


def test_a_bag_without_imu_lists_what_it_has(tmp_path: Path) -> None:
    rig = ros.drive()
    bag = ros.write(tmp_path / "drive", rig, keep=lambda one: one[0] != "/imu")
    with pytest.raises(DataError, match=r"no topic of an IMU \(sensor_msgs/Imu\); it has /fix"):
        open_drive(bag)


def test_a_topic_that_is_named_twice_is_refused_as_it_would_count_twice(plain: Path, tmp_path: Path) -> None:
    bag = tmp_path / "drive"
    shutil.copytree(plain, bag)
    rig_yaml(bag, lidars={name: {"topic": "/points"} for name in ("top", "rear")})
    with pytest.raises(
        DataError, match=r"rig.yaml: lidars.rear: /points is lidars.top already, and would count"
    ):
        open_drive(bag)
