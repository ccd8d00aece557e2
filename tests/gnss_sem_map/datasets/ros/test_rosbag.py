"""Bags of ROS 1 and ROS 2: what is in them arrives, and what is wrong with them is said in one line."""

from __future__ import annotations

import io
import json
import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import ros
from PIL import Image as Picture
from ros import START_NS, sweep

from gnss_sem_map.datasets import detect_format, open_drive
from gnss_sem_map.errors import DataError, PointTimesError
from gnss_sem_map.sensor_log import SensorLog

TIMES = np.linspace(-0.05, 0.05, 64)


def rig_yaml(bag: Path, **about: object) -> None:
    (bag / "rig.yaml" if bag.is_dir() else bag.parent / "rig.yaml").write_text(json.dumps(about))


def same(one: SensorLog, other: SensorLog) -> bool:
    assert one.imu is not None
    assert other.imu is not None
    assert one.gnss is not None
    assert other.gnss is not None
    pairs = [(one.imu.stamps, other.imu.stamps), (one.gnss.positions, other.gnss.positions)]
    for a, b in zip(one.scans, other.scans, strict=True):
        pairs += [(a.read().xyz, b.read().xyz), (a.read().stamps, b.read().stamps)]
    return all(np.array_equal(a, b) for a, b in pairs)


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return ros.write(tmp_path_factory.mktemp("plain") / "drive", ros.drive())


def test_a_bag_is_read(plain: Path) -> None:
    assert detect_format(plain) == "rosbag"
    log = open_drive(plain)
    assert log.skips == ()
    assert (log.name, log.epoch_ns) == ("drive", START_NS + 3_000_000)
    assert log.imu is not None
    assert log.gnss is not None
    assert (len(log.imu), len(log.gnss), len(log.scans), len(log.images)) == (201, 5, 10, 0)
    np.testing.assert_array_equal(log.gnss.stddevs[0], [0.5, 0.5, 1.0])
    np.testing.assert_allclose(log.calibration.T_imu_lidar[:3, 3], [1.0, 0.0, 0.5])
    np.testing.assert_allclose(log.calibration.p_imu_antenna, [0.0, 0.0, 0.8])
    points = log.scans[3].read()
    assert points.stamps is not None
    np.testing.assert_allclose(points.stamps - log.scans[3].stamp, TIMES, atol=1e-8)
    assert [scan.name for scan in log.scans[:2]] == ["0000000000", "0000000001"]


@pytest.mark.parametrize(
    ("storage", "compression"),
    [
        ("mcap", "storage"),
        ("mcap", "message"),
        ("db3", ""),
        ("db3", "message"),
        ("bag", ""),
        ("bag", "lz4"),
        ("bag", "bz2"),
    ],
)
def test_storage_and_compression_change_nothing(
    plain: Path, tmp_path: Path, storage: str, compression: str
) -> None:
    name = "drive.bag" if storage == "bag" else "drive"
    bag = ros.write(tmp_path / name, ros.drive(storage == "bag"), storage, compression)
    assert same(open_drive(bag), open_drive(plain))


@pytest.mark.parametrize("storage", ["mcap", "db3", "bag"])
def test_a_folder_of_parts_is_the_whole_bag(plain: Path, tmp_path: Path, storage: str) -> None:
    folder, rig = tmp_path / "drive", ros.drive(storage == "bag")
    folder.mkdir()
    for number, (first, last) in enumerate([(-1, 0.7), (0.7, 1.2), (1.2, 9)]):
        part = tmp_path / (f"part_{number}.bag" if storage == "bag" else f"part_{number}")
        keep = lambda one, a=first, b=last: a * 1e9 <= one[1] - START_NS < b * 1e9  # noqa: E731
        ros.write(part, rig, storage, keep=keep)
        file = part if storage == "bag" else next(part.glob(f"*.{storage}"))
        shutil.copy(file, folder / f"part_{number}.{storage}")
    assert same(open_drive(folder), open_drive(plain))


def test_one_file_is_a_drive_and_its_rig_is_beside_it(plain: Path, tmp_path: Path) -> None:
    file = shutil.copy(next(plain.glob("*.mcap")), tmp_path / "one.mcap")
    rig_yaml(Path(file), gnss={"topic": "/fix", "p_imu_antenna": [1, 2, 3]})
    log = open_drive(file)
    assert same(log, open_drive(plain))
    np.testing.assert_array_equal(log.calibration.p_imu_antenna, [1, 2, 3])


@pytest.mark.parametrize(
    ("name", "kind", "times"),
    [
        ("time", "<f4", TIMES),
        ("time", "<f8", TIMES),
        ("t", "<u4", (TIMES + 0.05) * 1e9),
        ("offset_time", "<u4", (TIMES + 0.05) * 1e9),
        ("timestamp", "<f8", START_NS * 1e-9 + TIMES),
        ("timestamp", "<f8", START_NS + TIMES * 1e9),
    ],
    ids=["Velodyne", "relative f8", "Ouster", "Livox offset", "Hesai, RoboSense", "Livox"],
)
def test_the_times_of_points_of_every_driver(tmp_path: Path, name: str, kind: str, times: np.ndarray) -> None:
    rig = ros.drive()
    rig.messages = [one for one in rig.messages if one[0] != "/points"]
    rig.cloud(START_NS, sweep(times, kind, name))
    [scan] = open_drive(ros.write(tmp_path / "drive", rig)).scans
    points = scan.read()
    assert points.stamps is not None
    start = 0.05 if kind == "<u4" else 0.0
    np.testing.assert_allclose(points.stamps - scan.stamp, TIMES + start, atol=5e-7)


def test_a_cloud_with_gaps_between_its_fields(tmp_path: Path) -> None:
    """As PCL and Ouster write it: 16 bytes of position, then other fields, and intensities of integers."""
    dtype = np.dtype(
        {
            "names": ["x", "y", "z", "intensity", "t", "ring"],
            "formats": ["<f4", "<f4", "<f4", "u1", "<u4", "<u2"],
            "offsets": [0, 4, 8, 16, 20, 26],
            "itemsize": 48,
        }
    )
    table = np.zeros(6, dtype)
    table["x"], table["intensity"], table["t"] = (
        np.arange(6) + 1,
        [0, 51, 102, 153, 204, 255],
        np.arange(6) * 10**7,
    )
    rig = ros.drive()
    rig.messages = [one for one in rig.messages if one[0] != "/points"]
    rig.cloud(START_NS, table, height=2, width=3, row_step=144)
    points = open_drive(ros.write(tmp_path / "drive", rig)).scans[0].read()
    np.testing.assert_array_equal(points.xyz[:, 0], np.arange(6) + 1)
    np.testing.assert_allclose(points.intensity, np.arange(6) / 5, atol=1e-6)
    np.testing.assert_array_equal(points.rows.reshape(-1, 4)[:, 0], np.arange(6) + 1)


def with_camera(**info: Any) -> ros.Rig:
    rig = ros.drive()
    rig.transforms(("lidar", "camera", (0.0, 0.1, 0.2)))
    rig.info(START_NS, **info)
    return rig


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
    rig_yaml(bag, lidars={"rear": {"topic": "/rear/points"}, "front": {"topic": "/points"}})
    with pytest.raises(DataError, match=r"names 2 LiDARs: rear, front; one is used as yet"):
        open_drive(bag)


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


# ---- what is wrong with a bag


def damaged(bag: Path, change: Callable[[bytearray], bytes | bytearray]) -> None:
    file = bag if bag.is_file() else next(path for path in bag.iterdir() if path.suffix in (".mcap", ".db3"))
    file.write_bytes(change(bytearray(file.read_bytes())))


@pytest.mark.parametrize("storage", ["mcap", "db3", "bag"])
def test_a_truncated_bag_is_refused_with_its_repair(tmp_path: Path, storage: str) -> None:
    name = "drive.bag" if storage == "bag" else "drive"
    bag = ros.write(tmp_path / name, ros.drive(storage == "bag"), storage)
    damaged(bag, lambda content: content[: len(content) // 3])
    with pytest.raises(DataError, match=r"truncated.*(mcap recover|rosbag reindex|sqlite3)"):
        open_drive(bag).scans[-1].read()


def test_an_unindexed_ros1_bag_is_refused(tmp_path: Path) -> None:
    bag = ros.write(tmp_path / "drive.bag", ros.drive(is_ros1=True), "bag")

    def not_closed(content: bytearray) -> bytearray:
        at = content.index(b"index_pos=") + len(b"index_pos=")
        content[at : at + 8] = bytes(8)  # what a recorder leaves that was killed
        return content

    damaged(bag, not_closed)
    with pytest.raises(DataError, match=r"not indexed.*rosbag reindex drive.bag"):
        open_drive(bag)


def test_an_mcap_that_was_not_closed_is_refused(plain: Path, tmp_path: Path) -> None:
    content = next(plain.glob("*.mcap")).read_bytes()
    (tmp_path / "open.mcap").write_bytes(content[:-40])
    with pytest.raises(DataError, match=r"not closed.*mcap recover open.mcap"):
        open_drive(tmp_path / "open.mcap")


def test_an_unknown_codec_is_named(tmp_path: Path) -> None:
    bag = ros.write(tmp_path / "drive", ros.drive(), compression="storage")
    damaged(bag, lambda content: content.replace(b"\x04\x00\x00\x00zstd", b"\x04\x00\x00\x00abcd"))
    with pytest.raises(
        DataError, match=r"compressed with 'abcd', which is not here; expected none, lz4, zstd or bz2"
    ):
        open_drive(bag)


def test_files_that_are_compressed_as_a_whole_are_refused(tmp_path: Path) -> None:
    bag = ros.write(tmp_path / "drive", ros.drive(), "db3", "file")
    with pytest.raises(DataError, match=r"compressed as whole files.*zstd -d"):
        open_drive(bag)


def test_every_flipped_byte_is_an_error_or_a_value(plain: Path, tmp_path: Path) -> None:
    """Nothing but our own errors, whatever the bytes of a message or of the index are."""
    content = next(plain.glob("*.mcap")).read_bytes()
    rng = np.random.default_rng(1)
    file = tmp_path / "drive.mcap"
    for _ in range(60):
        changed = bytearray(content)
        for at in rng.integers(0, len(content), 20):
            changed[at] = rng.integers(256)
        file.write_bytes(changed)
        with suppress(DataError):
            for scan in open_drive(file).scans:
                scan.read()


def test_a_topic_of_another_type_than_said(plain: Path, tmp_path: Path) -> None:
    bag = tmp_path / "drive"
    shutil.copytree(plain, bag)
    rig_yaml(bag, lidars={"lidar": {"topic": "/imu"}})
    with pytest.raises(
        DataError, match=r"lidars.lidar: /imu is of sensor_msgs/msg/Imu, expected sensor_msgs/msg/PointCloud2"
    ):
        open_drive(bag)
    rig_yaml(bag, lidars={"lidar": {"topic": "/nowhere"}})
    with pytest.raises(DataError, match=r"no topic '/nowhere'; it has /fix, /imu, /points"):
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
    [(TIMES * 1e3, "in ms"), (START_NS * 1e-9 + 37.0 + TIMES, "of another clock")],
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
    rig.image(START_NS, np.zeros((4, 6), np.uint8), "bayer_rggb8")
    with pytest.raises(DataError, match=r"found encoding 'bayer_rggb8', expected rgb8, bgr8 or mono8"):
        open_drive(ros.write(tmp_path / "drive", rig)).images[0].read()


def test_missing_and_circular_transforms(tmp_path: Path) -> None:
    bag = ros.write(tmp_path / "none", ros.drive(frames=False))
    with pytest.raises(
        DataError, match=r"no static transform leads from 'lidar' to 'imu' \(frames in /tf_static: none\)"
    ):
        open_drive(bag)
    rig = ros.drive(frames=False)
    rig.transforms(("imu", "base", (0, 0, 0)), ("base", "lidar", (0, 0, 0)), ("lidar", "imu", (0, 0, 0)))
    with pytest.raises(DataError, match=r"a circle of frames, .*; expected a tree"):
        open_drive(ros.write(tmp_path / "circle", rig))


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
