"""Sensors of a bag: cameras with their lenses, LiDARs and poses, by what is in the bag and what `rig.yaml` says."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
import ros
from PIL import Image as Picture
from ros import START_NS, rig_yaml, sweep, with_camera

from gnss_sem_map.datasets import open_drive
from gnss_sem_map.errors import DataError

TIMES = np.linspace(-0.05, 0.05, 64)


@pytest.mark.parametrize("encoding", ["rgb8", "bgr8", "mono8", "png"])
def test_the_pixels_of_every_encoding(tmp_path: Path, encoding: str) -> None:
    rgb = np.random.default_rng(0).integers(0, 255, (4, 6, 3), dtype=np.uint8)
    rig = with_camera()
    if encoding == "png":
        buffer = io.BytesIO()
        Picture.fromarray(rgb).save(buffer, "PNG")
        rig.compressed(START_NS, buffer.getvalue())
    elif encoding == "mono8":
        rig.image(START_NS, rgb[:, :, 0], encoding, step=9)
        rgb = np.repeat(rgb[:, :, :1], 3, axis=2)
    else:
        rig.image(START_NS, rgb if encoding == "rgb8" else rgb[:, :, ::-1], encoding, step=32)
    log = open_drive(ros.write(tmp_path / "drive", rig))
    np.testing.assert_array_equal(log.images[0].read(), rgb)
    camera = log.calibration.camera()
    assert (camera.K[0, 0], camera.image_size) == (100.0, (6, 4))
    np.testing.assert_allclose(camera.T_camera_lidar[:3, 3], [0.0, -0.1, -0.2])


def test_the_shift_of_a_projection_moves_the_camera(tmp_path: Path) -> None:
    rig = with_camera(shift=-20.0)
    rig.image(START_NS, np.zeros((4, 6, 3), np.uint8), "rgb8")
    T = open_drive(ros.write(tmp_path / "drive", rig)).calibration.camera().T_camera_lidar
    np.testing.assert_allclose(T[:3, 3], [-0.2, -0.1, -0.2])


LENSES = {
    "plumb_bob": ((-0.3, 0.1, 0.001, 0.0, -0.02), "brown", (-0.3, 0.1, 0.001, 0.0, -0.02)),
    "rational_polynomial": (
        (0.4, -0.1, 0.0, 0.0, 0.0, 0.7, 0.1, 0.0),
        "brown",
        (0.4, -0.1, 0.0, 0.0, 0.0, 0.7, 0.1, 0.0),
    ),
    "equidistant": ((0.01, 0.002, 0.0, 0.0), "fisheye", (0.01, 0.002, 0.0, 0.0)),
}


@pytest.mark.parametrize("model", LENSES)
def test_the_lens_of_raw_images_is_that_of_their_info(tmp_path: Path, model: str) -> None:
    """And that of rectified images none: K is then that of their projection."""
    given, name, coefficients = LENSES[model]
    for topic, is_raw in (("/image_raw", True), ("/image_rect", False)):
        rig = with_camera(d=given, model=model, shift=-20.0)
        rig.image(START_NS, np.zeros((4, 6, 3), np.uint8), "rgb8", topic=topic)
        lens = open_drive(ros.write(tmp_path / topic[1:], rig)).calibration.camera().distortion
        assert (lens is not None) == is_raw
        if lens is not None:
            assert (lens.model, lens.coefficients) == (name, coefficients)


def test_every_camera_that_the_rig_names_is_read(tmp_path: Path) -> None:
    rig = with_camera()
    rig.transforms(("lidar", "left", (0.0, 0.5, 0.0)))
    rig.info(START_NS, focal=50.0, topic="/left/camera_info", d=(0.1, 0.0, 0.0, 0.0), model="equidistant")
    shades = {"/image_rect": 10, "/left/image_raw": 90}
    for k in range(3):
        for topic, shade in shades.items():
            pixels = np.full((4, 6, 3), shade + k, np.uint8)
            rig.image(START_NS + k * 100_000_000 + shade * 1_000_000, pixels, "rgb8", topic=topic)
    bag = ros.write(tmp_path / "drive", rig)
    with pytest.raises(DataError, match=r"2 topics of a camera: /image_rect, /left/image_raw; say which one"):
        open_drive(bag)
    left = {"topic": "/left/image_raw", "info": "/left/camera_info", "frame": "left", "time_offset_s": 0.01}
    rig_yaml(bag, cameras={"front": {"topic": "/image_rect", "info": "/camera_info"}, "left": left})
    log = open_drive(bag)
    front, side = log.cameras
    assert (front.name, front.K[0, 0], front.distortion) == ("front", 100.0, None)
    assert (side.name, side.K[0, 0], side.time_offset_s) == ("left", 50.0, 0.01)
    assert side.distortion is not None
    np.testing.assert_allclose(side.T_camera_lidar[:3, 3], [0.0, -0.5, 0.0])
    assert [image.camera for image in log.images] == ["front", "left"] * 3
    for name, shade in (("front", 10), ("left", 90)):
        assert [int(image.read()[0, 0, 0]) for image in log.images_of(name)] == [shade, shade + 1, shade + 2]
    stamp = log.images_of("left")[1].stamp
    near = log.image_at(stamp, 0.03, "left")
    assert near is log.images_of("left")[1]
    assert log.image_at(stamp, 0.01, "front") is None


def test_the_rig_may_say_a_camera_from_the_imu(tmp_path: Path) -> None:
    rig = with_camera()
    rig.image(START_NS, np.zeros((4, 6, 3), np.uint8), "rgb8")
    bag = ros.write(tmp_path / "drive", rig)
    T = np.eye(4)
    T[:3, 3] = 1.0, 0.1, 0.7
    lens = {"model": "mei", "coefficients": [0.01, 0.0, 0.0, 0.0], "xi": 2.0}
    rig_yaml(
        bag,
        cameras={
            "c": {
                "topic": "/image_rect", "T_imu_camera": T.tolist(), "distortion": lens,
                "K": [[9.0, 0, 3], [0, 9, 2], [0, 0, 1]], "image_size": [6, 4],
            }
        },
    )  # fmt: skip
    camera = open_drive(bag).calibration.camera()
    np.testing.assert_allclose(camera.T_camera_lidar[:3, 3], [0.0, -0.1, -0.2])  # as by the transforms
    assert camera.distortion is not None
    assert camera.distortion.xi == 2.0


def test_the_rig_says_which_of_several_lidars(tmp_path: Path) -> None:
    rig = ros.drive()
    rig.cloud(START_NS, sweep(TIMES[:5]), topic="/rear/points", frame="lidar")
    bag = ros.write(tmp_path / "drive", rig)
    with pytest.raises(
        DataError, match=r"2 topics of a LiDAR: /points, /rear/points; say which one in rig.yaml"
    ):
        open_drive(bag)
    rig_yaml(bag, lidars={"rear": {"topic": "/rear/points"}})
    assert len(open_drive(bag).scans) == 1
    T = np.eye(4)
    T[:3, 3] = 1.5, 0.0, 0.9
    rear = {"topic": "/rear/points", "T_imu_lidar": T.tolist()}
    rig_yaml(bag, lidars={"front": {"topic": "/points"}, "rear": rear})
    log = open_drive(bag)
    assert (log.lidar, len(log.scans)) == ("front", 10)
    np.testing.assert_allclose(log.calibration.T_imu_lidar[:3, 3], [1.0, 0.0, 0.5])
    (other,) = log.others
    assert (other.name, len(other.scans)) == ("rear", 1)
    np.testing.assert_array_equal(other.T_imu_lidar, T)
    assert len(other.scans[0].read().xyz) == 5


def test_a_rig_may_say_the_poses_itself(tmp_path: Path) -> None:
    bag = ros.write(tmp_path / "drive", ros.drive(frames=False))
    T = np.eye(4)
    T[:3, 3] = 1, 2, 3
    rig_yaml(bag, lidars={"lidar": {"topic": "/points", "T_imu_lidar": T.tolist()}}, gnss_time_offset_s=-0.5)
    log = open_drive(bag)
    np.testing.assert_array_equal(log.calibration.T_imu_lidar, T)
    assert [skip.what for skip in log.skips] == ["lever arm"]
    assert log.conventions is not None
    assert log.conventions.gnss_time_offset_s == -0.5
