"""Clouds as drivers of LiDARs write them: any unit of times, any padding, Livox's own type; and packets, by name."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import ros
from ros import START_NS, rig_yaml, sweep
from ros_drivers import livox
from typer.testing import CliRunner

from gnss_sem_map.cli import app
from gnss_sem_map.datasets import open_drive
from gnss_sem_map.errors import DataError
from gnss_sem_map.sensor_log import SensorLog

TIMES = np.linspace(0.0, 0.1, 64)
STEP_NS = 100_000_000


def without_clouds(is_ros1: bool = False) -> ros.Rig:
    rig = ros.drive(is_ros1)
    rig.messages = [one for one in rig.messages if one[0] != "/points"]
    return rig


def opened(path: Path, rig: ros.Rig, **lidar: object) -> SensorLog:
    bag = ros.write(path / ("drive.bag" if rig.is_ros1 else "drive"), rig, "bag" if rig.is_ros1 else "mcap")
    if lidar:
        rig_yaml(bag, lidars={"lidar": {"topic": "/points"} | lidar})
    return open_drive(bag)


def check_times(log: SensorLog, count: int = 10) -> None:
    assert len(log.scans) == count
    for scan in log.scans:
        points = scan.read()
        assert points.stamps is not None
        np.testing.assert_allclose(points.stamps - scan.stamp, TIMES, atol=2e-6)


UNITS = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}


@pytest.mark.parametrize(
    ("name", "kind", "unit"),
    [
        *((name, kind, unit) for name, kind in (("time", "<f4"), ("time", "<f8")) for unit in UNITS),
        *(
            (name, kind, unit)
            for name, kind in (("t", "<u4"), ("offset_time", "<i4"))
            for unit in ("us", "ns")
        ),
    ],
)
def test_the_unit_of_times_after_the_stamp_is_that_in_which_sweeps_fill_the_time(
    tmp_path: Path, name: str, kind: str, unit: str
) -> None:
    rig = without_clouds()
    for k in range(10):
        rig.cloud(START_NS + k * STEP_NS, sweep(TIMES * UNITS[unit], kind, name))
    log = opened(tmp_path, rig)
    check_times(log)
    usual = "ns" if kind in ("<u4", "<i4") else "s"
    told = [skip for skip in log.skips if skip.what == "point times"]
    assert len(told) == (unit != usual)
    assert all(f"taken as {unit}" in skip.reason for skip in told)


@pytest.mark.parametrize("unit", UNITS)
def test_the_unit_of_unix_times_is_that_of_this_century(tmp_path: Path, unit: str) -> None:
    rig = without_clouds()
    for k in range(10):
        ns = START_NS + k * STEP_NS
        rig.cloud(ns, sweep((ns + np.round(TIMES * 1e9)) / (1e9 / UNITS[unit]), "<f8", "timestamp"))
    check_times(opened(tmp_path, rig))


@pytest.mark.parametrize("name", ["timestamp", "ts"])
def test_times_on_the_clock_of_the_stamps_are_absolute(tmp_path: Path, name: str) -> None:
    """As of a computer's uptime, or of simulated time."""
    rig = without_clouds()
    for k in range(10):
        uptime_ns = 5_000_000_000 + k * STEP_NS
        rig.cloud(START_NS + k * STEP_NS, sweep(uptime_ns * 1e-9 + TIMES, "<f8", name), header_ns=uptime_ns)
    check_times(opened(tmp_path, rig))


@pytest.mark.parametrize("value", [0.0, START_NS * 1e-9])
def test_one_time_for_all_points_is_none(tmp_path: Path, value: float) -> None:
    """Zero of drivers without times; Unix time as float32."""
    rig = without_clouds()
    for k in range(10):
        rig.cloud(START_NS + k * STEP_NS, sweep(np.full(64, value)))
    with pytest.raises(DataError, match=r"'time' is .* in all points .*`point_times:` .*`compensated`"):
        opened(tmp_path, rig)
    rig_yaml(tmp_path / "drive", lidars={"lidar": {"topic": "/points", "point_times": "compensated"}})
    assert open_drive(tmp_path / "drive").scans[0].read().stamps is None


def test_an_intensity_that_is_no_number_is_zero(tmp_path: Path) -> None:
    rig, table = without_clouds(), sweep(TIMES)
    table["intensity"][::2] = np.nan
    for k in range(10):
        rig.cloud(START_NS + k * STEP_NS, table)
    intensity = opened(tmp_path, rig).scans[0].read().intensity
    np.testing.assert_array_equal(intensity, np.nan_to_num(table["intensity"]))


@pytest.mark.parametrize("unit", ["us", "ms"])
def test_the_unit_is_a_setting(tmp_path: Path, unit: str) -> None:
    """Of sweeps of 5 ms, 100 ms apart, the numbers alone do not tell it."""
    rig = without_clouds()
    for k in range(10):
        rig.cloud(START_NS + k * STEP_NS, sweep(TIMES / 20 * UNITS[unit], "<f8", "delay"))
    for scan in opened(tmp_path, rig, point_times="delay", point_times_unit=unit).scans:
        points = scan.read()
        assert points.stamps is not None
        np.testing.assert_allclose(points.stamps - scan.stamp, TIMES / 20, atol=1e-9)
    rig_yaml(tmp_path / "drive", lidars={"lidar": {"topic": "/points", "point_times_unit": "min"}})
    with pytest.raises(DataError, match=r"point_times_unit: Input should be 's', 'ms', 'us' or 'ns'"):
        open_drive(tmp_path / "drive")


def test_clouds_without_returns_tell_nothing_of_the_unit(tmp_path: Path) -> None:
    rig = without_clouds()
    for k in range(10):
        table = sweep(TIMES * 1e6, "<u4", "t")
        if k % 5 < 2:
            for axis in "xyz":
                table[axis] = np.nan
        rig.cloud(START_NS + k * STEP_NS, table)
    rig.cloud(START_NS - STEP_NS, sweep(TIMES[:0], "<u4", "t"))
    log = opened(tmp_path, rig)
    assert [skip.reason[:11] for skip in log.skips if skip.what == "point times"] == ["taken as us"]


@pytest.mark.parametrize("row_step", [0, 1, 7, 20 * 64 + 5, 2**32 - 1])
def test_of_one_row_any_row_step_is_taken(tmp_path: Path, row_step: int) -> None:
    rig = without_clouds()
    for k in range(10):
        rig.cloud(START_NS + k * STEP_NS, sweep(TIMES), row_step=row_step)
    check_times(opened(tmp_path, rig))


@pytest.mark.parametrize("gap", [0, 4, 48])
@pytest.mark.parametrize("is_last_short", [False, True])
def test_rows_may_have_gaps_between_them(tmp_path: Path, gap: int, is_last_short: bool) -> None:
    rig = without_clouds()
    for k in range(10):
        table = sweep(TIMES)
        rows = np.frombuffer(table.tobytes(), np.uint8).reshape(4, -1)
        data = np.pad(rows, [(0, 0), (0, gap)], constant_values=99).ravel()
        data = data[: len(data) - gap] if is_last_short else data
        rig.cloud(START_NS + k * STEP_NS, table, height=4, width=16, row_step=rows.shape[1] + gap, data=data)
    check_times(opened(tmp_path, rig))


@pytest.mark.parametrize("other", ["", "reserved", "ring"])
def test_fields_that_are_not_read_may_have_one_name_or_any_type(tmp_path: Path, other: str) -> None:
    rig = without_clouds()
    for k in range(10):
        rig.cloud(START_NS + k * STEP_NS, sweep(TIMES))
        cloud = rig.messages[-1][2]
        for datatype, offset in ((2, 0), (2, 1), (0, 9999)):
            cloud.fields.append(
                rig.make("sensor_msgs/msg/PointField", name=other, offset=offset, datatype=datatype, count=0)
            )
    check_times(opened(tmp_path, rig))


def test_two_fields_of_one_name_that_is_read_are_refused(tmp_path: Path) -> None:
    rig = without_clouds()
    rig.cloud(START_NS, sweep(TIMES))
    cloud = rig.messages[-1][2]
    cloud.fields.append(cloud.fields[0])
    with pytest.raises(
        DataError, match=r"/points: message 0: found fields x, y, z, intensity, time, x, expected each of x"
    ):
        opened(tmp_path, rig).scans[0].read()


@pytest.mark.parametrize("is_ros1", [False, True])
@pytest.mark.parametrize("package", ["livox_ros_driver", "livox_ros_driver2", "livox_interfaces"])
@pytest.mark.parametrize("frame", ["lidar", "/lidar"])
def test_livox_messages_are_the_same_sweeps(tmp_path: Path, is_ros1: bool, package: str, frame: str) -> None:
    rig, plain = without_clouds(is_ros1), without_clouds(is_ros1)
    for k in range(5):
        table = sweep(TIMES)
        table["intensity"] = np.round(table["intensity"] * 255) / 255
        livox(rig, package, START_NS + k * STEP_NS, table, frame)
        plain.cloud(START_NS + k * STEP_NS, table)
    (tmp_path / "plain").mkdir()
    for one, other in zip(opened(tmp_path, rig).scans, opened(tmp_path / "plain", plain).scans, strict=True):
        ours, theirs = one.read(), other.read()
        np.testing.assert_array_equal(ours.xyz, theirs.xyz)
        np.testing.assert_allclose(ours.intensity, theirs.intensity, atol=1e-6)
        assert ours.stamps is not None
        assert theirs.stamps is not None
        np.testing.assert_allclose(ours.stamps, theirs.stamps, atol=1e-8)


def test_a_damaged_livox_message_is_refused(tmp_path: Path) -> None:
    rig = without_clouds()
    livox(rig, "livox_ros_driver2", START_NS, sweep(TIMES[:0]))
    with pytest.raises(DataError, match=r"/livox/lidar: message 0: found 0 points in \d+ bytes"):
        opened(tmp_path, rig).scans[0].read()


@pytest.mark.parametrize(
    ("kind", "driver"),
    [
        ("velodyne_msgs/msg/VelodyneScan", "velodyne_pointcloud"),
        ("ouster_sensor_msgs/msg/PacketMsg", "ouster_ros"),
        ("rslidar_msg/msg/RslidarPacket", "rslidar_sdk"),
        ("hesai_ros_driver/msg/UdpFrame", "hesai_ros_driver"),
        ("pandar_msgs/msg/PandarScan", "nebula"),
        ("nebula_msgs/msg/NebulaPackets", "nebula"),
    ],
)
def test_packets_are_named_with_the_driver_to_run(tmp_path: Path, kind: str, driver: str) -> None:
    rig = without_clouds()
    rig.messages += foreign(rig, kind, "/packets")
    log = open_drive(ros.write_mcap(tmp_path / "drive.mcap", rig, "ros2"))
    with pytest.raises(
        DataError, match=rf"no LiDAR scan.*/packets: packets of a LiDAR: play the bag, run .*{driver}"
    ):
        log.check_scans()
    rig_yaml(tmp_path / "drive.mcap", lidars={"top": {"topic": "/packets"}})
    with pytest.raises(DataError, match=rf"lidars.top: /packets is of {kind}, expected .*; .*run .*{driver}"):
        open_drive(tmp_path / "drive.mcap")
    shown = CliRunner().invoke(app, ["inspect", str(tmp_path / "drive.mcap")])
    assert driver in shown.output
    assert shown.exit_code == 0


def foreign(rig: ros.Rig, kind: str, topic: str) -> list[ros.Message]:
    """Messages of a type that is not known here: the real ones begin with a header, too."""
    from rosbags.typesys import get_types_from_msg

    from gnss_sem_map.datasets.ros.kinds import typestore

    store = typestore(rig.is_ros1)
    if kind not in store.fielddefs:
        store.register(get_types_from_msg("std_msgs/Header header\nuint8[] data\n", kind))
    made: Any = rig.make(kind, header=rig.header(START_NS, "lidar"), data=np.zeros(9, np.uint8))
    return [(topic, START_NS + k, made) for k in range(3)]


def test_messages_of_a_receiver_alone_are_named_with_the_topic_to_record(tmp_path: Path) -> None:
    rig = without_clouds()
    rig.messages = [one for one in rig.messages if one[0] != "/fix"]
    rig.messages += foreign(rig, "ublox_msgs/msg/NavPVT", "/ublox/navpvt")
    file = ros.write_mcap(tmp_path / "drive.mcap", rig, "ros2")
    with pytest.raises(DataError, match=r"no topic of a receiver .*; /ublox/navpvt: .*record the NavSatFix"):
        open_drive(file)


@pytest.mark.parametrize("kind", ["velodyne_msgs/msg/VelodyneScan", "my_msgs/msg/Whatever"])
@pytest.mark.parametrize("more", [[], ["--json"]])
def test_a_bag_of_which_nothing_is_read_says_so(tmp_path: Path, kind: str, more: list[str]) -> None:
    rig = ros.Rig()
    rig.messages += foreign(rig, kind, "/packets")
    file = ros.write_mcap(tmp_path / "drive.mcap", rig, "")
    shown = CliRunner().invoke(app, ["inspect", str(file), *more])
    assert shown.exit_code == 1
    assert "/packets" in shown.output
    assert "nothing of it is read" in str(shown.exception)
    assert kind in str(shown.exception)
    assert not (tmp_path / "rig.yaml").exists()
    with pytest.raises(DataError, match="nothing of it is read"):
        open_drive(file)
