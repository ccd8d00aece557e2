"""A street of a few planes, driven exactly and written in the real formats: every measurement has a known truth.

Road (|y| < 4 m), sidewalks, a building wall on either side and a parked car, seen by a LiDAR of few beams that turns
while the car drives, and by a camera. Nothing here is shared with the package but the exact motion.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from factor_graphs.geodesy import LocalFrame
from factor_graphs.simulation import Motion, follow

Array = NDArray[np.float64]
NAMES = ("road", "sidewalk", "vehicle", "building", "vegetation", "other")
ROAD, SIDEWALK, VEHICLE, BUILDING, VEGETATION, OTHER = range(6)
FRAME = LocalFrame(49.011, 8.423, 112.0)
EPOCH = np.datetime64("2011-09-26T13:00:00", "ns")
SWEEP_S = 0.1
IMAGE_AFTER_SCAN_S = 0.0105
EXPOSED_BEFORE_STAMP_S = 0.0085
WIDTH, HEIGHT = 300, 96
K = np.array([[180.0, 0.0, 150.0], [0.0, 180.0, 45.0], [0.0, 0.0, 1.0]])
HALF_ROAD_M, WALL_M, IMU_HEIGHT_M = 4.0, 8.0, 0.93
CAR = (np.array([12.0, -3.6, 0.0]), np.array([16.2, -1.9, 1.5]))

T_LIDAR_IMU = np.array([[1, 0, 0, -0.81], [0, 1, 0, 0.32], [0, 0, 1, -0.8], [0, 0, 0, 1.0]])
T_CAMERA_LIDAR = np.array([[0, -1, 0, -0.01], [0, 0, -1, -0.07], [1, 0, 0, -0.27], [0, 0, 0, 1.0]])
T_IMU_LIDAR = np.linalg.inv(T_LIDAR_IMU)


def motion(seconds: float = 3.0, speed: float = 6.0) -> Motion:
    """Along the street, with a gentle swerve so that turning matters."""
    x = np.linspace(-5.0, 10.0 + seconds * speed, 40)
    waypoints = np.column_stack([x, 0.6 * np.sin(x / 6.0), np.full(40, IMU_HEIGHT_M)])
    return follow(waypoints, [-0.6, seconds + 0.6], [speed, speed])


def cast(origins: Array, directions: Array) -> tuple[Array, NDArray[np.int64]]:
    """Distance to the first surface along each ray, inf for none, and its class."""
    with np.errstate(divide="ignore", invalid="ignore"):
        best = np.full(len(origins), np.inf)
        classes = np.full(len(origins), OTHER)
        ground = -origins[:, 2] / directions[:, 2]
        y = origins[:, 1] + ground * directions[:, 1]
        hit = (ground > 0) & (np.abs(y) < WALL_M)
        best[hit] = ground[hit]
        classes[hit] = np.where(np.abs(y[hit]) < HALF_ROAD_M, ROAD, SIDEWALK)
        for side in (-WALL_M, WALL_M):
            wall = (side - origins[:, 1]) / directions[:, 1]
            z = origins[:, 2] + wall * directions[:, 2]
            hit = (wall > 0) & (wall < best) & (z > 0) & (z < 7)
            best[hit], classes[hit] = wall[hit], BUILDING
        near, far = ((corner - origins) / directions for corner in CAR)
        enter, leave = np.minimum(near, far).max(axis=1), np.maximum(near, far).min(axis=1)
    hit = (enter > 0) & (enter < leave) & (enter < best)
    best[hit], classes[hit] = enter[hit], VEHICLE
    return best, classes


@dataclass(frozen=True)
class Street:
    """The written drive and its truth."""

    drive: Path
    labels: Path
    motion: Motion
    frames: tuple[int, ...]
    scan_classes: dict[int, NDArray[np.int64]]
    """Class of every point of every scan."""
    p_map: dict[int, Array]
    """Exact place of every point of every scan."""


def write(
    folder: Path, frames: tuple[int, ...] = tuple(range(12)), beams: int = 20, azimuths: int = 500
) -> Street:
    """Write the street as a KITTI raw drive with class probabilities beside it."""
    date = folder / "2011_09_26"
    drive, labels = date / "2011_09_26_drive_0999_sync", folder / "probabilities"
    for part in ("oxts/data", "velodyne_points/data", "image_02/data"):
        (drive / part).mkdir(parents=True)
    labels.mkdir()
    driven = motion((max(frames) + 2) * SWEEP_S)
    _write_calibration(date)
    _write_oxts(drive / "oxts", driven, max(frames) + 3)
    scans = {k: _scan(driven, k, beams, azimuths) for k in frames}
    middles = [(k + 0.5) * SWEEP_S for k in range(max(frames) + 1)]
    for name, shift in (("", 0.0), ("_start", -SWEEP_S / 2), ("_end", SWEEP_S / 2)):
        _write_stamps(drive / f"velodyne_points/timestamps{name}.txt", [m + shift for m in middles])
    _write_stamps(drive / "image_02/timestamps.txt", [m + IMAGE_AFTER_SCAN_S for m in middles])
    for k in frames:
        rows, _, _ = scans[k]
        rows.astype("<f4").tofile(drive / f"velodyne_points/data/{k:010d}.bin")
        classes = class_image(driven, middles[k] + IMAGE_AFTER_SCAN_S - EXPOSED_BEFORE_STAMP_S)
        shade = np.array([90, 150, 40, 200, 120, 230], np.uint8)[classes]
        cv2.imwrite(str(drive / f"image_02/data/{k:010d}.png"), np.repeat(shade[:, :, None], 3, axis=2))
        half = classes[: HEIGHT // 2 * 2 : 2, : WIDTH // 2 * 2 : 2]
        probabilities = np.full((*half.shape, len(NAMES)), 8, np.uint8)
        np.put_along_axis(probabilities, half[:, :, None], 215, axis=2)
        np.savez_compressed(
            labels / f"{k:010d}.npz", probabilities=probabilities, class_names=np.array(NAMES)
        )
    return Street(
        drive,
        labels,
        driven,
        frames,
        {k: s[1] for k, s in scans.items()},
        {k: s[2] for k, s in scans.items()},
    )


def _scan(driven: Motion, k: int, beams: int, azimuths: int) -> tuple[Array, NDArray[np.int64], Array]:
    """One sweep, ring by ring with azimuth increasing from 0, each ray cast from where the lidar then was."""
    azimuth = np.tile(np.linspace(0, 2 * np.pi, azimuths, endpoint=False), beams)
    elevation = np.repeat(np.radians(np.linspace(2.0, -24.8, beams)), azimuths)
    directions = np.column_stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )
    wrapped = np.arctan2(np.sin(azimuth), np.cos(azimuth))
    stamps = k * SWEEP_S + (0.5 - wrapped / (2 * np.pi)) * SWEEP_S
    T_map_lidar = driven.poses(stamps) @ T_IMU_LIDAR
    distances, classes = cast(
        T_map_lidar[:, :3, 3], np.einsum("kij,kj->ki", T_map_lidar[:, :3, :3], directions)
    )
    hit = distances < 60.0
    p_lidar = distances[hit, None] * directions[hit]
    p_map = np.einsum("kij,kj->ki", T_map_lidar[hit, :3, :3], p_lidar) + T_map_lidar[hit, :3, 3]
    return np.column_stack([p_lidar, np.full(hit.sum(), 0.5)]), classes[hit], p_map


def class_image(driven: Motion, stamp: float) -> NDArray[np.int64]:
    """Class of every pixel (h, w) of the image exposed at a stamp."""
    T_map_camera = driven.poses(np.array([stamp]))[0] @ T_IMU_LIDAR @ np.linalg.inv(T_CAMERA_LIDAR)
    u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    rays = np.column_stack([u.ravel(), v.ravel(), np.ones(u.size)]) @ np.linalg.inv(K).T
    origins = np.broadcast_to(T_map_camera[:3, 3], rays.shape)
    return cast(origins, rays @ T_map_camera[:3, :3].T)[1].reshape(HEIGHT, WIDTH)


def _write_calibration(date: Path) -> None:
    def row(name: str, values: Array) -> str:
        return f"{name}: " + " ".join(f"{v:.9e}" for v in np.ravel(values))

    (date / "calib_imu_to_velo.txt").write_text(
        "\n".join(
            ["calib_time: 25-May-2012 16:47:16", row("R", T_LIDAR_IMU[:3, :3]), row("T", T_LIDAR_IMU[:3, 3])]
        )
    )
    # camera 2 sits 6 cm right of camera 0: the projection's last column holds it
    shift = np.array([0.06, -0.002, 0.003])
    T_camera0_lidar = T_CAMERA_LIDAR.copy()
    T_camera0_lidar[:3, 3] -= shift
    (date / "calib_velo_to_cam.txt").write_text(
        "\n".join([row("R", T_camera0_lidar[:3, :3]), row("T", T_camera0_lidar[:3, 3])])
    )
    (date / "calib_cam_to_cam.txt").write_text(
        "\n".join(
            [
                row("R_rect_00", np.eye(3)),
                row("P_rect_02", np.column_stack([K, K @ shift])),
                row("S_rect_02", np.array([WIDTH, HEIGHT])),
            ]
        )
    )


def _write_oxts(folder: Path, driven: Motion, count: int) -> None:
    from scipy.spatial.transform import Rotation

    stamps = np.arange(count) * SWEEP_S - 0.02
    poses = driven.poses(stamps)
    force, rate = driven.specific_force(stamps, FRAME), driven.angular_rate(stamps, FRAME)
    lat, lon, alt = FRAME.to_geodetic(poses[:, :3, 3])
    yaw, pitch, roll = Rotation.from_matrix(poses[:, :3, :3]).as_euler("ZYX").T
    for k in range(count):
        row = np.zeros(30)
        row[:6] = lat[k], lon[k], alt[k], roll[k], pitch[k], yaw[k]
        row[11:14], row[17:20], row[23] = force[k], rate[k], 0.05
        (folder / f"data/{k:010d}.txt").write_text(" ".join(f"{v:.12f}" for v in row) + "\n")
    _write_stamps(folder / "timestamps.txt", list(stamps))


def _write_stamps(path: Path, stamps: list[float]) -> None:
    lines = [str(EPOCH + np.timedelta64(round(t * 1e9), "ns")).replace("T", " ") for t in stamps]
    path.write_text("\n".join(lines) + "\n")


def write_odometry(folder: Path, street: Street) -> Path:
    """The same drive as an odometry sequence: scans compensated to mid sweep, poses in the camera frame."""
    sequence = folder / "sequences" / "99"
    (sequence / "velodyne").mkdir(parents=True)
    (sequence / "image_2").mkdir()
    count = max(street.frames) + 4
    stamps = (np.arange(count) + 0.5) * SWEEP_S
    T_map_lidar = street.motion.poses(np.minimum(stamps, street.motion.end)) @ T_IMU_LIDAR
    T_camera0_k = T_CAMERA_LIDAR @ np.linalg.inv(T_map_lidar[0]) @ T_map_lidar @ np.linalg.inv(T_CAMERA_LIDAR)
    np.savetxt(sequence / "poses.txt", T_camera0_k[:, :3].reshape(-1, 12), fmt="%.9e")
    np.savetxt(sequence / "times.txt", stamps, fmt="%.9e")
    rows = {"P2": np.column_stack([K, np.zeros(3)]), "Tr": T_CAMERA_LIDAR[:3]}
    (sequence / "calib.txt").write_text(
        "\n".join(f"{n}: " + " ".join(f"{v:.9e}" for v in values.ravel()) for n, values in rows.items())
    )
    for k in street.frames:
        T_lidar_map = np.linalg.inv(T_map_lidar[k])
        p_lidar = street.p_map[k] @ T_lidar_map[:3, :3].T + T_lidar_map[:3, 3]
        rows_k = np.column_stack([p_lidar, np.full(len(p_lidar), 0.5)])
        rows_k.astype("<f4").tofile(sequence / f"velodyne/{k:06d}.bin")
        source = street.drive / f"image_02/data/{k:010d}.png"
        (sequence / f"image_2/{k:06d}.png").write_bytes(source.read_bytes())
    return sequence


def write_table_log(folder: Path, street: Street) -> Path:
    """The same drive as a table log with 100 Hz IMU, 1 Hz GNSS and five-column scans."""
    drive = folder / "own_drive"
    for part in ("lidar", "images"):
        (drive / part).mkdir(parents=True)
    imu = np.arange(-0.5, max(street.frames) * SWEEP_S + 0.6, 0.01)
    np.savetxt(
        drive / "imu.csv",
        np.column_stack([imu, street.motion.specific_force(imu, FRAME), street.motion.angular_rate(imu, FRAME)]),
        delimiter=",", fmt="%.9f", header="stamp_s,ax,ay,az,wx,wy,wz", comments="",
    )  # fmt: skip
    fixes = imu[::20]
    lat, lon, alt = FRAME.to_geodetic(street.motion.poses(fixes)[:, :3, 3])
    np.savetxt(
        drive / "gnss.csv",
        np.column_stack([fixes, lat, lon, alt, *np.full((3, len(fixes)), 0.05)]),
        delimiter=",", fmt="%.11f", header="stamp_s,lat_deg,lon_deg,alt_m,std_e_m,std_n_m,std_u_m", comments="",
    )  # fmt: skip
    about = {
        "epoch_ns": int(EPOCH.astype(np.int64)), "T_imu_lidar": T_IMU_LIDAR.tolist(), "K": K.tolist(),
        "T_camera_lidar": T_CAMERA_LIDAR.tolist(), "image_size": [WIDTH, HEIGHT],
        "camera_time_offset_s": -EXPOSED_BEFORE_STAMP_S,
    }  # fmt: skip
    (drive / "log.yaml").write_text(json.dumps(about))  # JSON is YAML
    scan_stamps, image_stamps = ["number,stamp_s"], ["number,stamp_s"]
    for k in street.frames:
        stamp = (k + 0.5) * SWEEP_S
        rows = np.fromfile(street.drive / f"velodyne_points/data/{k:010d}.bin", "<f4").reshape(-1, 4)
        after = -np.arctan2(rows[:, 1], rows[:, 0]) / (2 * np.pi) * SWEEP_S
        np.column_stack([rows, after]).astype("<f4").tofile(drive / f"lidar/{k}.bin")
        scan_stamps.append(f"{k},{stamp:.9f}")
        image_stamps.append(f"{k},{stamp + IMAGE_AFTER_SCAN_S:.9f}")
        source = street.drive / f"image_02/data/{k:010d}.png"
        (drive / f"images/{k}.png").write_bytes(source.read_bytes())
    (drive / "lidar/stamps.csv").write_text("\n".join(scan_stamps) + "\n")
    (drive / "images/stamps.csv").write_text("\n".join(image_stamps) + "\n")
    return drive
