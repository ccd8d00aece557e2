"""KITTI odometry and SemanticKITTI: `sequences/08` with poses in the camera frame, there or in `poses/08.txt`.

Scans are motion-compensated to mid sweep. Line k of `poses.txt` and `times.txt` belongs to frame k; both usually cover
more frames than there are scans. `poses.txt` are T_camera0_k in the frame of the first camera, so
T_map_lidar = inv(Tr) P Tr: the map is the lidar frame at frame 0, which is not georeferenced.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from factor_graphs.stamps import far_off
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.datasets import frames, kitti_calibration
from gnss_sem_map.datasets.stamps import LONGEST_FRAME_STEP_S, check_unit
from gnss_sem_map.files.pictures import read_picture
from gnss_sem_map.files.untrusted import is_file, is_folder, read_text, refused, shown
from gnss_sem_map.sensor_log import Calibration, Image, Points, Scan, SensorLog
from gnss_sem_map.sensor_log.cameras import Camera

Array = NDArray[np.float64]

SIX_DIGITS = 2e-4
"""Tolerance for rotations: rows of six digits, the product of many multiplications."""
FARTHEST_M = 1e6


CAMERAS = (2, 3, 0, 1)
"""Colour left and right, grey left and right: the first that has a folder is used."""

FORMAT, SIGNS = "kitti-odometry", "calib.txt and poses.txt (KITTI odometry, SemanticKITTI)"


def is_drive(drive: Path) -> bool:
    """Whether a folder looks like an odometry sequence."""
    return is_file(drive / "calib.txt") or is_file(drive / "poses.txt")


def read(sequence: Path, with_imu: bool = True) -> SensorLog:
    """Open an odometry sequence; raises DataError when calibration, poses or times are missing or malformed."""
    file = sequence / "calib.txt"
    camera = next((n for n in CAMERAS if is_folder(sequence / f"image_{n}")), CAMERAS[0])
    name = "Tr_velo_to_cam" if is_file(file) and "Tr_velo_to_cam:" in read_text(file) else "Tr"
    about = kitti_calibration.CalibrationFile(file, {f"P{camera}": 12, name: 12})
    Tr = about.pose(name)
    times = _times(sequence / "times.txt")
    poses = _poses(_poses_file(sequence))
    if len(times) != len(poses):
        raise refused(
            sequence,
            f"found {len(poses)} poses and {len(times)} times, expected as many; of one sequence?",
        )
    stamps, why = dict(enumerate(times.tolist())), "no pose for this frame"
    scans = frames.numbered("scan", sequence / "velodyne", ".bin")
    images = frames.numbered("image", sequence / f"image_{camera}", *frames.IMAGE_SUFFIXES)
    size = frames.first_size(images.files.values())
    K, T_camera_camera0 = about.projection(f"P{camera}")
    cameras = () if size is None else (Camera(T_camera_camera0 @ Tr, K, size),)
    of_scans, lost_scans = scans.joined(stamps, why) if is_folder(scans.folder) else ([], scans.skips)
    of_images, lost_images = images.joined(stamps, why) if is_folder(images.folder) else ([], images.skips)
    return SensorLog(
        name=f"sequence {shown(sequence.name)}",
        epoch_ns=0,
        calibration=Calibration(np.eye(4), cameras),
        scans=tuple(
            Scan(path.stem, n, stamp, partial(_read_compensated, path, frames.state_of(path)))
            for n, path, stamp in of_scans
        ),
        images=tuple(Image(n, stamp, partial(read_picture, path, size)) for n, path, stamp in of_images),
        given=Trajectory(times, _lidar_poses(poses, Tr)),
        skips=(*lost_scans, *lost_images),
    )


def _poses_file(sequence: Path) -> Path:
    """Of SemanticKITTI in the sequence; as KITTI odometry is downloaded, in `poses` beside `sequences`."""
    name = sequence.resolve()
    beside = name.parent.parent / "poses" / f"{name.name}.txt"
    own = sequence / "poses.txt"
    if is_file(own) or is_file(beside):
        return own if is_file(own) else beside
    raise refused(
        own,
        f"missing, and so is {shown(beside)}; expected 12 numbers a line; or map its raw drive",
    )


def _times(path: Path) -> Array:
    """Stamps, s, that increase; raises DataError, with the line, for anything else."""
    times = kitti_calibration.read_table(path, 1)[:, 0]
    backwards = np.flatnonzero(np.diff(times) <= 0)
    if len(backwards):
        line = int(backwards[0]) + 2
        raise refused(
            path,
            f"line {line}: {times[line - 1]:.9g} after {times[line - 2]:.9g}, expected rising",
        )
    check_unit(times, LONGEST_FRAME_STEP_S, shown(path))
    off = np.flatnonzero(far_off(times))
    if len(off):
        raise refused(
            path,
            f"line {off[0] + 1}: found {times[off[0]]:.9g} s, far off all others",
        )
    return times


def _poses(path: Path) -> Array:
    """Poses (k, 3, 4); raises DataError, with the line, for one that is no rigid transform."""
    poses = kitti_calibration.read_table(path, 12).reshape(-1, 3, 4)
    R = poses[:, :, :3]
    with np.errstate(all="ignore"):
        off = np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max(axis=(1, 2))
        wrong = ~(off <= SIX_DIGITS) | ~(np.linalg.det(R) > 0)
    if wrong.any():
        line = int(np.flatnonzero(wrong)[0])
        raise refused(
            path,
            f"line {line + 1}: {kitti_calibration.rotation_fault(R[line])} in {wrong.sum()} of {len(poses)} poses",
        )
    far = ~(np.abs(poses[:, :, 3]) <= FARTHEST_M).all(axis=1)
    if far.any():
        line = int(np.flatnonzero(far)[0])
        raise refused(
            path,
            f"line {line + 1}: found a position {np.abs(poses[line, :, 3]).max():.3g} m away",
        )
    return poses


def _lidar_poses(poses: Array, Tr: Array) -> Array:
    T_camera0_camera = np.tile(np.eye(4), (len(poses), 1, 1))
    T_camera0_camera[:, :3] = poses
    T_map_lidar: Array = np.linalg.inv(Tr) @ T_camera0_camera @ Tr
    # poses.txt has six digits; make the rotations orthonormal again
    u, _, vt = np.linalg.svd(T_map_lidar[:, :3, :3])
    T_map_lidar[:, :3, :3] = u @ vt
    return T_map_lidar


def _read_compensated(path: Path, state: frames.State | None) -> Points:
    rows = frames.read_points(path, state=state)
    return Points(rows[:, :3], rows[:, 3], None)
