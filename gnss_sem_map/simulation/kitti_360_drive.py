"""A drive of KITTI-360's rig in the layout of that data set, with the exact truth in the folder of the drive."""

from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from factor_graphs.geodesy import LocalFrame
from gnss_sem_map.datasets.kitti_360 import IMAGES, T_IMU_POSE, geodetic_to_world
from gnss_sem_map.errors import DataError
from gnss_sem_map.simulation.camera import Camera
from gnss_sem_map.simulation.compiled import Floats
from gnss_sem_map.simulation.drive import Simulation, write_oxts, write_scan, write_stamps, write_truth
from gnss_sem_map.simulation.kitti_rig import transform
from gnss_sem_map.simulation.png_files import write_ids, write_photo
from gnss_sem_map.simulation.rigs import MountedCamera
from gnss_sem_map.simulation.table_drive import Progress, made_aside, render_frames

_R_RECT: Final = Rotation.from_euler("ZYX", [-0.10, 0.51, 0.15], degrees=True).as_matrix()
_RECTIFIED: Final = ("image_00", "image_01")


def write_kitti_360(
    simulation: Simulation, out: Path, progress: Progress | None = None, workers: int | None = None
) -> Path:
    """Write a drive of KITTI-360's rig into a folder of `out`; returns the folder of the drive in its `data_3d_raw`.

    See `table_drive.write_table`. Raises DataError for another rig.
    """
    names = [camera.name for camera in simulation.rig.cameras]
    if names != list(IMAGES) or len(simulation.rig.lidars) != 1:
        raise DataError(f"KITTI-360 has one LiDAR and the cameras {', '.join(IMAGES)}; choose its own rig")
    root, name = out / simulation.name, f"{simulation.name}_sync"
    with made_aside(out, root) as partial:
        drive, images, poses = (
            partial / part / name for part in ("data_3d_raw", "data_2d_raw", "data_poses")
        )
        for folder in (
            drive / "velodyne_points" / "data", drive / "truth" / "labels", poses, partial / "calibration",
            *(images / camera / IMAGES[camera] for camera in names),
            *(drive / "truth" / "train_ids" / camera for camera in names),
        ):  # fmt: skip
            folder.mkdir(parents=True)
        _write_calibration(simulation, partial / "calibration")
        morning_ns, stamps = simulation.morning_ns, simulation.stamps
        write_stamps(drive / "velodyne_points" / "timestamps.txt", morning_ns, stamps)
        for camera in simulation.rig.cameras:
            write_stamps(images / camera.name / "timestamps.txt", morning_ns, stamps + camera.stamp_after_s)
        sync = simulation.sync
        write_oxts(poses, morning_ns, simulation.oxts_stamps[sync], simulation.oxts[sync])
        twin = poses.with_name(name.replace("_sync", "_extract"))
        write_oxts(twin, morning_ns, simulation.oxts_stamps, simulation.oxts)
        _write_poses(simulation, poses)
        write_truth(simulation, drive / "truth")
        render_frames(simulation, lambda k: _write_frame(simulation, k, drive, images), progress, workers)
    return root / "data_3d_raw" / name


def _write_frame(simulation: Simulation, k: int, drive: Path, images: Path) -> None:
    name = f"{k:010d}"
    write_scan(drive, name, simulation.scan(k))
    for number, camera in enumerate(simulation.rig.cameras):
        image = simulation.image(k, number)
        folder = images / camera.name / IMAGES[camera.name]
        write_photo(folder / f"{name}.png", image.rgb)
        write_ids(drive / "truth" / "train_ids" / camera.name / f"{name}.png", image.train_ids)


def _camera_in_pose(camera: MountedCamera) -> Floats:
    """T_pose_camera (4, 4); of the rectified cameras, before their rectification."""
    R = _R_RECT if camera.name in _RECTIFIED else np.eye(3)
    return np.asarray(np.linalg.inv(T_IMU_POSE) @ camera.T_imu_camera @ transform(R, (0.0, 0.0, 0.0)))


def _write_calibration(simulation: Simulation, folder: Path) -> None:
    cameras, lidar = simulation.rig.cameras, simulation.rig.lidars[0]
    T_pose_camera = {camera.name: _camera_in_pose(camera) for camera in cameras}
    lines = [f"{name}: {_numbers(T[:3])}\n" for name, T in T_pose_camera.items()]
    (folder / "calib_cam_to_pose.txt").write_text("".join(lines))
    T_lidar_camera0 = np.linalg.inv(lidar.T_imu_lidar) @ T_IMU_POSE @ T_pose_camera["image_00"]
    (folder / "calib_cam_to_velo.txt").write_text(_numbers(T_lidar_camera0[:3]) + "\n")
    lines = []
    for camera in cameras:
        sensor = camera.sensor
        if camera.name in _RECTIFIED:
            beside = np.linalg.inv(camera.T_imu_camera)[:3, 3] - np.linalg.inv(cameras[0].T_imu_camera)[:3, 3]
            P = np.column_stack([sensor.K, sensor.K @ beside])
            values = {"S_rect": np.array([sensor.width, sensor.height]), "R_rect": _R_RECT, "P_rect": P}
            lines += [f"{key}_{camera.name[-2:]}: {_numbers(value)}\n" for key, value in values.items()]
        else:
            (folder / f"{camera.name}.yaml").write_text("\n".join(_fisheye(camera.name, sensor)) + "\n")
    (folder / "perspective.txt").write_text("".join(lines))


def _fisheye(name: str, sensor: Camera) -> Iterator[str]:
    """Lines of its file, as OpenCV writes them."""
    assert sensor.distortion is not None
    yield from ("%YAML:1.0", "---", "model_type: MEI", f"camera_name: {name}")
    yield from (f"image_width: {sensor.width}", f"image_height: {sensor.height}", "mirror_parameters:")
    yield f"   xi: {sensor.distortion.xi:.16e}"
    yield "distortion_parameters:"
    for key, value in zip(("k1", "k2", "p1", "p2"), sensor.distortion.coefficients, strict=True):
        yield f"   {key}: {value:.16e}"
    yield "projection_parameters:"
    f, u, v = sensor.focal_px, sensor.centre_u_px, sensor.centre_v_px
    for key, value in (("gamma1", f), ("gamma2", f), ("u0", u), ("v0", v)):
        yield f"   {key}: {value:.16e}"


def _write_poses(simulation: Simulation, folder: Path) -> None:
    """poses.txt and cam0_to_world.txt: the exact poses at the scans' stamps."""
    T_own_imu = simulation.world.ego.poses(simulation.stamps)
    places = simulation.place.to_geodetic(T_own_imu[:, :3, 3])
    poses, camera0 = [], []
    T_pose_camera0 = np.linalg.inv(T_IMU_POSE) @ simulation.rig.cameras[0].T_imu_camera
    for k, (T, *place) in enumerate(zip(T_own_imu, *(axis.tolist() for axis in places), strict=True)):
        R_here_own = simulation.place.pose_of(LocalFrame(*place))[:3, :3].T
        world = geodetic_to_world(*(np.array([value]) for value in place))[0]
        T_world_pose = transform(R_here_own @ T[:3, :3], tuple(world)) @ T_IMU_POSE
        poses.append(f"{k} {_numbers(T_world_pose[:3])}\n")
        camera0.append(f"{k} {_numbers(T_world_pose @ T_pose_camera0)}\n")
    (folder / "poses.txt").write_text("".join(poses))
    (folder / "cam0_to_world.txt").write_text("".join(camera0))


def _numbers(values: Floats) -> str:
    return " ".join(f"{value:.12g}" for value in np.ravel(values).tolist())
