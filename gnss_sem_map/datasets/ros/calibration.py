"""Calibration of the rig: by rig.yaml, else by the static transforms and the CameraInfo of the bag."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from gnss_sem_map.datasets.ros.bag import Bag
from gnss_sem_map.datasets.ros.kinds import decode
from gnss_sem_map.datasets.ros.rig import CameraTopic, GnssTopic, LidarTopic, Rig, matrix
from gnss_sem_map.datasets.ros.static_tf import StaticTransforms, read_static_transforms
from gnss_sem_map.errors import DataError
from gnss_sem_map.files.untrusted import refused, shown
from gnss_sem_map.sensor_log import Calibration, Skip
from gnss_sem_map.sensor_log.cameras import COEFFICIENTS, Camera, Distortion, lidar_to_camera

Array = NDArray[np.float64]


def calibration_of(bag: Bag, rig: Rig) -> tuple[Calibration, list[Skip]]:
    """Poses of the sensors and the camera's intrinsics; raises DataError for one that is nowhere."""
    transforms, imu = read_static_transforms(bag), _body(bag, rig)
    antenna, skips = (np.zeros(3), []) if rig.gnss is None else _antenna(bag, rig.gnss, imu, transforms)
    if not rig.lidars:
        return Calibration(np.eye(4), p_imu_antenna=antenna), skips
    lidar = next(iter(rig.lidars.values()))
    frame = lidar.frame or _frame_in(bag, lidar.topic)
    T_imu_lidar = lidar_pose(bag, lidar, imu, transforms)
    cameras = []
    for name, camera in rig.cameras.items():
        K, size, T_shift, distortion = _intrinsics(bag, camera)
        T_camera_lidar, T_imu_camera = matrix(camera.T_camera_lidar), matrix(camera.T_imu_camera)
        if T_camera_lidar is None and T_imu_camera is not None:
            T_camera_lidar = lidar_to_camera(T_imu_camera, T_imu_lidar)
        if T_camera_lidar is None:
            T_camera_lidar = _found(
                bag, transforms, camera.frame or _frame_in(bag, camera.topic), frame, "T_camera_lidar"
            )
            T_camera_lidar = T_camera_lidar if T_shift is None else np.asarray(T_shift @ T_camera_lidar)
        called = name if len(rig.cameras) > 1 else ""
        cameras.append(Camera(T_camera_lidar, K, size, camera.time_offset_s, distortion, called))
    return Calibration(T_imu_lidar, tuple(cameras), antenna), skips


def lidar_pose(bag: Bag, lidar: LidarTopic, imu: str, transforms: StaticTransforms) -> Array:
    """T_imu_lidar (4, 4) by rig.yaml, else by the transforms; raises DataError for one that is nowhere."""
    T_imu_lidar = matrix(lidar.T_imu_lidar)
    if T_imu_lidar is not None:
        return T_imu_lidar
    return _found(bag, transforms, imu, lidar.frame or _frame_in(bag, lidar.topic), "T_imu_lidar")


def other_poses(bag: Bag, rig: Rig) -> list[Array]:
    """T_imu_lidar (4, 4) of every LiDAR but the first, which is in the calibration."""
    lidars = list(rig.lidars.values())[1:]
    if not lidars:
        return []
    transforms, imu = read_static_transforms(bag), _body(bag, rig)
    return [lidar_pose(bag, lidar, imu, transforms) for lidar in lidars]


def _body(bag: Bag, rig: Rig) -> str:
    """The frame whose poses make the trajectory: that of the IMU, or without one of the first LiDAR."""
    body = rig.imu or next(iter(rig.lidars.values()), None)
    return "" if body is None else body.frame or _frame_in(bag, body.topic)


def _frame_in(bag: Bag, topic: str) -> str:
    """The frame that a topic's first message names."""
    messages = bag.messages(topic)
    if len(messages) == 0:
        raise refused(topic, "has no messages, so its frame is unknown; set its `frame:` in rig.yaml")
    return str(decode(bag, messages, 0).header.frame_id).strip("/")


def _found(bag: Bag, transforms: StaticTransforms, target: str, source: str, name: str) -> Array:
    T = np.eye(4) if target == source else transforms.between(target, source)
    if T is None:
        frames = ", ".join(transforms.frames)[:300] or "none"
        raise refused(
            bag.path,
            f"no fixed transform leads from {source!r} to {target!r} (found frames {frames}); set {name},"
            " or `frame:` where a frame has another name, in rig.yaml",
        )
    return T


def _antenna(bag: Bag, gnss: GnssTopic, imu: str, transforms: StaticTransforms) -> tuple[Array, list[Skip]]:
    """The antenna in the imu frame (3,) m: zero, and said so, where nobody knows it."""
    if gnss.p_imu_antenna is not None:
        return np.array(gnss.p_imu_antenna, np.float64), []
    frame = gnss.frame or (None if gnss.topic is None else _frame_in(bag, gnss.topic))
    T = None if frame is None else np.eye(4) if frame == imu else transforms.between(imu, frame)
    if T is None:
        reason = (
            f"no transform from {frame!r} to {imu!r}: the lever arm is taken as 0 0 0; set gnss.p_imu_antenna"
        )
        return np.zeros(3), [Skip("lever arm", shown(bag.path.name), reason)]
    return np.array(T[:3, 3]), []


def _intrinsics(
    bag: Bag, camera: CameraTopic
) -> tuple[Array, tuple[int, int], Array | None, Distortion | None]:
    """K, (width, height), what comes after the pose of the camera's frame where P has a shift, and the distortion."""
    if camera.K is not None and camera.image_size is not None:
        return np.array(camera.K, np.float64), camera.image_size, None, camera.distortion
    info = _info(bag, camera)
    K, P, D = (np.asarray(_any(info, name), np.float64) for name in ("k", "p", "d"))
    to_image, found = _to_image(info)
    K, P = to_image @ K.reshape(3, 3), to_image @ P.reshape(3, 4)
    size = camera.image_size or found
    if not K.any() and not P.any():
        raise DataError(
            f"{camera.info}: its CameraInfo is all zero: the camera was not calibrated; set K, image_size"
        )
    is_rectified = "rect" in camera.topic.lower() if camera.rectified is None else camera.rectified
    if camera.K is not None:
        return np.array(camera.K, np.float64), size, None, camera.distortion
    distortion = camera.distortion
    if distortion is None and not is_rectified:
        distortion = _distortion(info, D, camera.info)
    if distortion is not None or not P.any():
        return K, size, None, distortion
    shift = None
    if P[:, 3].any():
        shift = np.eye(4)
        shift[:3, 3] = np.linalg.solve(P[:, :3], P[:, 3])
    return P[:, :3].copy(), size, shift, None


def _to_image(info: Any) -> tuple[Array, tuple[int, int]]:
    """What takes pixels of the whole sensor to those of the images (3, 3), and the images' width and height.

    A CameraInfo is of the whole sensor; a region of it is read, and its pixels are binned (ROS, `image_geometry`).
    """
    x, y = max(int(info.binning_x), 1), max(int(info.binning_y), 1)
    width, height = int(info.roi.width) or int(info.width), int(info.roi.height) or int(info.height)
    shift = np.array(
        [[1.0, 0.0, -int(info.roi.x_offset)], [0.0, 1.0, -int(info.roi.y_offset)], [0.0, 0.0, 1.0]]
    )
    return np.diag([1.0 / x, 1.0 / y, 1.0]) @ shift, (width // x, height // y)


MODELS = dict.fromkeys(
    ("plumb_bob", "pinhole", "rational_polynomial", "thin_prism", "radtan", "brown_conrady"), "brown"
)
MODELS |= dict.fromkeys(("equidistant", "fisheye", "kannala_brandt4", "kannala_brandt", "equi"), "fisheye")
"""Our names of the models of CameraInfo."""


def _distortion(info: Any, D: Array, topic: str | None) -> Distortion | None:
    """The distortion of a CameraInfo; None where all coefficients are zero. Raises DataError for an unknown model.

    A fisheye with coefficients of zero is still no pinhole.
    """
    model = MODELS.get(str(info.distortion_model).strip().lower().replace(" ", "_").replace("-", "_"))
    if model != "fisheye" and not D.any():
        return None
    most = {"brown": 8, "fisheye": 4}.get(model or "", 0)
    if model is None or D[most:].any():
        raise refused(
            topic,
            f"found distortion model {info.distortion_model!r} with {len(D)} coefficients, expected"
            " plumb_bob, rational_polynomial (8) or equidistant (4); set K, image_size and distortion of the camera in"
            " rig.yaml, or `rectified: true` if its images are",
        )
    count = next((count for count in COEFFICIENTS[model] if count >= len(D)), most)
    try:
        padded = [*D[:most].tolist(), *[0.0] * (count - len(D[:most]))]
        return Distortion(model=model, coefficients=tuple(padded))
    except ValidationError as error:
        raise refused(topic, f"{error.errors()[0]['msg'][:200]}") from None


def _info(bag: Bag, camera: CameraTopic) -> Any:
    if camera.info is None:
        raise DataError(f"{camera.topic}: no CameraInfo beside it; set info, or K and image_size")
    messages = bag.messages(camera.info)
    if len(messages) == 0:
        raise DataError(f"{camera.info}: has no messages; set K and image_size of the camera in rig.yaml")
    return decode(bag, messages, 0)


def _any(info: Any, name: str) -> Any:
    """A field of CameraInfo: capital letters in ROS 1, small ones in ROS 2."""
    return getattr(info, name) if hasattr(info, name) else getattr(info, name.upper())
