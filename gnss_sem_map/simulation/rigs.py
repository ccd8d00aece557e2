"""Rigs: which sensors a simulated vehicle carries, where they are mounted, and when they measure.

The body frame is the imu: x ahead, y left, z up, 0.93 m above the road.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final, Literal

import numpy as np
from scipy.spatial.transform import Rotation

from gnss_sem_map.sensor_log.cameras import Distortion
from gnss_sem_map.simulation.camera import Camera
from gnss_sem_map.simulation.compiled import Floats
from gnss_sem_map.simulation.kitti_rig import FORWARD, T_IMU_LIDAR, camera_in_imu, transform
from gnss_sem_map.simulation.lidar import Lidar

RigName = Literal["kitti", "surround", "kitti-360"]
_Place = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class MountedLidar:
    """A LiDAR on the vehicle."""

    name: str
    T_imu_lidar: Floats
    """(4, 4)"""
    sensor: Lidar = field(default_factory=Lidar)
    sweep_after_s: float = 0.0
    """Its sweeps begin so much after those of the drive, which are 0.1 s long."""


@dataclass(frozen=True, eq=False)
class MountedCamera:
    """A camera on the vehicle."""

    name: str
    T_imu_camera: Floats
    """(4, 4)"""
    sensor: Camera = field(default_factory=Camera)
    exposure_after_s: float = 0.0020
    """Exposed so much after the middle of the drive's sweep."""
    stamp_after_s: float = 0.0020
    """Stamped so much after it."""


@dataclass(frozen=True, eq=False)
class Rig:
    """All LiDARs and cameras of a vehicle; the first LiDAR is the one that all else is relative to."""

    lidars: tuple[MountedLidar, ...]
    cameras: tuple[MountedCamera, ...]


def kitti(lidar: Lidar | None = None, camera: Camera | None = None) -> Rig:
    """KITTI's LiDAR and left colour camera; images are stamped 8.5 ms after their exposure, as measured on KITTI."""
    camera = camera or Camera()
    return Rig(
        (MountedLidar("lidar", T_IMU_LIDAR, lidar or Lidar()),),
        (MountedCamera("camera", camera_in_imu(camera), camera, stamp_after_s=0.0105),),
    )


def surround() -> Rig:
    """Two LiDARs of 32 rings on the left and right of the roof, tilted outwards, the right one half a sweep later.

    Cameras to the front, left and right with Brown distortion, and a fisheye to the back.
    """
    rings = Lidar(np.radians(np.linspace(10.0, -30.0, 32)), columns=1800, range_m=100.0, blind_m=1.0)
    front = Camera(1000, 640, 500.0, 503.2, 317.4, _brown(-0.10, 0.010))
    left, right = (
        Camera(1000, 640, 400.0, *centre, _brown(-0.08, 0.008)) for centre in ((497.1, 322.6), (501.8, 318.9))
    )
    back = Camera(
        1000, 700, 300.0, 498.7, 351.3, Distortion(model="fisheye", coefficients=(0.02, -0.005, 0.001, 0.0))
    )
    return Rig(
        (
            MountedLidar("left", _mounted((0.55, 0.55, 0.95), (3.0, 1.5, -7.0)), rings),
            MountedLidar("right", _mounted((0.55, -0.55, 0.95), (-2.0, 1.0, 7.0)), rings, 0.05),
        ),
        (
            MountedCamera("front", _looking((0.95, 0.05, 0.80), (0.5, 5.0, 0.2)), front, 0.002, 0.0105),
            MountedCamera("left", _looking((0.45, 0.60, 0.80), (90.8, 8.0, -0.4)), left, 0.0045, 0.012),
            MountedCamera("right", _looking((0.45, -0.60, 0.80), (-89.4, 8.0, 0.3)), right, 0.0045, 0.012),
            MountedCamera("back", _looking((-0.75, 0.0, 0.82), (179.2, 10.0, 0.6)), back, 0.007, 0.007),
        ),
    )  # fmt: skip


def kitti_360() -> Rig:
    """KITTI-360's LiDAR, two rectified cameras to the front, and two fisheyes to the sides at half the resolution."""
    front = Camera(1408, 376, 552.554, 682.049, 238.77)
    lens = Distortion(model="mei", coefficients=(0.0168, 1.6549, 4.2e-4, 4.2e-4), xi=2.2134)
    side = Camera(700, 700, 668.0, 358.4, 352.9, lens)
    return Rig(
        (MountedLidar("velodyne", _mounted((0.80, 0.05, 0.95), (0.3, 0.2, -0.1))),),
        (
            MountedCamera("image_00", _looking((1.55, 0.30, 0.65), (0.1, 5.4, 0.3)), front),
            MountedCamera("image_01", _looking((1.55, -0.30, 0.65), (0.1, 5.4, 0.3)), front),
            MountedCamera("image_02", _looking((0.70, 0.58, 0.85), (91.0, 3.0, 0.5)), side),
            MountedCamera("image_03", _looking((0.70, -0.58, 0.85), (-90.5, 3.0, -0.4)), side),
        ),
    )


RIGS: Final[dict[RigName, Callable[[], Rig]]] = {"kitti": kitti, "surround": surround, "kitti-360": kitti_360}


def _brown(k1: float, k2: float) -> Distortion:
    return Distortion(model="brown", coefficients=(k1, k2, 4e-4, -3e-4))


def _turn(yaw_pitch_roll_deg: _Place) -> Floats:
    return np.asarray(Rotation.from_euler("ZYX", yaw_pitch_roll_deg, degrees=True).as_matrix())


def _mounted(place: _Place, yaw_pitch_roll_deg: _Place) -> Floats:
    """T_imu_sensor of a sensor with axes like the body's."""
    return transform(_turn(yaw_pitch_roll_deg), place)


def _looking(place: _Place, yaw_pitch_roll_deg: _Place) -> Floats:
    """T_imu_camera of a camera that looks to a yaw (left is positive) and down by the pitch."""
    return transform(_turn(yaw_pitch_roll_deg) @ FORWARD.T, place)
