"""Mounting of KITTI's sensors on the vehicle, and their calibration files."""

from pathlib import Path
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from gnss_sem_map.simulation.camera import Camera
from gnss_sem_map.simulation.compiled import Floats

_CALIB_TIME: Final = "01-Jan-2026 12:00:00"


def transform(R: Floats, t: tuple[float, float, float]) -> Floats:
    """A rotation and a translation as (4, 4)."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    return T


# The LiDAR sits ahead of the imu and above it, the cameras below the LiDAR; nothing is mounted quite straight.
FORWARD: Final = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])  # x right, y down, z forward
T_LIDAR_IMU: Final[Floats] = transform(
    Rotation.from_euler("ZYX", [0.05, -0.12, 0.85], degrees=True).as_matrix(), (-0.81, 0.32, -0.80)
)
_T_CAMERA0_LIDAR: Final[Floats] = transform(
    FORWARD @ Rotation.from_euler("ZYX", [-0.43, 0.85, 0.04], degrees=True).as_matrix(),
    (-0.004, -0.076, -0.272),
)
_R_RECT: Final[Floats] = Rotation.from_euler("ZYX", [-0.56, -0.43, 0.25], degrees=True).as_matrix()
_P_SHIFTS: Final = ((0.0, 0.0, 0.0), (-387.57, 0.0, 0.0), (44.857, 0.2164, 0.00275), (-339.52, 2.2, 0.00273))

T_IMU_LIDAR: Final[Floats] = np.asarray(np.linalg.inv(T_LIDAR_IMU))


def _projection(camera: Camera, number: int) -> Floats:
    return np.column_stack([camera.K, _P_SHIFTS[number]])


def camera_in_lidar(camera: Camera) -> Floats:
    """T_camera_lidar of the rectified left colour camera: rectification, then the shift in its projection matrix."""
    P = _projection(camera, 2)
    shift = transform(np.eye(3), tuple(np.linalg.solve(P[:, :3], P[:, 3])))
    return np.asarray(shift @ transform(_R_RECT, (0.0, 0.0, 0.0)) @ _T_CAMERA0_LIDAR)


def camera_in_imu(camera: Camera) -> Floats:
    """T_imu_camera."""
    return np.asarray(T_IMU_LIDAR @ np.linalg.inv(camera_in_lidar(camera)))


def write_calibration(date: Path, camera: Camera) -> None:
    """calib_imu_to_velo.txt, calib_velo_to_cam.txt and calib_cam_to_cam.txt of a date folder."""
    rigid = {"calib_imu_to_velo.txt": T_LIDAR_IMU, "calib_velo_to_cam.txt": _T_CAMERA0_LIDAR}
    for name, T in rigid.items():
        rows = [f"calib_time: {_CALIB_TIME}", _row("R", T[:3, :3]), _row("T", T[:3, 3])]
        if "cam" in name:
            rows += ["delta_f: 0.000000e+00 0.000000e+00", "delta_c: 0.000000e+00 0.000000e+00"]
        (date / name).write_text("\n".join(rows) + "\n")
    size = np.array([camera.width, camera.height], float)
    rows = [f"calib_time: {_CALIB_TIME}", "corner_dist: 9.950000e-02"]
    for k in range(4):
        P = _projection(camera, k)
        values = {
            "S": size, "K": P[:, :3], "D": np.zeros(5), "R": np.eye(3), "T": np.linalg.solve(P[:, :3], P[:, 3]),
            "S_rect": size, "R_rect": _R_RECT, "P_rect": P,
        }  # fmt: skip
        rows += [_row(f"{name}_0{k}", value) for name, value in values.items()]
    (date / "calib_cam_to_cam.txt").write_text("\n".join(rows) + "\n")


def _row(name: str, values: Floats) -> str:
    return f"{name}: " + " ".join(f"{value:.9e}" for value in np.ravel(values))
