"""KITTI odometry and SemanticKITTI sequences: `sequences/08` with poses in the camera frame.

Scans are motion-compensated to mid sweep. Line k of `poses.txt` and `times.txt` belongs to frame k; both usually cover
more frames than there are scans. `poses.txt` are T_camera0_k in the frame of the first camera, so
T_map_lidar = inv(Tr) P Tr: the map is the lidar frame at frame 0, which is not georeferenced.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from factor_graphs.trajectory import Trajectory
from gnss_sem_map.errors import DataError
from gnss_sem_map.io import frames, kitti_calibration
from gnss_sem_map.sensor_log import Calibration, Image, Points, Scan, SensorLog, Skip

Array = NDArray[np.float64]


def read(sequence: Path) -> SensorLog:
    """Open an odometry sequence; raises DataError when calibration, poses or times are missing or malformed."""
    rows = kitti_calibration.read_rows(sequence / "calib.txt", {"P2": 12, "Tr": 12})
    Tr = np.vstack([rows["Tr"].reshape(3, 4), [0, 0, 0, 1]])
    times = _table(sequence / "times.txt", 1)[:, 0]
    poses = _table(sequence / "poses.txt", 12).reshape(-1, 3, 4)
    if len(times) != len(poses):
        raise DataError(
            f"{sequence}: found {len(poses)} poses and {len(times)} times, expected as many;"
            " are poses.txt and times.txt of the same sequence?"
        )
    scan_files = frames.numbered(sequence / "velodyne", ".bin")
    image_files = frames.numbered(sequence / "image_2", ".png")
    size = _image_size(image_files)
    K, T_camera_camera0 = kitti_calibration.split_projection(rows["P2"])
    calibration = Calibration(
        T_imu_lidar=np.eye(4), T_camera_lidar=T_camera_camera0 @ Tr, K=K, image_size=size
    )
    skips = [
        *_left_out("scan", sequence / "velodyne", ".bin", len(poses), scan_files),
        *_left_out("image", sequence / "image_2", ".png", len(poses), image_files),
    ]
    return SensorLog(
        name=f"sequence {sequence.name}",
        epoch_ns=0,
        calibration=calibration,
        scans=tuple(
            Scan(path.stem, number, float(times[number]), partial(_read_compensated, path))
            for number, path in scan_files.items()
            if number < len(poses)
        ),
        images=tuple(
            Image(number, float(times[number]), partial(frames.read_image, path, size))
            for number, path in image_files.items()
            if number < len(poses)
        ),
        given=Trajectory(times, _lidar_poses(poses, Tr)),
        skips=tuple(skips),
    )


def _left_out(what: str, folder: Path, suffix: str, poses: int, files: dict[int, Path]) -> list[Skip]:
    """Frames with a pose and no file, files without a pose, and files of a frame that has another one."""
    beyond = [path for number, path in files.items() if number >= poses]
    return [
        *(frames.missing(what, folder, range(poses), files) if folder.is_dir() else ()),
        *(Skip(what, str(path), "no pose for this frame") for path in beyond),
        *frames.repeated(folder, suffix, what, files),
    ]


def _lidar_poses(poses: Array, Tr: Array) -> Array:
    T_camera0_camera = np.tile(np.eye(4), (len(poses), 1, 1))
    T_camera0_camera[:, :3] = poses
    T_map_lidar: Array = np.linalg.inv(Tr) @ T_camera0_camera @ Tr
    # poses.txt has six digits: make the rotations orthonormal again
    u, _, vt = np.linalg.svd(T_map_lidar[:, :3, :3])
    T_map_lidar[:, :3, :3] = u @ vt
    return T_map_lidar


def _read_compensated(path: Path) -> Points:
    rows = frames.read_points(path)
    return Points(rows[:, :3], rows[:, 3], None)


def _table(path: Path, columns: int) -> Array:
    """Rows of numbers; raises DataError, with the line, for anything else."""
    if not path.is_file():
        raise DataError(f"{path}: missing; expected one line of {columns} numbers per frame")
    rows = []
    for number, line in enumerate(path.read_text("utf-8", errors="replace").splitlines(), 1):
        if not line.strip():
            continue
        try:
            row = [float(word) for word in line.split()]
        except ValueError:
            row = []
        if len(row) != columns or not np.isfinite(row).all():
            raise DataError(f"{path}: line {number}: found {line[:40]!r}, expected {columns} finite numbers")
        rows.append(row)
    if not rows:
        raise DataError(f"{path}: empty; expected one line of {columns} numbers per frame")
    return np.array(rows)


def _image_size(files: dict[int, Path]) -> tuple[int, int] | None:
    """(width, height) of the first image that can be read: the odometry calibration does not say it."""
    for path in files.values():
        try:
            height, width = frames.read_image(path, None).shape[:2]
        except DataError:
            continue
        return width, height
    return None
