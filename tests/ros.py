"""Bags of a few messages, written by `rosbags`, for tests of what is in bags."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2

from gnss_sem_map.datasets.ros.kinds import typestore

START_NS = 1_780_000_000_000_000_000
IMU, FIX, CLOUD = "sensor_msgs/msg/Imu", "sensor_msgs/msg/NavSatFix", "sensor_msgs/msg/PointCloud2"
XYZI = (("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"))
DATATYPES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}

Message = tuple[str, int, Any]
"""Topic, time of arrival in ns, message."""


def make(kind: str, is_ros1: bool = False, **fields: Any) -> Any:
    return typestore(is_ros1).types[kind](**fields)


@dataclass
class Rig:
    """Messages of one rig; what differs from a good one is given by name."""

    is_ros1: bool = False
    messages: list[Message] = field(default_factory=list)

    def make(self, kind: str, **fields: Any) -> Any:
        return make(kind, self.is_ros1, **fields)

    def header(self, ns: int, frame: str) -> Any:
        stamp = self.make("builtin_interfaces/msg/Time", sec=ns // 10**9, nanosec=ns % 10**9)
        more = {"seq": 0} if self.is_ros1 else {}
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame, **more)

    def vector(self, *xyz: float) -> Any:
        return self.make("geometry_msgs/msg/Vector3", x=xyz[0], y=xyz[1], z=xyz[2])

    def imu(self, ns: int, header_ns: int | None = None, topic: str = "/imu", frame: str = "imu") -> None:
        quaternion = self.make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
        message = self.make(
            IMU,
            header=self.header(ns if header_ns is None else header_ns, frame),
            orientation=quaternion,
            orientation_covariance=np.zeros(9),
            angular_velocity=self.vector(0.0, 0.0, 0.01),
            angular_velocity_covariance=np.zeros(9),
            linear_acceleration=self.vector(0.1, 0.0, 9.81),
            linear_acceleration_covariance=np.zeros(9),
        )
        self.messages.append((topic, ns, message))

    def fix(
        self,
        ns: int,
        status: int = 0,
        kind: int = 2,
        topic: str = "/fix",
        frame: str = "antenna",
        east: float = 0.0,
    ) -> None:
        message = self.make(
            FIX,
            header=self.header(ns, frame),
            status=self.make("sensor_msgs/msg/NavSatStatus", status=status, service=1),
            latitude=49.0,
            longitude=8.4 + east * 1e-5,
            altitude=115.0,
            position_covariance=np.diag([0.25, 0.25, 1.0]).ravel(),
            position_covariance_type=kind,
        )
        self.messages.append((topic, ns, message))

    def cloud(
        self,
        ns: int,
        table: NDArray[Any],
        header_ns: int | None = None,
        topic: str = "/points",
        frame: str = "lidar",
        **other: Any,
    ) -> None:
        dtype = table.dtype
        assert dtype.fields is not None
        fields = [
            self.make(
                "sensor_msgs/msg/PointField",
                name=name,
                offset=dtype.fields[name][1],
                datatype=DATATYPES[dtype.fields[name][0].str[1:]],
                count=1,
            )
            for name in dtype.names or ()
        ]
        about = {
            "height": 1, "width": len(table), "fields": fields, "is_bigendian": False, "point_step": dtype.itemsize,
            "row_step": dtype.itemsize * len(table), "data": np.frombuffer(table.tobytes(), np.uint8), "is_dense": True,
        }  # fmt: skip
        header = self.header(ns if header_ns is None else header_ns, frame)
        self.messages.append((topic, ns, self.make(CLOUD, header=header, **about | other)))

    def image(
        self,
        ns: int,
        pixels: NDArray[np.uint8],
        encoding: str,
        step: int | None = None,
        topic: str = "/image_rect",
    ) -> None:
        height, width = pixels.shape[:2]
        rows = np.zeros((height, step or pixels[0].size), np.uint8)
        rows[:, : pixels[0].size] = pixels.reshape(height, -1)
        message = self.make(
            "sensor_msgs/msg/Image",
            header=self.header(ns, "camera"), height=height, width=width, encoding=encoding, is_bigendian=0,
            step=rows.shape[1], data=rows.ravel(),
        )  # fmt: skip
        self.messages.append((topic, ns, message))

    def compressed(self, ns: int, content: bytes, topic: str = "/image_rect/compressed") -> None:
        message = self.make(
            "sensor_msgs/msg/CompressedImage",
            header=self.header(ns, "camera"), format="png", data=np.frombuffer(content, np.uint8),
        )  # fmt: skip
        self.messages.append((topic, ns, message))

    def info(
        self,
        ns: int,
        focal: float = 100.0,
        d: Sequence[float] = (0.0,) * 5,
        shift: float = 0.0,
        topic: str = "/camera_info",
        model: str = "plumb_bob",
    ) -> None:
        K = np.array([[focal, 0, 3.0 * (focal > 0)], [0, focal, 2.0 * (focal > 0)], [0, 0, float(focal > 0)]])
        P = np.column_stack([K, [shift, 0, 0]])
        names = ("K", "R", "P", "D") if self.is_ros1 else ("k", "r", "p", "d")
        values = dict(zip(names, (K.ravel(), np.eye(3).ravel(), P.ravel(), np.array(d)), strict=True))
        region = self.make(
            "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        message = self.make(
            "sensor_msgs/msg/CameraInfo",
            header=self.header(ns, "camera"), height=4, width=6, distortion_model=model, binning_x=0, binning_y=0,
            roi=region, **values,
        )  # fmt: skip
        self.messages.append((topic, ns, message))

    def transforms(self, *edges: tuple[str, str, tuple[float, float, float]]) -> None:
        """Parents, children and the children's places in their parents; all axes are parallel."""
        made = []
        for parent, child, place in edges:
            rotation = self.make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
            transform = self.make(
                "geometry_msgs/msg/Transform", translation=self.vector(*place), rotation=rotation
            )
            made.append(
                self.make(
                    "geometry_msgs/msg/TransformStamped",
                    header=self.header(START_NS, parent), child_frame_id=child, transform=transform,
                )
            )  # fmt: skip
        self.messages.append(("/tf_static", START_NS, self.make("tf2_msgs/msg/TFMessage", transforms=made)))


def sweep(times: NDArray[Any], kind: str = "<f4", name: str = "time") -> NDArray[Any]:
    """As many points on a wall as times, in a field of that type and name."""
    table = np.zeros(len(times), [*XYZI, (name, kind)])
    table["x"], table["y"], table["z"] = 10.0, np.linspace(-5, 5, len(times)), 1.0
    table["intensity"] = np.linspace(0, 1, len(times))
    table[name] = times
    return table


def drive(is_ros1: bool = False, frames: bool = True) -> Rig:
    """Two seconds of an IMU, of fixes, of sweeps with Velodyne's times, and the transforms between them."""
    rig = Rig(is_ros1)
    for k in range(201):
        rig.imu(START_NS + k * 10_000_000)
    for k in range(5):
        rig.fix(START_NS + 3_000_000 + k * 400_000_000, east=float(k))
    for k in range(10):
        rig.cloud(START_NS + k * 200_000_000, sweep(np.linspace(-0.05, 0.05, 64)))
    if frames:
        rig.transforms(
            ("base", "imu", (1.0, 0.0, 0.0)),
            ("base", "lidar", (2.0, 0.0, 0.5)),
            ("imu", "antenna", (0.0, 0.0, 0.8)),
        )
    return rig


def write(
    path: Path,
    rig: Rig,
    storage: str = "mcap",
    compression: str = "",
    keep: Callable[[Message], bool] = lambda _: True,
) -> Path:
    """A bag; `storage`: bag (ROS 1, a file), mcap or db3 (ROS 2, a folder)."""
    store, messages = typestore(rig.is_ros1), sorted(filter(keep, rig.messages), key=lambda one: one[1])
    writer: Any
    if storage == "bag":
        writer = Writer1(path)
        if compression:
            writer.set_compression(Writer1.CompressionFormat[compression.upper()])
    else:
        plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
        writer = Writer2(path, version=9, storage_plugin=plugin)
        if compression:
            writer.set_compression(CompressionMode[compression.upper()], CompressionFormat.ZSTD)
    with writer:
        _write(writer, store, messages, rig.is_ros1)
    return path


def _write(writer: Any, store: Any, messages: Iterable[Message], is_ros1: bool) -> None:
    connections: dict[str, Any] = {}
    for topic, ns, message in messages:
        kind = message.__msgtype__
        if topic not in connections:
            connections[topic] = writer.add_connection(topic, kind, typestore=store)
        data = store.serialize_ros1(message, kind) if is_ros1 else store.serialize_cdr(message, kind)
        writer.write(connections[topic], ns, data)


def write_mcap(path: Path, rig: Rig, profile: str, is_listed: bool = True, **options: Any) -> Path:
    """An MCAP file of the format's own writer, without the metadata of a bag; as `ros2 bag` or Foxglove write them.

    ROS 1 messages have schemas named package/Type. `is_listed`: whether channels name their encoding.
    """
    from mcap.writer import Writer

    store = typestore(rig.is_ros1)
    encoding, schema_encoding = ("ros1", "ros1msg") if rig.is_ros1 else ("cdr", "ros2msg")
    with path.open("wb") as file:
        writer, channels = Writer(file, **options), dict[str, int]()
        writer.start(profile)
        for topic, ns, message in sorted(rig.messages, key=lambda one: one[1]):
            kind = message.__msgtype__
            if topic not in channels:
                name = kind.replace("/msg/", "/") if rig.is_ros1 else kind
                text, _ = store.generate_msgdef(kind, ros_version=1 if rig.is_ros1 else 2)
                schema = writer.register_schema(name, schema_encoding, text.encode())
                channels[topic] = writer.register_channel(topic, encoding if is_listed else "", schema)
            data = store.serialize_ros1(message, kind) if rig.is_ros1 else store.serialize_cdr(message, kind)
            writer.add_message(channels[topic], ns, bytes(data), ns)
        writer.finish()
    return path


def rig_yaml(bag: Path, **about: object) -> None:
    """Write a rig.yaml for a bag."""
    (bag / "rig.yaml" if bag.is_dir() else bag.parent / "rig.yaml").write_text(json.dumps(about))


def with_camera(**info: Any) -> Rig:
    """A good rig with a camera beside the LiDAR."""
    rig = drive()
    rig.transforms(("lidar", "camera", (0.0, 0.1, 0.2)))
    rig.info(START_NS, **info)
    return rig
