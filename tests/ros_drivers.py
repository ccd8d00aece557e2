"""Messages of drivers that say the same as the usual ones of `ros.drive`, in other types and topics."""

from __future__ import annotations

from functools import reduce
from operator import xor
from typing import Any

import numpy as np
import ros
from ros import START_NS, sweep


def fix_ns(k: int) -> int:
    return START_NS + 3_000_000 + k * 400_000_000


def gps_fix(rig: ros.Rig, k: int, package: str, **other: Any) -> None:
    header = rig.header(fix_ns(k), "antenna")
    status: dict[str, Any] = dict.fromkeys(
        ("satellites_used", "satellites_visible", "status", "motion_source", "orientation_source", "position_source"), 0
    ) | {
        name: np.zeros(2, np.int32)
        for name in (
            "satellite_used_prn", "satellite_visible_prn", "satellite_visible_z", "satellite_visible_azimuth",
            "satellite_visible_snr",
        )
    }  # fmt: skip
    names = "track speed climb pitch roll dip time gdop pdop hdop vdop tdop err err_horz err_vert err_track err_speed"
    numbers = dict.fromkeys(
        [*names.split(), "err_climb", "err_time", "err_pitch", "err_roll", "err_dip"], 0.0
    )
    if "status" in other:
        status["status"] = other.pop("status")
    about = {
        "header": header, "status": rig.make(f"{package}/msg/GPSStatus", header=header, **status), "latitude": 49.0,
        "longitude": 8.4 + k * 1e-5, "altitude": 115.0, "position_covariance_type": 2,
        "position_covariance": np.diag([0.25, 0.25, 1.0]).ravel(),
    }  # fmt: skip
    message = rig.make(f"{package}/msg/GPSFix", **numbers | about | other)
    rig.messages.append(("/gps", fix_ns(k), message))


def sentence(body: str) -> str:
    return f"${body}*{reduce(xor, body.encode()):02X}\r\n"


def sentences(rig: ros.Rig, kind: str = "nmea_msgs/msg/Sentence", late_ns: int = 0) -> None:
    for k in range(5):
        moment = np.datetime64(fix_ns(k), "ns").astype("datetime64[ms]").item()
        clock, date = f"{moment:%H%M%S}.{moment.microsecond // 10000:02d}", f"{moment:%d%m%y}"
        lon = 8.4 + k * 1e-5
        for body in (
            f"GPRMC,{clock},A,4900.000000,N,00824.000000,E,0.0,0.0,{date},,,A",
            f"GPGST,{clock},1.0,,,,0.5,0.5,1.0",
            f"GPGGA,{clock},4900.000000,N,{8:03d}{(lon - 8) * 60:010.7f},E,4,12,0.8,67.0,M,48.0,M,,",
        ):
            ns = fix_ns(k) + late_ns
            header = {} if kind == "std_msgs/msg/String" else {"header": rig.header(ns, "antenna")}
            name = "sentence" if header else "data"
            rig.messages.append(("/nmea_sentence", ns, rig.make(kind, **header, **{name: sentence(body)})))


def force(seconds: Any) -> Any:
    return np.column_stack([0.1 + seconds, 0.0 * seconds, 9.81 - 0.5 * seconds])


def split_imu(rig: ros.Rig, kind: str = ros.IMU, until_s: float = 2.0) -> None:
    """A gyroscope at 100 Hz, and an accelerometer at 62.5 Hz from a little before on."""
    for topic, step_ns, first_ns in (
        ("/gyro/sample", 10_000_000, 0),
        ("/accel/sample", 16_000_000, -5_000_000),
    ):
        for k in range(int((until_s if "accel" in topic else 2.0) * 1e9 / step_ns) + 2):
            ns = START_NS + first_ns + k * step_ns
            vector = force(np.array([(ns - START_NS) * 1e-9]))[0] if "accel" in topic else [0.0, 0.0, 0.01]
            if kind == ros.IMU:
                rig.imu(ns, topic=topic)
                message = rig.messages[-1][2]
                measured, other = message.linear_acceleration, message.angular_velocity
                if "gyro" in topic:
                    measured, other = other, measured
                measured.x, measured.y, measured.z = (float(v) for v in vector)
                other.x = other.y = other.z = 0.0
            else:
                message = rig.make(kind, header=rig.header(ns, "imu"), vector=rig.vector(*map(float, vector)))
                rig.messages.append((topic, ns, message))


def speeds(rig: ros.Rig, kind: str, unit: float = 1.0) -> None:
    for k in range(40):
        ns, v = START_NS + k * 50_000_000, (1.0 + 0.1 * k) * unit
        header = rig.header(ns, "base")
        twist = rig.make(
            "geometry_msgs/msg/Twist", linear=rig.vector(v, 0.0, 0.0), angular=rig.vector(0, 0, 0.1)
        )
        covered = rig.make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36))
        if kind.endswith("Odometry"):
            point = rig.make("geometry_msgs/msg/Point", x=5.0, y=6.0, z=7.0)
            turn = rig.make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
            pose = rig.make("geometry_msgs/msg/Pose", position=point, orientation=turn)
            pose = rig.make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=np.zeros(36))
            message = rig.make(kind, header=header, child_frame_id="base", pose=pose, twist=covered)
        elif kind.endswith("VelocityReport"):
            message = rig.make(
                kind, header=header, longitudinal_velocity=v, lateral_velocity=0.0, heading_rate=0.1
            )
        elif "Float" in kind:
            message = rig.make(kind, data=v)
        elif kind.endswith("/Twist"):
            message = twist
        else:
            message = rig.make(kind, header=header, twist=covered if "Covariance" in kind else twist)
        rig.messages.append(("/speed", ns, message))


EDGES = (
    ("base", "imu", (1.0, 0.0, 0.0)),
    ("base", "lidar", (2.0, 0.0, 0.5)),
    ("imu", "antenna", (0.0, 0.0, 0.8)),
)


def urdf(*joints: str) -> str:
    return f'<?xml version="1.0"?>\n<!-- of xacro --><robot name="car"><link name="base"/>{"".join(joints)}</robot>'


def joint(parent: str, child: str, xyz: tuple[float, float, float], more: str = "") -> str:
    place = " ".join(map(str, xyz))
    return (
        f'<joint name="{child}_joint" type="fixed"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{place}" {more}/></joint>'
    )


def describe(rig: ros.Rig, text: str, topic: str = "/robot_description") -> None:
    rig.messages.append((topic, START_NS, rig.make("std_msgs/msg/String", data=text)))


def livox(rig: ros.Rig, package: str, ns: int, table: np.ndarray, frame: str = "lidar") -> None:
    made = [
        rig.make(
            f"{package}/msg/CustomPoint",
            offset_time=round(float(row["time"]) * 1e9), x=float(row["x"]), y=float(row["y"]), z=float(row["z"]),
            reflectivity=round(float(row["intensity"]) * 255), tag=16, line=3,
        )
        for row in table
    ]  # fmt: skip
    message = rig.make(
        f"{package}/msg/CustomMsg",
        header=rig.header(ns, frame), timebase=ns, point_num=len(made), lidar_id=1, rsvd=np.zeros(3, np.uint8),
        points=made,
    )  # fmt: skip
    rig.messages.append(("/livox/lidar", ns, message))


def small(is_ros1: bool) -> ros.Rig:
    """A drive of a few messages of every kind."""
    rig = ros.Rig(is_ros1)
    split_imu(rig, until_s=0.3)
    for k in range(3):
        gps_fix(rig, k, "gps_common" if is_ros1 else "gps_msgs")
        livox(rig, "livox_ros_driver2", START_NS + k * 100_000_000, sweep(np.linspace(0.0, 0.1, 20)))
        rig.image(START_NS + k, np.zeros((4, 6), np.uint8), "bayer_rggb8")
    sentences(rig)
    speeds(rig, "nav_msgs/msg/Odometry")
    rig.info(START_NS, model="kannala_brandt4", d=(0.1, 0.0, 0.0, 0.0))
    edges = (*EDGES, ("lidar", "camera", (0.0, 0.1, 0.2)))
    describe(rig, urdf(*(joint(*edge) for edge in edges)))
    rig.transforms(*EDGES[:1])
    rig.messages[-1] = ("/tf", START_NS, rig.messages[-1][2])
    return rig
