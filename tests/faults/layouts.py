"""One drive in every layout: a copy of a KITTI raw drive that may be changed, and the same drive as other formats."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np

from factor_graphs.trajectory import Trajectory
from gnss_sem_map.datasets import open_drive
from gnss_sem_map.scans.deskew import usable_points_at_stamp
from gnss_sem_map.sensor_log import SensorLog


def twin(drive: Path) -> Path:
    """The `_extract` folder beside a KITTI raw drive, with the 100 Hz oxts; it need not exist."""
    return drive.with_name(drive.name.replace("_sync", "_extract"))


def copy_of(drive: Path, folder: Path, frames: range | None = None) -> Path:
    """A copy of a KITTI raw drive with its calibration and its 100 Hz twin; only some frames of scans and images."""
    date = folder / drive.parent.name
    date.mkdir(parents=True)
    for file in drive.parent.glob("*.txt"):
        shutil.copy(file, date)
    for source in (drive, twin(drive)):
        if (source / "oxts").is_dir():
            shutil.copytree(source / "oxts", date / source.name / "oxts")
    for sensor in ("velodyne_points", "image_02"):
        (date / drive.name / sensor / "data").mkdir(parents=True)
        for stamps in (drive / sensor).glob("*.txt"):
            shutil.copy(stamps, date / drive.name / sensor)
        for file in (drive / sensor / "data").iterdir():
            if frames is None or int(file.stem) in frames:
                shutil.copy(file, date / drive.name / sensor / "data")
    return date / drive.name


def as_table_log(drive: Path, folder: Path) -> Path:
    """The same drive as a table log: what a reader of KITTI raw finds, written as tables."""
    log, out = open_drive(drive), folder / f"{drive.name}_table"
    assert log.imu is not None
    assert log.gnss is not None
    assert log.frame is not None
    (out / "lidar").mkdir(parents=True)
    (out / "images").mkdir()
    imu, gnss = log.imu, log.gnss
    _save(
        out / "imu.csv",
        "stamp_s,ax,ay,az,wx,wy,wz",
        np.column_stack([imu.stamps, imu.specific_force, imu.angular_rate]),
    )
    _save(
        out / "gnss.csv",
        "stamp_s,lat_deg,lon_deg,alt_m,std_e_m,std_n_m,std_u_m",
        np.column_stack([gnss.stamps, *log.frame.to_geodetic(gnss.positions), gnss.stddevs]),
    )
    _write_about(log, out / "log.yaml")
    for scan in log.scans:
        points = scan.read()
        assert points.stamps is not None
        rows = np.column_stack([points.xyz, points.intensity, points.stamps - scan.stamp])
        rows.astype("<f4").tofile(out / f"lidar/{scan.name}.bin")
    for image in log.images:
        shutil.copy(drive / f"image_02/data/{image.number:010d}.png", out / "images")
    for name, items in (("lidar", log.scans), ("images", log.images)):
        lines = [f"{item.number},{item.stamp:.9f}\n" for item in items]
        (out / name / "stamps.csv").write_text("number,stamp_s\n" + "".join(lines))
    return out


def _save(path: Path, header: str, rows: np.ndarray) -> None:
    np.savetxt(path, rows, delimiter=",", fmt="%.12g", header=header, comments="")


def _write_about(log: SensorLog, path: Path) -> None:
    calibration, noise = log.calibration, log.imu_noise
    camera = calibration.camera()
    about = {
        "epoch_ns": log.epoch_ns,
        "T_imu_lidar": calibration.T_imu_lidar.tolist(),
        "T_camera_lidar": camera.T_camera_lidar.tolist(),
        "K": camera.K.tolist(),
        "image_size": camera.image_size,
        "camera_time_offset_s": camera.time_offset_s,
        "p_imu_antenna": calibration.p_imu_antenna.tolist(),
        "imu_noise": None if noise is None else noise.model_dump(),
    }
    path.write_text(json.dumps(about))  # JSON is YAML


def as_odometry(drive: Path, folder: Path, trajectory: Trajectory) -> Path:
    """The same drive as a KITTI odometry sequence: scans compensated to their stamp, poses in the camera frame."""
    log, sequence = open_drive(drive), folder / "sequences" / "98"
    for name in ("velodyne", "image_2"):
        (sequence / name).mkdir(parents=True)
    calibration = log.calibration
    camera = calibration.camera()
    Tr, poses, images = camera.T_camera_lidar, [], {image.number: image for image in log.images}
    for k, scan in enumerate(log.scans):
        points = scan.read()
        xyz, T_map_lidar = usable_points_at_stamp(
            points, scan.stamp, trajectory, calibration.T_imu_lidar, 2.0
        )
        rows = np.column_stack([xyz, np.full(len(xyz), 0.5)])
        rows.astype("<f4").tofile(sequence / f"velodyne/{k:06d}.bin")
        poses.append(T_map_lidar)
        if scan.number in images:
            shutil.copy(drive / f"image_02/data/{scan.number:010d}.png", sequence / f"image_2/{k:06d}.png")
    T_map_lidar = np.array(poses)
    T_camera0_k = Tr @ np.linalg.inv(T_map_lidar[0]) @ T_map_lidar @ np.linalg.inv(Tr)
    np.savetxt(sequence / "poses.txt", T_camera0_k[:, :3].reshape(-1, 12), fmt="%.9e")
    np.savetxt(sequence / "times.txt", [scan.stamp for scan in log.scans], fmt="%.9e")
    rows_of = {"P2": np.column_stack([camera.K, np.zeros(3)]), "Tr": Tr[:3]}
    lines = [f"{name}: " + " ".join(f"{v:.12e}" for v in np.ravel(row)) for name, row in rows_of.items()]
    (sequence / "calib.txt").write_text("\n".join(lines) + "\n")
    return sequence
