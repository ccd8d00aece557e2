"""Boxes on a plain, some of them driving, swept by a LiDAR on an exact motion: a log in memory, and its truth."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from factor_graphs.geodesy import LocalFrame
from factor_graphs.simulation import Motion, follow
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.dynamics.image_rows import CELLS, Rows
from gnss_sem_map.sensor_log import Calibration, Points, Scan, SensorLog

Array = NDArray[np.float64]
FRAME = LocalFrame(49.011, 8.423, 112.0)
SWEEP_S, RANGE_M, NOISE_M = 0.1, 80.0, 0.01
IMU_HEIGHT_M = 0.93
T_IMU_LIDAR = np.array([[1, 0, 0, 0.81], [0, 1, 0, -0.32], [0, 0, 1, 0.8], [0, 0, 0, 1.0]])

DENSE = Rows((np.arange(CELLS) >= 155) & (np.arange(CELLS) < 220))
"""Rows of a LiDAR that sees everything from -25 to 2 degrees."""

# A box is its two opposite corners, in the map at stamp zero, and its velocity.
Box = tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
STILL = (0.0, 0.0, 0.0)


def still(x: float, y: float, z: float, dx: float, dy: float, dz: float) -> Box:
    return (x, y, z), (x + dx, y + dy, z + dz), STILL


def street(cars: Sequence[Box] = ()) -> list[Box]:
    """Houses of different depth on both sides, parked cars and poles: every direction is held."""
    houses = [
        still(14.0 * k - 40, side * (9 + k % 3) - (side < 0) * 8, 0, 11 - k % 2, 8, 6 + k % 4)
        for k in range(9)
        for side in (-1, 1)
    ]
    parked = [still(9.0 * k - 20, side * 4.5 - 0.9, 0, 4.2, 1.8, 1.5) for k in range(8) for side in (-1, 1)]
    poles = [still(11.0 * k - 30, 6.5, 0, 0.3, 0.3, 6) for k in range(10)]
    return [*houses, *parked, *poles, *cars]


def tunnel() -> list[Box]:
    """Two endless walls and a ceiling: nothing says how far one has driven."""
    return [still(-500, -6, 0, 1000, 1, 5), still(-500, 5, 0, 1000, 1, 5), still(-500, -6, 5, 1000, 12, 1)]


def drive(seconds: float, speed: float = 8.0) -> Motion:
    """Along x with a gentle swerve, so that turning matters."""
    x = np.linspace(-10.0, 10.0 + seconds * speed, 40)
    waypoints = np.column_stack([x, 0.8 * np.sin(x / 9.0), np.full(40, IMU_HEIGHT_M)])
    return follow(waypoints, [-1.0, seconds + 1.0], [speed, speed])


def sweep(motion: Motion, boxes: Sequence[Box], k: int, *, beams: int = 32, azimuths: int = 600) -> Points:
    """Sweep k, every ray cast from where the lidar then was at what was there then, with 1 cm of noise."""
    azimuth = np.tile(np.linspace(-np.pi, np.pi, azimuths, endpoint=False), beams)
    elevation = np.repeat(np.radians(np.linspace(10.0, -25.0, beams)), azimuths)
    directions = np.column_stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )
    stamps = (k + 0.5 - azimuth / (2 * np.pi)) * SWEEP_S
    T_map_lidar = motion.poses(stamps) @ T_IMU_LIDAR
    rays = np.einsum("kij,kj->ki", T_map_lidar[:, :3, :3], directions)
    ranges = _cast(T_map_lidar[:, :3, 3], rays, stamps, boxes)
    hit = ranges < RANGE_M
    noisy = ranges[hit] + np.random.default_rng(k).normal(0, NOISE_M, int(hit.sum()))
    xyz = (noisy[:, None] * directions[hit]).astype(np.float32)
    return Points(xyz, np.full(len(xyz), 0.5, np.float32), stamps[hit])


def _cast(origins: Array, rays: Array, stamps: Array, boxes: Sequence[Box]) -> Array:
    with np.errstate(divide="ignore", invalid="ignore"):
        ground = -origins[:, 2] / rays[:, 2]
        best = np.where(ground > 0, ground, np.inf)
        for low, high, velocity in boxes:
            shift = stamps[:, None] * np.array(velocity) - origins
            near, far = (np.array(low) + shift) / rays, (np.array(high) + shift) / rays
            enter, leave = np.minimum(near, far).max(axis=1), np.maximum(near, far).min(axis=1)
            hit = (enter > 0) & (enter < leave)
            best[hit] = np.minimum(best[hit], enter[hit])
    return best


def log_of(points: dict[int, Points], trajectory: Trajectory) -> SensorLog:
    """A drive with these sweeps by number, and poses."""
    scans = tuple(Scan(f"{k:06d}", k, (k + 0.5) * SWEEP_S, lambda k=k: points[k]) for k in sorted(points))
    return SensorLog("scene", 0, Calibration(T_IMU_LIDAR), scans, (), frame=FRAME, given=trajectory)


def trajectory_of(motion: Motion, sweeps: int) -> Trajectory:
    """The exact trajectory, 100 Hz."""
    return motion.trajectory(np.arange(-0.1, (sweeps + 1) * SWEEP_S, 0.01))


def write_table_log(folder: Path, boxes: Sequence[Box], sweeps: int) -> Path:
    """The drive through these boxes as a table log without a camera."""
    motion = drive(sweeps * SWEEP_S)
    (folder / "lidar").mkdir(parents=True)
    imu = np.arange(-0.5, (sweeps + 4) * SWEEP_S, 0.01)
    fixes = imu[::20]
    lat_lon_alt = np.column_stack(FRAME.to_geodetic(motion.poses(fixes)[:, :3, 3]))
    tables = {
        "imu.csv": (
            "stamp_s,ax,ay,az,wx,wy,wz",
            [imu, motion.specific_force(imu, FRAME), motion.angular_rate(imu, FRAME)],
        ),
        "gnss.csv": (
            "stamp_s,lat_deg,lon_deg,alt_m,std_e_m,std_n_m,std_u_m",
            [fixes, lat_lon_alt, np.full((len(fixes), 3), 0.05)],
        ),
    }
    for name, (header, columns) in tables.items():
        np.savetxt(
            folder / name, np.column_stack(columns), delimiter=",", fmt="%.11f", header=header, comments=""
        )
    stamps = [f"{k},{(k + 0.5) * SWEEP_S:.9f}" for k in range(sweeps)]
    (folder / "lidar/stamps.csv").write_text("\n".join(["number,stamp_s", *stamps]) + "\n")
    (folder / "log.yaml").write_text(json.dumps({"T_imu_lidar": T_IMU_LIDAR.tolist()}))
    for k in range(sweeps):
        points = sweep(motion, boxes, k)
        assert points.stamps is not None
        after = points.stamps - (k + 0.5) * SWEEP_S
        np.column_stack([points.xyz, points.intensity, after]).astype("<f4").tofile(
            folder / f"lidar/{k:06d}.bin"
        )
    return folder
