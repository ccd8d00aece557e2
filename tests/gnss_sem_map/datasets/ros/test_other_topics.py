"""Receivers, IMUs, wheels and fixed transforms as drivers publish them give the log that the usual topics give."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import ros
from ros import START_NS, rig_yaml
from ros_drivers import EDGES, describe, fix_ns, force, gps_fix, joint, sentences, speeds, split_imu, urdf
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from gnss_sem_map.cli import app
from gnss_sem_map.datasets import open_drive, rosbag
from gnss_sem_map.datasets.ros.bag import Bag
from gnss_sem_map.datasets.ros.contents import contents_of, suggested_rig
from gnss_sem_map.datasets.ros.static_tf import read_static_transforms
from gnss_sem_map.errors import DataError
from gnss_sem_map.files.structured import parse_yaml
from gnss_sem_map.sensor_log import SensorLog


def without(topic: str, is_ros1: bool = False) -> ros.Rig:
    rig = ros.drive(is_ros1)
    rig.messages = [one for one in rig.messages if one[0] != topic]
    return rig


def written(path: Path, rig: ros.Rig) -> Path:
    return ros.write(path / ("drive.bag" if rig.is_ros1 else "drive"), rig, "bag" if rig.is_ros1 else "mcap")


def opened(path: Path, rig: ros.Rig, **about: object) -> SensorLog:
    bag = written(path, rig)
    if about:
        rig_yaml(bag, **about)
    return open_drive(bag)


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> SensorLog:
    return open_drive(written(tmp_path_factory.mktemp("plain"), ros.drive()))


# the receiver


def same_fixes(one: SensorLog, other: SensorLog, atol: float = 1e-6) -> None:
    assert one.gnss is not None
    assert other.gnss is not None
    np.testing.assert_allclose(
        one.epoch_ns + one.gnss.stamps * 1e9, other.epoch_ns + other.gnss.stamps * 1e9, atol=1e6
    )
    np.testing.assert_allclose(one.gnss.positions, other.gnss.positions, atol=atol)
    np.testing.assert_allclose(one.gnss.stddevs, other.gnss.stddevs, rtol=1e-6)
    np.testing.assert_allclose(one.calibration.p_imu_antenna, other.calibration.p_imu_antenna)


@pytest.mark.parametrize(
    ("is_ros1", "package"), [(True, "gps_common"), (False, "gps_msgs"), (False, "gps_common")]
)
@pytest.mark.parametrize(
    "told",
    [
        {},
        {  # gpsd and septentrio tell errors of 95 percent alone
            "position_covariance": np.zeros(9), "position_covariance_type": 0, "err_horz": 0.98, "err_vert": 1.96,
        },
    ],
)  # fmt: skip
def test_gps_fixes_are_fixes(
    tmp_path: Path, plain: SensorLog, is_ros1: bool, package: str, told: dict[str, Any]
) -> None:
    rig = without("/fix", is_ros1)
    for k in range(5):
        gps_fix(rig, k, package, **told)
    gps_fix(rig, 5, package, status=-1)
    log = opened(tmp_path, rig)
    same_fixes(log, plain)
    assert [skip.reason for skip in log.skips] == ["1 messages: no fix"]


@pytest.mark.parametrize("is_ros1", [True, False])
@pytest.mark.parametrize("late_s", [0.0, 0.08, 3600.0])
def test_sentences_of_a_receiver_are_its_fixes(
    tmp_path: Path, plain: SensorLog, is_ros1: bool, late_s: float
) -> None:
    """At their own times; on the clock of their stamps where that is another one."""
    rig = without("/fix", is_ros1)
    sentences(rig, late_ns=round(late_s * 1e9))
    log = opened(tmp_path, rig)
    assert log.gnss is not None
    assert plain.gnss is not None
    stamps = log.epoch_ns + np.round(log.gnss.stamps * 1e9).astype(np.int64)
    late_ns = stamps - [fix_ns(k) for k in range(5)]
    expected = round(late_s * 1e9) if late_s > 1 else 0
    np.testing.assert_allclose(late_ns - expected, 0, atol=5e6)  # of times in steps of 10 ms
    np.testing.assert_allclose(log.gnss.positions, plain.gnss.positions, atol=0.01)
    np.testing.assert_allclose(log.gnss.stddevs, plain.gnss.stddevs)
    assert [skip.what for skip in log.skips] == (["clock"] if late_s > 1 else [])


def test_sentences_in_strings_are_taken_where_the_rig_says_it(tmp_path: Path, plain: SensorLog) -> None:
    rig = without("/fix")
    sentences(rig, "std_msgs/msg/String")
    log = opened(tmp_path, rig, gnss={"topic": "/nmea_sentence", "p_imu_antenna": [0, 0, 0.8]})
    assert log.gnss is not None
    assert plain.gnss is not None
    np.testing.assert_allclose(log.gnss.positions, plain.gnss.positions, atol=0.01)


def test_of_a_receiver_that_is_there_twice_the_fixes_are_taken(tmp_path: Path, plain: SensorLog) -> None:
    rig = ros.drive()
    sentences(rig)
    gps_fix(rig, 0, "gps_msgs")
    bag = written(tmp_path, rig)
    same_fixes(open_drive(bag), plain)
    rig = parse_yaml(suggested_rig(Bag(bag), contents_of(Bag(bag))))
    assert rig["gnss"]["topic"] == "/fix"


@pytest.mark.parametrize("kind", [0, 1, 2, 3])
@pytest.mark.parametrize("variance", [0.0, -1.0, np.nan])
def test_a_covariance_that_is_none_needs_stddevs(tmp_path: Path, kind: int, variance: float) -> None:
    rig = ros.drive()
    for topic, _, message in rig.messages:
        if topic == "/fix":
            message.position_covariance_type = kind
            message.position_covariance[:] = variance
    bag = written(tmp_path, rig)
    with pytest.raises(
        DataError, match=r"/fix: not one of 5 .*covariance is (unknown|not above).*gnss.stddevs_m"
    ):
        open_drive(bag)
    [notes] = [one.notes for one in contents_of(Bag(bag)) if one.name == "/fix"]
    assert notes[0].endswith("set stddevs_m")
    rig_yaml(bag, gnss={"topic": "/fix", "stddevs_m": [0.5, 0.5, 1.0]})
    log = open_drive(bag)
    assert log.gnss is not None
    np.testing.assert_array_equal(log.gnss.stddevs, np.tile([0.5, 0.5, 1.0], (5, 1)))


# the IMU


@pytest.mark.parametrize("is_ros1", [True, False])
@pytest.mark.parametrize("kind", [ros.IMU, "geometry_msgs/msg/Vector3Stamped"])
def test_a_gyroscope_and_an_accelerometer_are_an_imu(tmp_path: Path, is_ros1: bool, kind: str) -> None:
    """Forces are linear between those that were measured, at the times of the turn rates."""
    rig = without("/imu", is_ros1)
    split_imu(rig, kind)
    said = {"imu": {"topic": "/gyro/sample", "force_topic": "/accel/sample"}}
    log = opened(tmp_path, rig, **{} if kind == ros.IMU else said)
    assert log.imu is not None
    stamps = log.imu.stamps + (log.epoch_ns - START_NS) * 1e-9
    assert len(stamps) in (201, 202)
    np.testing.assert_allclose(log.imu.specific_force, force(stamps), atol=1e-6)
    np.testing.assert_allclose(log.imu.angular_rate, np.tile([0, 0, 0.01], (len(stamps), 1)))
    np.testing.assert_allclose(log.calibration.T_imu_lidar[:3, 3], [1.0, 0.0, 0.5])


def test_turn_rates_without_forces_near_them_are_counted(tmp_path: Path) -> None:
    rig = without("/imu")
    split_imu(rig, until_s=1.5)
    rig.messages = [
        one for one in rig.messages if one[0] != "/accel/sample" or not 0.5e9 < one[1] - START_NS < 0.8e9
    ]
    log = opened(tmp_path, rig)
    assert log.imu is not None
    stamps = log.imu.stamps + (log.epoch_ns - START_NS) * 1e-9
    np.testing.assert_allclose(log.imu.specific_force, force(stamps), atol=1e-6)
    assert not ((stamps > 0.52) & (stamps < 0.79)).any()
    [skip] = [skip for skip in log.skips if "without a force" in skip.reason]
    assert skip.frames == 202 - len(stamps)


def test_with_poses_in_a_file_the_ends_of_both_parts_are_enough(tmp_path: Path) -> None:
    rig = without("/imu")
    split_imu(rig)
    bag = written(tmp_path, rig)
    log = rosbag.read(bag, with_imu=False)
    assert log.imu is not None
    assert len(log.imu) == 2
    assert len(log.scans) == 10


def test_inspect_suggests_both_parts_of_an_imu(tmp_path: Path) -> None:
    rig = without("/imu")
    split_imu(rig)
    bag = written(tmp_path, rig)
    topics = contents_of(Bag(bag))
    assert {one.name: one.taken_for for one in topics if "sample" in one.name} == {
        "/gyro/sample": "gyroscope", "/accel/sample": "accelerometer",
    }  # fmt: skip
    about = parse_yaml(suggested_rig(Bag(bag), topics))["imu"]
    assert about == {"topic": "/gyro/sample", "force_topic": "/accel/sample"}


def test_a_whole_imu_beside_parts_of_another_is_the_imu(tmp_path: Path, plain: SensorLog) -> None:
    rig = ros.drive()
    split_imu(rig)
    log = opened(tmp_path, rig)
    assert log.imu is not None
    assert plain.imu is not None
    np.testing.assert_array_equal(log.imu.specific_force, plain.imu.specific_force)


# the wheels


@pytest.mark.parametrize("is_ros1", [True, False])
@pytest.mark.parametrize(
    "kind",
    [
        "nav_msgs/msg/Odometry", "geometry_msgs/msg/TwistStamped", "geometry_msgs/msg/TwistWithCovarianceStamped",
        "geometry_msgs/msg/Twist", "std_msgs/msg/Float32", "std_msgs/msg/Float64",
        "autoware_auto_vehicle_msgs/msg/VelocityReport", "autoware_vehicle_msgs/msg/VelocityReport",
    ],
)  # fmt: skip
def test_speeds_of_any_type_are_those_of_the_wheels(tmp_path: Path, is_ros1: bool, kind: str) -> None:
    rig = ros.drive(is_ros1)
    speeds(rig, kind, 3.6)
    log = opened(tmp_path, rig, wheels={"topic": "/speed"}, speed_unit="km/h")
    log = log.in_our_conventions(log.conventions) if log.conventions else log
    assert log.wheels is not None
    stamps = log.wheels.stamps + (log.epoch_ns - START_NS) * 1e-9
    np.testing.assert_allclose(stamps, np.arange(40) * 0.05, atol=1e-6)
    np.testing.assert_allclose(log.wheels.speeds, 1.0 + 0.1 * np.arange(40), rtol=1e-6)


def test_wheels_are_suggested_and_not_taken_unasked(tmp_path: Path) -> None:
    rig = ros.drive()
    speeds(rig, "nav_msgs/msg/Odometry")
    bag = written(tmp_path, rig)
    text = suggested_rig(Bag(bag), contents_of(Bag(bag)))
    assert "\n# wheels: {topic: /speed}" in text
    assert open_drive(bag).wheels is None
    (bag / "rig.yaml").write_text(text.replace("# wheels", "wheels"))
    assert open_drive(bag).wheels is not None
    rig_yaml(bag, wheels={"topic": "/imu"})
    with pytest.raises(
        DataError, match=r"wheels: /imu is of sensor_msgs/msg/Imu, expected nav_msgs/msg/Odometry or"
    ):
        open_drive(bag)


# fixed transforms


def same_poses(log: SensorLog, plain: SensorLog) -> None:
    np.testing.assert_array_equal(log.calibration.T_imu_lidar, plain.calibration.T_imu_lidar)
    np.testing.assert_array_equal(log.calibration.p_imu_antenna, plain.calibration.p_imu_antenna)


def moved(rig: ros.Rig, topic: str, kind: str | None = None) -> None:
    """The transforms of a rig in another topic."""
    [[_, ns, message]] = [one for one in rig.messages if one[0] == "/tf_static"]
    if kind is not None:
        message = rig.make(kind, transforms=message.transforms)
    rig.messages = [one for one in rig.messages if one[0] != "/tf_static"]
    rig.messages += [(topic, ns + k * 100_000_000, message) for k in range(1 if "static" in topic else 5)]


@pytest.mark.parametrize("is_ros1", [True, False])
@pytest.mark.parametrize(
    ("topic", "kind"),
    [
        ("/robot/tf_static", None), ("/a/b/tf_static", None), ("/tf", None), ("/robot/tf", None),
        ("/tf", "tf/msg/tfMessage"),
    ],
)  # fmt: skip
def test_fixed_transforms_are_found_in_any_topic(
    tmp_path: Path, plain: SensorLog, is_ros1: bool, topic: str, kind: str | None
) -> None:
    rig = ros.drive(is_ros1)
    moved(rig, topic, kind)
    same_poses(opened(tmp_path, rig), plain)


def test_transforms_that_change_are_not_fixed(tmp_path: Path) -> None:
    rig = ros.drive(frames=False)
    for k in range(9):
        rig.transforms(("odom", "base", (0.1 * k, 0.0, 0.0)), ("base", "imu", (1.0, 0.0, 0.0)))
        rig.messages[-1] = ("/tf", START_NS + k, rig.messages[-1][2])
    found = read_static_transforms(Bag(written(tmp_path, rig)))
    assert found.frames == ["base", "imu"]


@pytest.mark.parametrize("is_ros1", [True, False])
@pytest.mark.parametrize("topic", ["/robot_description", "/robot/robot_description"])
def test_fixed_joints_of_a_robot_are_fixed_transforms(
    tmp_path: Path, plain: SensorLog, is_ros1: bool, topic: str
) -> None:
    rig = ros.drive(is_ros1, frames=False)
    moving = joint("base", "wheel", (0.0, 0.0, 0.0)).replace("fixed", "continuous")
    describe(rig, urdf(*(joint(*edge) for edge in EDGES), moving), topic)
    bag = written(tmp_path, rig)
    same_poses(open_drive(bag), plain)
    assert "wheel" not in read_static_transforms(Bag(bag)).frames
    assert {one.name: one.taken_for for one in contents_of(Bag(bag))}[topic] == "transforms"


def test_a_joint_turns_about_the_fixed_axes_of_its_parent(tmp_path: Path) -> None:
    rig = ros.Rig()
    rig.imu(START_NS)
    describe(rig, urdf(joint("imu", "lidar", (1.0, 2.0, 3.0), 'rpy="0.1 -0.2 0.3"')))
    T = read_static_transforms(Bag(written(tmp_path, rig))).between("imu", "lidar")
    assert T is not None
    np.testing.assert_allclose(
        T[:3, :3], Rotation.from_euler("ZYX", [0.3, -0.2, 0.1]).as_matrix(), atol=1e-12
    )
    np.testing.assert_array_equal(T[:3, 3], [1.0, 2.0, 3.0])


@pytest.mark.parametrize(
    "text",
    [
        "no xml",
        '<!DOCTYPE robot [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;">]>' + urdf(joint(*EDGES[0])),
        urdf(joint(*EDGES[0]).replace("1.0", "one")),
        urdf(joint(*EDGES[0]).replace("1.0 0.0 0.0", "1.0")),
        "<a>" * 500_000,
    ],
    ids=["no XML", "entities", "no number", "one number", "depth"],
)
def test_what_is_no_robot_has_no_joints(tmp_path: Path, text: str) -> None:
    rig = ros.Rig()
    rig.imu(START_NS)
    describe(rig, text)
    assert read_static_transforms(Bag(written(tmp_path, rig))).frames == []


def test_static_transforms_count_where_a_robot_says_otherwise(tmp_path: Path, plain: SensorLog) -> None:
    rig = ros.drive()
    describe(rig, urdf(*(joint(parent, child, (9.0, 9.0, 9.0)) for parent, child, _ in EDGES)))
    same_poses(opened(tmp_path, rig), plain)


def test_a_robot_with_another_tree_than_the_static_transforms_does_no_harm(
    tmp_path: Path, plain: SensorLog
) -> None:
    """Its parents are the children of the others: together they are a circle."""
    rig = ros.drive()
    describe(rig, urdf(joint("lidar", "base", (9.0, 9.0, 9.0)), joint("base", "wheel", (0.0, 1.0, 0.0))))
    bag = written(tmp_path, rig)
    same_poses(open_drive(bag), plain)
    with pytest.raises(DataError, match=r"a circle of frames, .*; give the poses"):
        read_static_transforms(Bag(bag)).between("wheel", "imu")


def test_inspect_lists_all_of_them(tmp_path: Path) -> None:
    rig = without("/fix")
    sentences(rig)
    speeds(rig, "nav_msgs/msg/Odometry")
    shown = CliRunner().invoke(app, ["inspect", str(written(tmp_path, rig))])
    assert shown.exit_code == 0
    assert "receiver             15" in shown.output
    assert "wheels               40" in shown.output
