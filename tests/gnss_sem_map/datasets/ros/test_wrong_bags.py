"""What is wrong with a bag is said in one line, with what to do."""

from __future__ import annotations

import shutil
import sqlite3
import struct
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path

import numpy as np
import pytest
import ros
from commands import gnss_sem_map
from ros import START_NS, rig_yaml, sweep, with_camera
from scipy.spatial.transform import Rotation

from gnss_sem_map.datasets import open_drive
from gnss_sem_map.datasets.ros.bag import Bag
from gnss_sem_map.errors import DataError, PointTimesError
from gnss_sem_map.sensor_log import Skip

TIMES = np.linspace(-0.05, 0.05, 64)


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return ros.write(tmp_path_factory.mktemp("plain") / "drive", ros.drive())


def damaged(bag: Path, change: Callable[[bytearray], bytes | bytearray]) -> None:
    file = bag if bag.is_file() else next(path for path in bag.iterdir() if path.suffix in (".mcap", ".db3"))
    file.write_bytes(change(bytearray(file.read_bytes())))


def chunk_index(content: bytearray, at: int) -> int:
    """Where the first record of a chunk is in the summary of an MCAP file."""
    while content[at] != 0x08:
        at += 9 + int(struct.unpack_from("<Q", content, at + 1)[0])
    return at


def read_all(file: Path) -> None:
    bag = Bag(file)
    for topic in bag.kinds:
        messages = bag.messages(topic)
        for k in range(len(messages)):
            bag.read(messages, k)


@pytest.mark.parametrize("storage", ["mcap", "db3", "bag"])
def test_a_truncated_bag_is_refused_with_its_repair(tmp_path: Path, storage: str) -> None:
    name = "drive.bag" if storage == "bag" else "drive"
    bag = ros.write(tmp_path / name, ros.drive(storage == "bag"), storage)
    damaged(bag, lambda content: content[: len(content) // 3])
    with pytest.raises(DataError, match=r"truncated.*(mcap recover|rosbag reindex|sqlite3)"):
        open_drive(bag).scans[-1].read()


def test_messages_that_are_in_a_log_beside_the_bag_are_not_lost(tmp_path: Path) -> None:
    recorded = next(ros.write(tmp_path / "recorded", ros.drive(), "db3").glob("*.db3"))
    file, log = tmp_path / "killed.db3", tmp_path / "killed.db3-wal"
    with closing(sqlite3.connect(recorded)) as recorder:
        recorder.execute("PRAGMA journal_mode=WAL")
        recorder.execute("INSERT INTO messages (topic_id, timestamp, data) SELECT 1, 0, zeroblob(9)")
        recorder.commit()
        shutil.copy(recorded, file)  # as after a recorder that was killed: one that ends empties the log
        shutil.copy(recorded.with_name(f"{recorded.name}-wal"), log)
    with pytest.raises(DataError, match=r'killed.db3-wal: .*sqlite3 killed.db3 "PRAGMA wal_checkpoint'):
        open_drive(file)
    (tmp_path / "link.db3").symlink_to(file)
    with pytest.raises(DataError, match=r"killed\.db3-wal"):
        open_drive(tmp_path / "link.db3")
    with closing(sqlite3.connect(file)) as database:
        database.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        log.touch()  # an empty one holds nothing
        assert len(Bag(file).messages("/imu")) + len(Bag(file).messages("/fix")) == 207


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


@pytest.mark.parametrize(
    ("record", "at", "number"),
    [
        pytest.param(0x08, 9 + 16, 2**64 - 1, id="a place that 64 bits with a sign do not hold"),
        pytest.param(0x08, 1, 2**62, id="a record that no memory holds"),
        pytest.param(0x07, 9 + 6 + 8, 2**63 - 1, id="a message beyond the largest place of a file"),
    ],
)
def test_a_wild_number_in_an_mcap_is_refused(
    plain: Path, tmp_path: Path, record: int, at: int, number: int
) -> None:
    content = bytearray(next(plain.glob("*.mcap")).read_bytes())
    [summary] = struct.unpack_from("<Q", content, len(content) - 37 + 9)
    start = chunk_index(content, summary)
    if record == 0x07:  # the index of messages is behind its chunk
        start = sum(struct.unpack_from("<QQ", content, start + 9 + 16))
    assert content[start] == record
    struct.pack_into("<Q", content, start + at, number)
    (tmp_path / "wild.mcap").write_bytes(content)
    with pytest.raises(DataError, match=r"wild\.mcap: .*damaged.*mcap recover"):
        read_all(tmp_path / "wild.mcap")


@pytest.mark.parametrize(("command", "storage"), [("inspect", "mcap"), ("inspect", "bag"), ("check", "db3")])
def test_a_command_says_in_one_line_that_a_bag_is_truncated(
    tmp_path: Path, command: str, storage: str
) -> None:
    name = "drive.bag" if storage == "bag" else "drive"
    bag = ros.write(tmp_path / name, ros.drive(storage == "bag"), storage)
    damaged(bag, lambda content: content[: len(content) // 3])
    done = gnss_sem_map(command, bag)
    assert (done.returncode, done.stdout) == (1, "")
    assert len(done.stderr.splitlines()) == 1
    assert "truncated" in done.stderr
    assert not (tmp_path / "rig.yaml").exists()


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


@pytest.mark.parametrize("storage", ["mcap", "db3", "bag"])
def test_every_flipped_byte_is_an_error_or_a_value(tmp_path: Path, storage: str) -> None:
    """Nothing but our own errors, whatever the bytes of a message or of the index are."""
    written = ros.write(
        tmp_path / ("bag.bag" if storage == "bag" else "bag"), ros.drive(storage == "bag"), storage
    )
    content = (written if written.is_file() else next(written.glob(f"*.{storage}"))).read_bytes()
    rng = np.random.default_rng(1)
    file = tmp_path / f"drive.{storage}"
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
        match=r"no fixed transform leads from 'lidar' to 'imu' \(frames of fixed transforms: none\)",
    ):
        open_drive(bag)
    rig = ros.drive(frames=False)
    rig.transforms(("imu", "base", (0, 0, 0)), ("base", "lidar", (0, 0, 0)), ("lidar", "imu", (0, 0, 0)))
    with pytest.raises(DataError, match=r"a circle of frames, .*; expected a tree"):
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


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", r"empty \(0 bytes\); copy or record it again"),
        (b"PK\3\4" + bytes(99), "of the kind .zip.*unpack it"),
        (b"\x89MCAP0\r\n" + bytes(99), r"rename it to drive\.mcap"),
    ],
)
def test_a_file_of_another_kind_is_not_called_damaged(tmp_path: Path, content: bytes, said: str) -> None:
    (tmp_path / "drive.bag").write_bytes(content)
    with pytest.raises(DataError, match=said):
        open_drive(tmp_path / "drive.bag")


@pytest.mark.parametrize("is_ros1", [True, False])
def test_endings_may_have_capital_letters(tmp_path: Path, is_ros1: bool) -> None:
    bag = tmp_path / ("drive.BAG" if is_ros1 else "drive.MCAP")
    if is_ros1:
        ros.write(tmp_path / "drive.bag", ros.drive(is_ros1), "bag").rename(bag)
    else:
        ros.write_mcap(bag, ros.drive(), "ros2")
    assert len(open_drive(bag).scans) == 10


def test_files_beside_a_bag_that_cannot_be_read_are_named_with_what_to_do(tmp_path: Path) -> None:
    bag = ros.write(tmp_path / "drive", ros.drive())
    (bag / "rig.yml").write_text("gnss: {topic: /other}\n")
    with pytest.raises(DataError, match=r"rig\.yml: .*rename it to rig\.yaml"):
        open_drive(bag)
    (bag / "rig.yml").unlink()
    (bag / "metadata.yaml").write_text("files: [a\n")
    with pytest.raises(DataError, match=r"metadata\.yaml: .*remove it"):
        open_drive(bag)


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


def test_a_part_that_the_recorder_did_not_close_is_not_passed_over(plain: Path, tmp_path: Path) -> None:
    folder = tmp_path / "drive"
    folder.mkdir()
    ros.write(folder / "drive_0.bag", ros.drive(is_ros1=True), "bag")
    assert open_drive(folder).skips == ()
    (folder / "drive_1.bag.active").write_bytes(b"")
    with pytest.raises(
        DataError, match=r"rosbag reindex drive_1.bag.active; mv drive_1.bag.active drive_1.bag"
    ):
        open_drive(folder)
    with pytest.raises(DataError, match=r"found a file, expected .* a file ending in .bag, .mcap, .db3"):
        open_drive(folder / "drive_1.bag.active")


def test_a_part_that_the_metadata_list_and_that_is_not_there_is_told(plain: Path, tmp_path: Path) -> None:
    bag = tmp_path / "drive"
    shutil.copytree(plain, bag)
    assert open_drive(bag).skips == ()
    about = (bag / "metadata.yaml").read_text()
    assert about.count("- drive.mcap") == 1
    (bag / "metadata.yaml").write_text(about.replace("- drive.mcap", "- drive.mcap\n  - parts/drive_1.mcap"))
    assert open_drive(bag).skips == (
        Skip("part of the bag", "drive_1.mcap", "metadata.yaml lists it, and it is not there"),
    )


def test_a_bag_that_was_repaired_by_its_advice_is_a_drive(plain: Path, tmp_path: Path) -> None:
    """A repair leaves two files: the advice says what becomes of the damaged one."""
    bag, whole = tmp_path / "drive", next(plain.glob("*.mcap")).read_bytes()
    bag.mkdir()
    (bag / "drive.mcap").write_bytes(whole[:-40])
    (bag / "repaired.mcap").write_bytes(whole)
    with pytest.raises(DataError, match=r"-o repaired.mcap, and move drive.mcap to another folder"):
        open_drive(bag)
    (bag / "drive.mcap").rename(tmp_path / "drive.mcap")
    assert len(open_drive(bag).scans) == 10
