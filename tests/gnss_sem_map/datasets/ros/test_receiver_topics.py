"""Velocity and heading in topics of their own are those of a table with the same numbers."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import ros
from ros import IMU, START_NS
from typer.testing import CliRunner

from factor_graphs.receiver_rows import velocities_of, with_more
from gnss_sem_map.cli import app
from gnss_sem_map.datasets import open_drive
from gnss_sem_map.datasets.ros.bag import Bag
from gnss_sem_map.datasets.ros.contents import contents_of, suggested_rig
from gnss_sem_map.datasets.ros.rig import Rig
from gnss_sem_map.errors import DataError
from gnss_sem_map.files.structured import parse_yaml
from gnss_sem_map.sensor_log import SensorLog

VELOCITIES = np.array([[1.0, 2.0, 0.1], [1.5, 2.5, -0.1], [2.0, 3.0, 0.2], [2.5, 3.5, 0.0], [3.0, 4.0, 0.3]])
HEADINGS = np.array([10.0, 100.0, 190.0, 280.0, 359.0])
STDDEVS, HEADING_STDDEV = np.array([0.02, 0.03, 0.05]), 0.5
SECOND = {"p_imu_antenna2": [1.0, 0.5, 0.8]}


def two_seconds(is_ros1: bool = False) -> ros.Rig:
    """IMU and fixes."""
    rig = ros.Rig(is_ros1)
    for k in range(201):
        rig.imu(START_NS + k * 10_000_000)
    for k in range(len(VELOCITIES)):
        rig.fix(stamp(k), east=float(k))
    rig.transforms(("imu", "antenna", (0.0, 0.0, 0.8)))
    return rig


def stamp(k: int) -> int:
    return START_NS + k * 400_000_000


def twist(rig: ros.Rig, velocities: Any = VELOCITIES, covariance: Any = None, topic: str = "/vel") -> None:
    for k, v in enumerate(velocities):
        made = rig.make("geometry_msgs/msg/Twist", linear=rig.vector(*v), angular=rig.vector(0.0, 0.0, 0.0))
        kind = "TwistStamped"
        if covariance is not None:
            whole = np.zeros((6, 6))
            whole[:3, :3] = covariance
            kind = "TwistWithCovarianceStamped"
            made = rig.make("geometry_msgs/msg/TwistWithCovariance", twist=made, covariance=whole.ravel())
        message = rig.make(f"geometry_msgs/msg/{kind}", header=rig.header(stamp(k), "antenna"), twist=made)
        rig.messages.append((topic, stamp(k), message))


def heading(rig: ros.Rig, kind: str, degrees: Any, variance: float = np.radians(HEADING_STDDEV) ** 2) -> None:
    for k, angle in enumerate(degrees):
        half = np.radians(angle) / 2
        turned = rig.make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=np.sin(half), w=np.cos(half))
        header = rig.header(stamp(k), "antenna")
        if kind == "std_msgs/msg/Float64":
            message = rig.make(kind, data=float(angle))
        elif kind == IMU:
            unknown, of_attitude = np.zeros(9), np.diag([1e3, 1e3, variance]).ravel()
            unknown[0] = -1.0
            message = rig.make(
                kind, header=header, orientation=turned, orientation_covariance=of_attitude,
                angular_velocity=rig.vector(0.0, 0.0, 0.0), angular_velocity_covariance=unknown,
                linear_acceleration=rig.vector(0.0, 0.0, 0.0), linear_acceleration_covariance=unknown,
            )  # fmt: skip
        else:
            message = rig.make(kind, header=header, quaternion=turned)
        rig.messages.append(("/heading", stamp(k), message))


def opened(path: Path, rig: ros.Rig, **gnss: object) -> SensorLog:
    bag = ros.write(path / ("bag.bag" if rig.is_ros1 else "bag"), rig, "bag" if rig.is_ros1 else "mcap")
    ros.rig_yaml(bag, imu={"topic": "/imu"}, gnss={"topic": "/fix"} | gnss)
    return open_drive(bag)


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> SensorLog:
    """The same as rows of gnss.csv."""
    log = tmp_path_factory.mktemp("table")
    np.savetxt(
        log / "imu.csv", np.column_stack([np.arange(201) / 100, np.tile([0.1, 0, 9.81, 0, 0, 0.01], (201, 1))]),
        delimiter=",", header="stamp_s,ax,ay,az,wx,wy,wz", comments="",
    )  # fmt: skip
    n = len(VELOCITIES)
    rows = np.column_stack([
        np.arange(n) * 0.4, np.full(n, 49.0), 8.4 + np.arange(n) * 1e-5, np.full(n, 115.0),
        np.tile([0.5, 0.5, 1.0], (n, 1)), VELOCITIES, np.tile(STDDEVS, (n, 1)), HEADINGS, np.full(n, HEADING_STDDEV),
    ])  # fmt: skip
    header = (
        "stamp_s,lat_deg,lon_deg,alt_m,std_e_m,std_n_m,std_u_m,ve_mps,vn_mps,vu_mps,std_ve_mps,std_vn_mps,"
    )
    np.savetxt(
        log / "gnss.csv", rows, delimiter=",", header=header + "std_vu_mps,heading_deg,std_heading_deg",
        comments="", fmt="%.12g",
    )  # fmt: skip
    about = {"epoch_ns": START_NS, "p_imu_antenna": [0.0, 0.0, 0.8], **SECOND}
    (log / "log.yaml").write_text(json.dumps(about))
    return open_drive(log)


@pytest.mark.parametrize("is_ros1", [False, True])
@pytest.mark.parametrize("axes", ["enu", "ned"])
def test_velocities_of_a_topic_are_those_of_the_table(
    is_ros1: bool, axes: str, table: SensorLog, tmp_path: Path
) -> None:
    rig, order = two_seconds(is_ros1), [0, 1, 2] if axes == "enu" else [1, 0, 2]
    signs = [1, 1, 1 if axes == "enu" else -1]
    twist(rig, VELOCITIES[:, order] * signs, np.diag(STDDEVS[order] ** 2))
    found = opened(tmp_path, rig, velocity={"topic": "/vel", "axes": axes}).velocities
    assert found is not None
    assert table.velocities is not None
    for name in ("stamps", "velocities", "stddevs"):
        np.testing.assert_allclose(getattr(found, name), getattr(table.velocities, name), atol=1e-9)


@pytest.mark.parametrize(
    ("kind", "degrees"),
    [
        (IMU, 90 - HEADINGS),
        ("geometry_msgs/msg/QuaternionStamped", HEADINGS),
        ("std_msgs/msg/Float64", HEADINGS),
    ],
)
def test_headings_of_a_topic_are_those_of_the_table(
    kind: str, degrees: Any, table: SensorLog, tmp_path: Path
) -> None:
    """ublox writes an Imu in east, north, up; nmea_navsat_driver a quaternion turned by the angle from north."""
    rig = two_seconds()
    heading(rig, kind, degrees)
    found = opened(tmp_path, rig, heading={"topic": "/heading"}, **SECOND).headings
    assert found is not None
    assert table.headings is not None
    np.testing.assert_allclose(found.stamps, table.headings.stamps, atol=1e-9)
    np.testing.assert_allclose(np.exp(1j * found.azimuths), np.exp(1j * table.headings.azimuths), atol=1e-9)
    np.testing.assert_allclose(found.baseline, table.headings.baseline)
    if kind == IMU:  # others do not tell how good they are
        np.testing.assert_allclose(found.stddevs, table.headings.stddevs)


def test_axes_of_a_heading_that_are_given_count(tmp_path: Path) -> None:
    rig = two_seconds()
    heading(rig, "std_msgs/msg/Float64", 90 - HEADINGS)
    found = opened(tmp_path, rig, heading={"topic": "/heading", "axes": "enu"}).headings
    assert found is not None
    np.testing.assert_allclose(
        np.exp(1j * found.azimuths), np.exp(1j * np.radians(HEADINGS)), atol=1e-6
    )  # north turns by 1e-7 over the metres between the fixes


def test_a_velocity_that_says_nothing_of_up_or_of_its_noise_is_level(tmp_path: Path) -> None:
    """As nmea_navsat_driver writes it."""
    rig = two_seconds()
    twist(rig, VELOCITIES * [1, 1, 0])
    found = opened(tmp_path, rig, velocity={"topic": "/vel"}).velocities
    assert found is not None
    assert found.stddevs.tolist() == [[0.1, 0.1, 1000.0]] * len(VELOCITIES)


def test_a_velocity_without_noise_among_others_is_left_out(table: SensorLog) -> None:
    """Of a receiver that tells it of the other rows."""
    rows = with_more(
        np.column_stack([np.arange(3.0), np.tile([49.0, 8.4, 115.0, 1, 1, 1], (3, 1))]),
        velocities=VELOCITIES[:3], velocity_stddevs=np.array([[0.1] * 3, [np.nan] * 3, [0.1] * 3]),
    )  # fmt: skip
    assert table.frame is not None
    found, repairs = velocities_of(rows, table.frame)
    assert found is not None
    assert repairs is not None
    assert (found.stamps.tolist(), repairs.dropped) == ([0.0, 2.0], 1)


def test_what_is_no_velocity_or_heading_is_counted(tmp_path: Path) -> None:
    rig = two_seconds()
    broken = VELOCITIES.copy()
    broken[1] = np.nan
    twist(rig, broken, np.full((3, 3), 0.04))
    heading(rig, IMU, HEADINGS, variance=1e3)
    log = opened(tmp_path, rig, velocity={"topic": "/vel"}, heading={"topic": "/heading"})
    assert log.velocities is not None
    assert len(log.velocities) == len(VELOCITIES) - 1
    assert log.headings is None
    told = {(skip.what, skip.where): (skip.frames, skip.reason) for skip in log.skips}
    assert told["covariance", "/vel"][0] == len(VELOCITIES)
    assert "not positive definite" in told["covariance", "/vel"][1]
    assert told["heading", "/heading"] == (len(HEADINGS), "5 messages: no heading")


def test_a_topic_that_is_neither_is_refused(tmp_path: Path) -> None:
    with pytest.raises(
        DataError, match=r"gnss.velocity: /fix is of sensor_msgs/msg/NavSatFix, expected geometry"
    ):
        opened(tmp_path, two_seconds(), velocity={"topic": "/fix"})


def test_inspect_names_them_and_does_not_take_them(tmp_path: Path) -> None:
    rig = two_seconds()
    twist(rig, covariance=np.eye(3))
    heading(rig, IMU, HEADINGS)
    bag = ros.write(tmp_path / "bag", rig)
    topics = contents_of(Bag(bag))
    taken = {topic.name: topic.taken_for for topic in topics}
    assert (taken["/vel"], taken["/heading"], taken["/imu"]) == ("velocity", "heading", "IMU")
    text = suggested_rig(Bag(bag), topics)
    assert "\n  # velocity: {topic: /vel}" in text
    assert "\n  # heading: {topic: /heading}" in text
    about = Rig.model_validate(parse_yaml(text.replace("  # velocity", "  velocity")))
    assert about.gnss is not None
    assert about.gnss.velocity is not None
    assert about.gnss.velocity.topic == "/vel"
    shown = CliRunner().invoke(app, ["inspect", str(bag), "-o", str(tmp_path / "rig.yaml")])
    assert "velocity" in shown.stdout
    ros.rig_yaml(bag, imu={"topic": "/imu"})
    assert open_drive(bag).velocities is None
