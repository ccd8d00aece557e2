"""Bags of ROS 1 and ROS 2: what is in them arrives, from any storage and any driver."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import ros
from ros import START_NS, rig_yaml, sweep
from scipy.spatial.transform import Rotation

from gnss_sem_map.datasets import detect_format, open_drive
from gnss_sem_map.errors import DataError
from gnss_sem_map.sensor_log import SensorLog
from gnss_sem_map.sensor_log.conventions import SensorConventions

TIMES = np.linspace(-0.05, 0.05, 64)


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


@pytest.mark.parametrize("nothing", [0.0, np.nan])
@pytest.mark.parametrize("time", [0.0, np.nan, 9.9])
@pytest.mark.parametrize("zero_s", [0.0, START_NS * 1e-9])
def test_rows_without_a_return_have_any_time(
    tmp_path: Path, nothing: float, time: float, zero_s: float
) -> None:
    table = sweep(zero_s + TIMES, "<f8", "timestamp")
    lost = np.arange(len(table)) % 3 < 2
    table["timestamp"][lost] = time
    for axis in "xyz":
        table[axis] = np.where(lost, nothing, 7.0)
    rig = ros.drive()
    rig.messages = [one for one in rig.messages if one[0] != "/points"]
    rig.cloud(START_NS, table)
    [scan] = open_drive(ros.write(tmp_path / "drive", rig)).scans
    points = scan.read()
    assert points.stamps is not None
    np.testing.assert_allclose((points.stamps - scan.stamp)[~lost], TIMES[~lost], atol=5e-7)
    np.testing.assert_array_equal(points.xyz[~lost], 7.0)


@pytest.mark.parametrize("kind", ["<f4", "u1", "<u2"])
def test_intensities_have_the_scale_that_the_rig_says(tmp_path: Path, kind: str) -> None:
    fields = [(name, "<f4") for name in "xyz"]
    table = np.ones(5, [*fields, ("intensity", kind), ("time", "<f4")])
    table["intensity"], table["time"] = [0, 1, 17, 100, 200], np.linspace(0, 0.1, 5)
    rig = ros.drive()
    rig.messages = [one for one in rig.messages if one[0] != "/points"]
    rig.cloud(START_NS, table)
    bag = ros.write(tmp_path / "drive", rig)
    rig_yaml(bag, lidars={"lidar": {"topic": "/points", "intensity_max": 200}})
    points = open_drive(bag).scans[0].read()
    np.testing.assert_allclose(points.intensity, np.array([0, 1, 17, 100, 200]) / 200, rtol=1e-6)
    np.testing.assert_array_equal(points.rows.reshape(-1, 4)[:, 3], points.intensity)
    rig_yaml(bag, lidars={"lidar": {"topic": "/points", "intensity_max": 0}})
    with pytest.raises(DataError, match=r"lidars\.lidar\.intensity_max: Input should be greater than 0"):
        open_drive(bag)


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


@pytest.mark.parametrize("in_rig", [True, False])
def test_the_attitude_of_a_unit_with_axes_of_its_own_becomes_that_of_ours(
    tmp_path: Path, in_rig: bool
) -> None:
    said = {"imu_axes": "frd", "imu_rotation_deg": [3.0, -7.0, 20.0]}
    rig, unit = ros.drive(), Rotation.from_euler("ZYX", [1.0, 0.2, 3.1])
    for topic, _, message in rig.messages:
        if topic == "/imu":
            q = message.orientation
            q.x, q.y, q.z, q.w = unit.as_quat()
            message.orientation_covariance[[0, 4, 8]] = [0.01, 0.04, 0.09]
    bag = ros.write(tmp_path / "drive", rig)
    rig_yaml(bag, imu={"topic": "/imu", "attitude": True}, **said if in_rig else {})
    theirs = open_drive(bag)
    ours = theirs.in_our_conventions(
        SensorConventions() if in_rig else SensorConventions.model_validate(said)
    )
    assert theirs.imu is not None
    assert ours.imu is not None
    assert ours.initial_attitude is not None
    R, variances = ours.initial_attitude.R_map_imu, ours.initial_attitude.stddevs**2
    in_map = theirs.imu.specific_force @ unit.as_matrix().T
    np.testing.assert_allclose(ours.imu.specific_force @ R.T, in_map, atol=1e-9)
    turn = R.T @ unit.as_matrix()
    np.testing.assert_allclose(variances, np.diag(turn @ np.diag([0.01, 0.04, 0.09]) @ turn.T), atol=1e-9)


def test_scans_alone_with_a_trajectory_in_unix_time(tmp_path: Path) -> None:
    """Without an IMU the poses are those of the LiDAR."""
    bag = ros.write(tmp_path / "drive", ros.drive(), keep=lambda message: message[0] == "/points")
    with pytest.raises(DataError, match="found no topic of an IMU"):
        open_drive(bag)
    poses = [f"{ros.START_NS * 1e-9 + 0.1 * k:.6f} {k} 0 0 0 0 0 1" for k in range(15)]
    (tmp_path / "poses.tum").write_text("\n".join(poses))
    log = open_drive(bag, trajectory=tmp_path / "poses.tum")
    assert log.epoch_ns == ros.START_NS
    assert "Unix time" in log.given_how
    assert log.frame is None
    np.testing.assert_array_equal(log.calibration.T_imu_lidar, np.eye(4))
    assert [scan.number for scan in log.scans] == list(range(8))
    assert sum(skip.frames for skip in log.skips if skip.what == "scan") == 2
    assert log.given is not None
    np.testing.assert_allclose(log.given.at([0.55])[0, :3, 3], [5.5, 0, 0], atol=1e-5)
