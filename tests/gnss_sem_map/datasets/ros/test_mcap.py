"""MCAP files of the format's own writer: of ROS 1 and ROS 2, whatever profile they name, and of other messages."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import ros
from mcap.writer import CompressionType, IndexType, Writer

from gnss_sem_map.datasets import open_drive
from gnss_sem_map.datasets.ros.bag import Bag
from gnss_sem_map.errors import DataError
from gnss_sem_map.sensor_log import SensorLog


def content(log: SensorLog) -> list[Any]:
    assert log.imu is not None
    assert log.gnss is not None
    points = [scan.read() for scan in log.scans]
    return [
        log.imu.stamps, log.imu.specific_force, log.gnss.positions, log.gnss.stddevs, log.calibration.T_imu_lidar,
        *(one.xyz for one in points), *(one.stamps for one in points), log.epoch_ns, log.skips,
    ]  # fmt: skip


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> list[Any]:
    return content(open_drive(ros.write(tmp_path_factory.mktemp("plain") / "drive", ros.drive())))


@pytest.mark.parametrize("is_ros1", [False, True])
@pytest.mark.parametrize(
    ("profile", "options"),
    [
        ("", {}),
        ("ros1", {"compression": CompressionType.LZ4}),
        ("ros2", {"use_statistics": False}),
        ("x-own", {"compression": CompressionType.NONE, "is_listed": False}),
    ],
)
def test_what_is_encoded_as_ros_is_read_whatever_the_profile_says(
    plain: list[Any], tmp_path: Path, is_ros1: bool, profile: str, options: dict[str, Any]
) -> None:
    file = ros.write_mcap(tmp_path / "drive.mcap", ros.drive(is_ros1), profile, **options)
    for one, other in zip(content(open_drive(file)), plain, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("name", ["sensor_msgs/Imu", "sensor_msgs/msg/Imu", "sensor_msgs::msg::Imu"])
@pytest.mark.parametrize("schema", ["ros2msg", "ros2idl", "omgidl"])
def test_types_have_one_name_however_they_are_written(tmp_path: Path, name: str, schema: str) -> None:
    file = foreign(tmp_path / "drive.mcap", "cdr", schema, name)
    assert Bag(file).kinds == {"/lidar": "sensor_msgs/msg/Imu"}


def foreign(path: Path, encoding: str, schema: str, kind: str, topic: str = "/lidar") -> Path:
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("")
        channel = writer.register_channel(topic, encoding, writer.register_schema(kind, schema, b"{}"))
        for k in range(3):
            writer.add_message(channel, ros.START_NS + k, b"{}", ros.START_NS + k)
        writer.finish()
    return path


@pytest.mark.parametrize(
    ("encoding", "schema", "kind"),
    [
        ("protobuf", "protobuf", "foxglove.PointCloud"),
        ("json", "jsonschema", "sensor_msgs/PointCloud2"),
        ("flatbuffer", "flatbuffer", "foxglove.CompressedImage"),
    ],
)
def test_what_is_not_of_ros_is_named_with_the_way_out(
    tmp_path: Path, encoding: str, schema: str, kind: str
) -> None:
    with pytest.raises(DataError, match=r"no messages of ROS but .*; expected .*CSV log") as error:
        open_drive(foreign(tmp_path / "drive.mcap", encoding, schema, kind))
    assert f"({encoding})" in str(error.value)
    assert "damaged" not in str(error.value)


def test_what_is_not_of_ros_beside_what_is_stays_unread(tmp_path: Path) -> None:
    folder = tmp_path / "drive"
    folder.mkdir()
    ros.write_mcap(folder / "a.mcap", ros.drive(), "")
    foreign(folder / "b.mcap", "json", "jsonschema", "sensor_msgs/msg/Imu", "/other")
    assert Bag(folder).kinds["/other"] == "sensor_msgs/msg/Imu (json)"
    assert len(open_drive(folder).scans) == 10


@pytest.mark.parametrize(
    "options", [{"use_chunking": False}, {"index_types": IndexType.NONE}, {"index_types": IndexType.CHUNK}]
)
def test_a_file_without_an_index_is_not_called_damaged(tmp_path: Path, options: dict[str, Any]) -> None:
    file = ros.write_mcap(tmp_path / "drive.mcap", ros.drive(), "ros2", **options)
    with pytest.raises(
        DataError, match=r"drive.mcap: not indexed .*mcap recover drive.mcap -o repaired.mcap"
    ):
        open_drive(file)
