"""Messages of a drive in a bag of ROS 1 or of ROS 2 (MCAP), written by `rosbags`."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.datasets.kitti_calibration import quaternion_of
from gnss_sem_map.datasets.ros.kinds import typestore
from gnss_sem_map.datasets.ros.static_tf import STATIC
from gnss_sem_map.errors import DataError, how_to_install
from gnss_sem_map.sensor_log.cameras import Distortion

Array = NDArray[np.float64]

ATTITUDE_VARIANCES = np.array([0.005**2, 0.005**2, 0.01**2])
CLOUD_FIELDS = ("x", "y", "z", "intensity", "time")
LENSES = {"brown": "plumb_bob", "fisheye": "equidistant"}
"""Names of our models in a CameraInfo."""
FLOAT32 = 7
ROS2_VERSION: Final = 9
"""Of the bag's metadata: that of ROS 2 Jazzy."""


class BagWriter:
    """Topics /imu, /fix, /tf_static, and those of LiDARs and cameras; the arrival of a message is its stamp."""

    def __init__(self, folder: Path, is_ros1: bool) -> None:
        if find_spec("rosbags") is None:
            raise DataError(f"a bag needs rosbags; {how_to_install('ros')}")
        from rosbags.rosbag1 import Writer as Writer1
        from rosbags.rosbag2 import StoragePlugin
        from rosbags.rosbag2 import Writer as Writer2

        self._is_ros1, self._store = is_ros1, typestore(is_ros1)
        self._types, self._connections = self._store.types, dict[str, Any]()
        if is_ros1:
            folder.mkdir(parents=True)
            self._writer: Any = Writer1(folder / f"{folder.name}.bag")
        else:
            self._writer = Writer2(folder, version=ROS2_VERSION, storage_plugin=StoragePlugin.MCAP)

    def __enter__(self) -> BagWriter:
        self._writer.open()
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.close()

    def write_transforms(self, ns: int, edges: list[tuple[str, str, Array]]) -> None:
        """Poses T_parent_child, each with the names of the two frames."""
        transforms = []
        for parent, child, T in edges:
            transform = self._make(
                "geometry_msgs/msg/Transform", translation=self._vector(T[:3, 3]),
                rotation=self._quaternion(quaternion_of(T)),
            )  # fmt: skip
            transforms.append(
                self._make(
                    "geometry_msgs/msg/TransformStamped",
                    header=self._header(ns, parent), child_frame_id=child, transform=transform,
                )
            )  # fmt: skip
        self._write(f"/{STATIC}", self._make("tf2_msgs/msg/TFMessage", transforms=transforms), ns)

    def write_imu(self, ns: int, force: Array, rate: Array, quaternion_xyzw: Array | None) -> None:
        """Specific force (3,), angular rate (3,), and the attitude, where it is known."""
        attitude = np.array([0.0, 0.0, 0.0, 1.0]) if quaternion_xyzw is None else quaternion_xyzw
        covariance = np.diag(ATTITUDE_VARIANCES).ravel()
        if quaternion_xyzw is None:
            covariance = np.array([-1.0, *[0.0] * 8])  # as sensor_msgs/Imu says it
        message = self._make(
            "sensor_msgs/msg/Imu",
            header=self._header(ns, "imu"),
            orientation=self._quaternion(attitude),
            orientation_covariance=covariance,
            angular_velocity=self._vector(rate),
            angular_velocity_covariance=np.zeros(9),
            linear_acceleration=self._vector(force),
            linear_acceleration_covariance=np.zeros(9),
        )
        self._write("/imu", message, ns)

    def write_fix(self, ns: int, place: Array, accuracy_m: float) -> None:
        """Latitude, longitude, height (3,)."""
        status = self._make("sensor_msgs/msg/NavSatStatus", status=0, service=1)
        lat_deg, lon_deg, alt_m = place.tolist()
        message = self._make(
            "sensor_msgs/msg/NavSatFix",
            header=self._header(ns, "imu"), status=status, latitude=lat_deg, longitude=lon_deg, altitude=alt_m,
            position_covariance=np.diag([accuracy_m**2] * 3).ravel(), position_covariance_type=2,
        )  # fmt: skip
        self._write("/fix", message, ns)

    def write_cloud(
        self, ns: int, rows: NDArray[np.float32], topic: str = "/points", frame: str = "lidar"
    ) -> None:
        """x, y, z, intensity and the time after the stamp (n, 5)."""
        fields = [
            self._make("sensor_msgs/msg/PointField", name=name, offset=4 * k, datatype=FLOAT32, count=1)
            for k, name in enumerate(CLOUD_FIELDS)
        ]
        message = self._make(
            "sensor_msgs/msg/PointCloud2",
            header=self._header(ns, frame), height=1, width=len(rows), fields=fields, is_bigendian=False,
            point_step=20, row_step=20 * len(rows), data=np.frombuffer(rows.astype("<f4").tobytes(), np.uint8),
            is_dense=True,
        )  # fmt: skip
        self._write(topic, message, ns)

    def write_image(self, ns: int, file: Path, topic: str, frame: str) -> None:
        """A PNG as it is."""
        pixels = np.frombuffer(file.read_bytes(), np.uint8)
        image = self._make(
            "sensor_msgs/msg/CompressedImage", header=self._header(ns, frame), format="png", data=pixels
        )
        self._write(topic, image, ns)

    def write_info(
        self, ns: int, topic: str, frame: str, K: Array, size: tuple[int, int], lens: Distortion | None = None
    ) -> None:
        """The calibration of a camera; `lens` None: its images are rectified. ROS has no message for Mei's model."""
        model, coefficients = "plumb_bob", np.zeros(5)
        if lens is not None:
            model, coefficients = LENSES[lens.model], np.zeros(4 if lens.model == "fisheye" else 5)
            coefficients[: len(lens.coefficients)] = lens.coefficients
        names = ("K", "R", "P", "D") if self._is_ros1 else ("k", "r", "p", "d")
        P = np.column_stack([K, np.zeros(3)])
        values = dict(zip(names, (K.ravel(), np.eye(3).ravel(), P.ravel(), coefficients), strict=True))
        region = self._make(
            "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        info = self._make(
            "sensor_msgs/msg/CameraInfo",
            header=self._header(ns, frame), width=size[0], height=size[1], distortion_model=model,
            binning_x=0, binning_y=0, roi=region, **values,
        )  # fmt: skip
        self._write(topic, info, ns)

    def _header(self, ns: int, frame: str) -> Any:
        time = self._make("builtin_interfaces/msg/Time", sec=ns // 10**9, nanosec=ns % 10**9)
        seq = {"seq": 0} if self._is_ros1 else {}
        return self._make("std_msgs/msg/Header", stamp=time, frame_id=frame, **seq)

    def _vector(self, values: Array) -> Any:
        return self._make("geometry_msgs/msg/Vector3", **dict(zip("xyz", values.tolist(), strict=True)))

    def _quaternion(self, xyzw: Array) -> Any:
        return self._make("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", xyzw.tolist(), strict=True)))

    def _make(self, kind: str, **fields: Any) -> Any:
        return self._types[kind](**fields)

    def _write(self, topic: str, message: Any, ns: int) -> None:
        kind = message.__msgtype__
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(topic, kind, typestore=self._store)
        data = (
            self._store.serialize_ros1(message, kind)
            if self._is_ros1
            else self._store.serialize_cdr(message, kind)
        )
        self._writer.write(self._connections[topic], ns, data)
