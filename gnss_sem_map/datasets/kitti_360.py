"""KITTI-360 drives: the folder of a drive in `data_3d_raw`; calibration, images and poses are in folders beside it.

    ROOT/calibration/         calib_cam_to_pose.txt calib_cam_to_velo.txt perspective.txt image_02.yaml image_03.yaml
    ROOT/data_3d_raw/DRIVE/   velodyne_points/; the SICK scanners are left out
    ROOT/data_2d_raw/DRIVE/   image_00 image_01 (data_rect), image_02 image_03 (data_rgb): those that are there
    ROOT/data_poses/DRIVE/    oxts/, poses.txt; oxts/ at 100 Hz is in DRIVE with `_extract` for `_sync`, there or in
                              ROOT/data_poses_oxts_extract

Facts that this reader relies on, by the devkit of the data set: images 00 and 01 are rectified, 02 and 03 are fisheyes
by Mei's model; the frame of `poses.txt` and of the calibration is x ahead, y right, z down; the world of `poses.txt` is
Mercator's projection, scaled to metres at a place in Karlsruhe, and the height; the LiDAR turns clockwise from the
rear, and its stamp is the middle of the sweep. Rows of oxts are taken to be those of KITTI raw, x ahead, y left, z up;
an IMU with other axes is found by `check`. With oxts the trajectory is estimated; without it, `poses.txt` is the
trajectory.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from factor_graphs.geodesy import LocalFrame
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.datasets import frames, kitti_calibration, kitti_oxts, kitti_raw
from gnss_sem_map.datasets.kitti_calibration import read_table
from gnss_sem_map.datasets.stamps import in_order
from gnss_sem_map.files.structured import MOST_YAML_BYTES, fault_of, parse_yaml
from gnss_sem_map.files.untrusted import is_file, is_folder, read_text, refused, shown
from gnss_sem_map.sensor_log import Calibration, Image, Scan, SensorLog, Skip
from gnss_sem_map.sensor_log.cameras import Camera, Distortion, lidar_to_camera

Array = NDArray[np.float64]

IMAGES = {"image_00": "data_rect", "image_01": "data_rect", "image_02": "data_rgb", "image_03": "data_rgb"}
"""Folders of the images of each camera."""
T_IMU_POSE = np.diag([1.0, -1.0, -1.0, 1.0])
"""From the frame of the poses, x ahead, y right, z down, to that of the imu."""
ORIGIN_LAT_DEG, ORIGIN_LON_DEG = 48.9843445, 8.4295857
"""Origin of the world of `poses.txt`."""
MERCATOR_M = 6_378_137.0 * np.cos(np.radians(ORIGIN_LAT_DEG))
"""Radius of its projection."""
USUAL_SWEEP_S = 0.1

FORMAT, SIGNS = "kitti-360", "velodyne_points/ with ../../calibration/calib_cam_to_velo.txt (KITTI-360)"


class _Mirror(BaseModel):
    xi: float


class _Bent(BaseModel):
    k1: float
    k2: float
    p1: float
    p2: float


class _Projected(BaseModel):
    gamma1: float = Field(gt=0)
    gamma2: float = Field(gt=0)
    u0: float
    v0: float


class FisheyeFile(BaseModel):
    """Content of image_02.yaml and image_03.yaml."""

    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)

    image_width: int = Field(gt=0)
    image_height: int = Field(gt=0)
    mirror_parameters: _Mirror
    distortion_parameters: _Bent
    projection_parameters: _Projected


def is_drive(drive: Path) -> bool:
    """Whether a folder looks like a KITTI-360 drive."""
    return is_folder(drive / "velodyne_points") and is_file(
        _root(drive) / "calibration" / "calib_cam_to_velo.txt"
    )


def read(drive: Path, with_imu: bool = True) -> SensorLog:
    """Open a KITTI-360 drive; raises DataError when calibration, stamps or poses are missing or malformed."""
    root, name = _root(drive), drive.resolve().name
    about, poses = root / "calibration", root / "data_poses" / name
    stamps_ns, skips = kitti_calibration.stamps_ns(drive / "velodyne_points" / "timestamps.txt")
    if not stamps_ns:
        raise refused(drive / "velodyne_points" / "timestamps.txt", "found no stamp")
    unit = None
    if is_folder(poses / "oxts"):
        twin = name.replace("_sync", "_extract")
        unit = kitti_oxts.navigation(
            poses, (poses.parent / twin, root / "data_poses_oxts_extract" / twin), with_imu
        )
        skips += unit.skips
    epoch_ns = unit.epoch_ns if unit else min(stamps_ns.values())
    frame, track = _poses(poses / "poses.txt", stamps_ns, epoch_ns, unit.frame if unit else None)
    if unit is None and track is None:
        raise refused(poses, "found neither oxts nor poses.txt; expected one of them")
    scans, scan_skips = _scans(drive / "velodyne_points", stamps_ns, epoch_ns)
    names = [camera for camera in IMAGES if is_folder(root / "data_2d_raw" / name / camera / IMAGES[camera])]
    calibration = _calibration(about, names)
    images, image_skips = _images(root / "data_2d_raw" / name, names, calibration, epoch_ns, stamps_ns)
    return SensorLog(
        name=shown(name),
        epoch_ns=epoch_ns,
        calibration=calibration,
        scans=scans,
        images=images,
        frame=frame,
        imu=unit.imu if unit else None,
        gnss=unit.gnss if unit else None,
        imu_noise=kitti_oxts.OXTS_NOISE if unit else None,
        initial_attitude=unit.attitude if unit else None,
        given=None if unit else track,
        reference=(track or unit.reference) if unit else None,
        skips=(*skips, *scan_skips, *image_skips),
    )


def _root(drive: Path) -> Path:
    return drive.resolve().parent.parent


def _scans(folder: Path, stamps_ns: dict[int, int], epoch_ns: int) -> tuple[tuple[Scan, ...], list[Skip]]:
    found, skips = frames.numbered("scan", folder / "data", ".bin").joined(stamps_ns)
    steps = np.diff(sorted(stamps_ns.values())) * 1e-9
    half = 0.5 * (float(np.median(steps)) if len(steps) else USUAL_SWEEP_S)
    timed = ((n, path, (ns - epoch_ns) * 1e-9) for n, path, ns in found)
    scans = [kitti_raw.scan_of(path, n, stamp, stamp - half, stamp + half) for n, path, stamp in timed]
    return in_order("scan", scans, skips), skips


def _images(
    folder: Path, names: list[str], calibration: Calibration, epoch_ns: int, of_scans: dict[int, int]
) -> tuple[tuple[Image, ...], list[Skip]]:
    images: list[Image] = []
    skips: list[Skip] = []
    for name, camera in zip(names, calibration.cameras, strict=True):
        found = frames.numbered("image", folder / name / IMAGES[name], *frames.IMAGE_SUFFIXES)
        of_camera, lost = kitti_raw.stamped_images(found, epoch_ns, camera.image_size, camera.name, of_scans)
        images += of_camera
        skips += lost
    return tuple(sorted(images, key=lambda image: image.stamp)), skips


def _calibration(folder: Path, names: list[str]) -> Calibration:
    """Pose of the LiDAR, and the cameras of these names; an only one has none."""
    to_pose = kitti_calibration.CalibrationFile(folder / "calib_cam_to_pose.txt", dict.fromkeys(IMAGES, 12))
    T_pose_camera = {name: kitti_calibration.exact(to_pose.pose(name)) for name in IMAGES}
    file = folder / "calib_cam_to_velo.txt"
    T_lidar_camera0 = _rigid(read_table(file, 12)[0], shown(file))
    T_imu_lidar = T_IMU_POSE @ T_pose_camera["image_00"] @ np.linalg.inv(T_lidar_camera0)
    cameras = []
    for name in names:
        T_camera_lidar = lidar_to_camera(T_IMU_POSE @ T_pose_camera[name], T_imu_lidar)
        called = name if len(names) > 1 else ""
        if name in ("image_00", "image_01"):
            R_rect, K, size = _rectified(folder / "perspective.txt", name[-2:])
            cameras.append(Camera(R_rect @ T_camera_lidar, K, size, name=called))
        else:
            K, size, lens = _fisheye(folder / f"{name}.yaml")
            cameras.append(Camera(T_camera_lidar, K, size, distortion=lens, name=called))
    return Calibration(T_imu_lidar, tuple(cameras))


def _rigid(row: Array, where: str) -> Array:
    return kitti_calibration.exact(kitti_calibration.transform(row, where))


def _rectified(file: Path, number: str) -> tuple[Array, Array, tuple[int, int]]:
    """The rotation (4, 4) that rectifies a camera, K, and (width, height)."""
    R, P, S = (f"{name}_rect_{number}" for name in "RPS")
    about = kitti_calibration.CalibrationFile(file, {R: 9, P: 12, S: 2})
    # the shift in P is that between the two cameras, which their poses have already
    return kitti_calibration.exact(about.pose(R)), about.projection(P)[0], about.size(S)


def _fisheye(file: Path) -> tuple[Array, tuple[int, int], Distortion]:
    """K, (width, height) and lens of a fisheye, from a file as OpenCV writes it."""
    if not is_file(file):
        raise refused(file, "missing calibration file; its images are there")
    text = re.sub(r"^%YAML[^\n]*\n", "", read_text(file, MOST_YAML_BYTES))
    try:
        about = FisheyeFile.model_validate(parse_yaml(re.sub(r":(?=[^\s])", ": ", text)))
        bent, projected = about.distortion_parameters, about.projection_parameters
        coefficients = (bent.k1, bent.k2, bent.p1, bent.p2)
        lens = Distortion(model="mei", coefficients=coefficients, xi=about.mirror_parameters.xi)
    except ValidationError as error:
        raise refused(file, f"{fault_of(error)}; expected the model of Mei") from None
    except ValueError as error:
        raise refused(file, f"not YAML ({error})") from None
    K = np.array([[projected.gamma1, 0, projected.u0], [0, projected.gamma2, projected.v0], [0, 0, 1.0]])
    return K, (about.image_width, about.image_height), lens


def _poses(
    file: Path, stamps_ns: dict[int, int], epoch_ns: int, frame: LocalFrame | None
) -> tuple[LocalFrame | None, Trajectory | None]:
    """The frame of the map (by default at the first pose), and `poses.txt` in it; no trajectory without it."""
    if not is_file(file):
        return frame, None
    rows = read_table(file, 13)
    rows = rows[np.isin(rows[:, 0], list(stamps_ns))]
    stamps = np.array([(stamps_ns[int(number)] - epoch_ns) * 1e-9 for number in rows[:, 0]])
    if len(stamps) < 2 or (np.diff(stamps) <= 0).any():
        raise refused(
            file,
            f"found {len(stamps)} poses of frames with a stamp, expected 2 or more in order",
        )
    T_world_pose = np.stack([_rigid(row, f"{shown(file)}: frame {row[0]:g}") for row in rows[:, 1:]])
    places = world_to_geodetic(T_world_pose[:, :3, 3])
    frame = frame or LocalFrame(*(float(axis[0]) for axis in places))
    T_map_imu = T_world_pose @ T_IMU_POSE
    for pose, *place in zip(T_map_imu, *(axis.tolist() for axis in places), strict=True):
        here = frame.pose_of(LocalFrame(*place))  # east, north and up of that place
        pose[:3, :3], pose[:3, 3] = here[:3, :3] @ pose[:3, :3], here[:3, 3]
    return frame, Trajectory(stamps, T_map_imu)


def world_to_geodetic(points: Array) -> tuple[Array, Array, Array]:
    """Latitude and longitude in degrees, and height, m, of points (n, 3) of the world of `poses.txt`."""
    x0, y0 = MERCATOR_M * np.radians(ORIGIN_LON_DEG), _northing(np.array(ORIGIN_LAT_DEG))
    lat = 2 * np.arctan(np.exp((points[:, 1] + y0) / MERCATOR_M)) - np.pi / 2
    return np.degrees(lat), np.degrees((points[:, 0] + x0) / MERCATOR_M), points[:, 2]


def geodetic_to_world(lat_deg: Array, lon_deg: Array, alt_m: Array) -> Array:
    """Points (n, 3) of the world of `poses.txt`."""
    y0 = _northing(np.array(ORIGIN_LAT_DEG))
    return np.column_stack(
        [MERCATOR_M * np.radians(lon_deg - ORIGIN_LON_DEG), _northing(lat_deg) - y0, alt_m]
    )


def _northing(lat_deg: Array) -> Array:
    return np.asarray(MERCATOR_M * np.log(np.tan(np.pi / 4 + np.radians(lat_deg) / 2)))
