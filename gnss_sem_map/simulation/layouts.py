"""A simulated drive in other layouts than KITTI raw: a CSV log, a ROS 1 bag, a ROS 2 bag (MCAP).

Stamps, points, pixels and calibration are those of the KITTI raw drive to the bit, and so is the map. The drive of a
rig with several sensors is written as a CSV log, and a bag from that.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gnss_sem_map.datasets import csv_log, kitti_oxts, kitti_raw
from gnss_sem_map.datasets.ros.rig import NAME as RIG
from gnss_sem_map.errors import DataError
from gnss_sem_map.sensor_log import Image, Scan, SensorLog, file_of
from gnss_sem_map.sensor_log.cameras import Camera
from gnss_sem_map.simulation.bags import BagWriter
from gnss_sem_map.simulation.drive import Simulation, refuse_there
from gnss_sem_map.simulation.kitti_360_drive import write_kitti_360
from gnss_sem_map.simulation.table_drive import made_aside, write_table

Array = NDArray[np.float64]
Progress = Callable[[int, int], None]
Event = tuple[int, Callable[[int], None]]
"""Unix ns, and what writes the message of that moment."""
Layout = Literal["kitti-raw", "table", "rosbag1", "mcap", "kitti-360"]
TRUTH: Final = "truth"
LAT, LON, ALT = kitti_oxts.LAT, kitti_oxts.LON, kitti_oxts.ALT
FORCE, RATE = kitti_oxts.SPECIFIC_FORCE, kitti_oxts.ANGULAR_RATE
IMAGE, INFO = "/camera/image_rect_color/compressed", "/camera/camera_info"


def write_in_layout(
    out: Path,
    layout: Layout,
    simulate: Callable[[Path], Path],
    progress: Progress | None = None,
) -> Path:
    """A drive in a layout, in `out`; `simulate` writes it in KITTI raw into a folder, and returns the drive's own."""
    if layout == "kitti-raw":
        return simulate(out)
    out.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(prefix=".simulated-", dir=out) as folder:
        return rewrite(simulate(Path(folder)), out, layout, progress)


def rewrite(drive: Path, out: Path, layout: Layout, progress: Progress | None = None) -> Path:
    """Write a KITTI raw drive of the simulator in another layout, with its truth; returns its folder in `out`.

    Raises DataError when it is already there.
    """
    target = out / drive.name.removesuffix("_sync")
    refuse_there(target)
    log = kitti_raw.read(drive)
    partial = drive.parent / layout / target.name  # a bag names its files by its folder
    if layout == "table":
        _write_table(drive, log, partial, progress)
    else:
        _write_bag(drive, log, partial, layout, progress)
    if (drive / TRUTH).is_dir():
        shutil.copytree(drive / TRUTH, partial / TRUTH)
    out.mkdir(parents=True, exist_ok=True)
    shutil.move(partial, target)
    partial.parent.rmdir()
    return target


def _write_table(drive: Path, log: SensorLog, out: Path, progress: Progress | None) -> None:
    assert log.imu is not None
    (out / "lidar").mkdir(parents=True)
    (out / "images").mkdir()
    imu = np.column_stack([log.imu.stamps, log.imu.specific_force, log.imu.angular_rate])
    _write_rows(out / "imu.csv", "stamp_s,ax,ay,az,wx,wy,wz", imu)
    header = "stamp_s,lat_deg,lon_deg,alt_m,std_e_m,std_n_m,std_u_m"
    stamps_ns, rows, accuracy = _fixes(drive)
    stamps = (stamps_ns - log.epoch_ns) * 1e-9
    _write_rows(out / "gnss.csv", header, np.column_stack([stamps, rows, accuracy, accuracy, accuracy]))
    (out / "log.yaml").write_text(json.dumps(_about_table(drive, log), indent=1) + "\n")  # JSON is YAML
    for done, scan in enumerate(log.scans, 1):
        cloud = _cloud(scan)
        (out / "lidar" / f"{scan.name}.bin").write_bytes(cloud.astype("<f4").tobytes())
        if progress is not None:
            progress(done, len(log.scans))
    for image in log.images:
        shutil.copy(_file(image), out / "images")
    for name, items in (("lidar", log.scans), ("images", log.images)):
        lines = [f"{item.number},{item.stamp!r}\n" for item in items]
        (out / name / "stamps.csv").write_text("number,stamp_s\n" + "".join(lines))


def _about_table(drive: Path, log: SensorLog) -> dict[str, Any]:
    calibration, noise = log.calibration, log.imu_noise
    camera = calibration.camera()
    assert noise is not None
    return {
        "epoch_ns": log.epoch_ns,
        "T_imu_lidar": calibration.T_imu_lidar.tolist(),
        "T_camera_lidar": camera.T_camera_lidar.tolist(),
        "K": camera.K.tolist(),
        "image_size": camera.image_size,
        "camera_time_offset_s": camera.time_offset_s,
        "imu_noise": noise.model_dump(),
        "initial_attitude": {
            "quaternion_xyzw": kitti_oxts.quaternions(_imu_rows(drive)[1][:1])[0].tolist(),
            "stddevs_rad": kitti_oxts.ATTITUDE_STDDEVS_RAD.tolist(),
        },
    }


def _write_bag(drive: Path, log: SensorLog, out: Path, layout: Layout, progress: Progress | None) -> None:
    """Messages in the order of their stamps, as a recorder writes them."""
    with BagWriter(out, is_ros1=layout == "rosbag1") as bag:
        calibration = log.calibration
        camera = kitti_raw.camera_from_lidar(kitti_raw.date_folder(drive))
        T_lidar_imu = kitti_raw.lidar_from_imu(kitti_raw.date_folder(drive))
        imu_ns, imu = _imu_rows(drive)
        fix_ns, fixes, accuracy = _fixes(drive)
        start_ns = int(min(imu_ns[0], fix_ns[0]))
        bag.write_transforms(
            start_ns, [("camera", "lidar", camera.T_camera_lidar), ("lidar", "imu", T_lidar_imu)]
        )
        attitudes = kitti_oxts.quaternions(imu)
        events: list[Event] = []
        for k, ns in enumerate(imu_ns.tolist()):
            events.append((ns, _later(bag.write_imu, imu[k, FORCE], imu[k, RATE], attitudes[k])))
        for k, ns in enumerate(fix_ns.tolist()):
            events.append((ns, _later(bag.write_fix, fixes[k], float(accuracy[k]))))
        for scan in log.scans:
            events.append((_ns(log, scan.stamp), _later(_write_cloud, bag, scan)))
        for image in log.images:
            ns = _ns(log, image.stamp)
            events.append((ns, _later(bag.write_image, _file(image), IMAGE, "camera")))
            events.append((ns, _later(bag.write_info, INFO, "camera", camera.K, camera.image_size)))
        _write_in_order(events, progress)
    rig = {
        "imu": {
            "topic": "/imu", "noise": None if log.imu_noise is None else log.imu_noise.model_dump(), "attitude": True,
        },
        "gnss": {"topic": "/fix"},
        "lidars": {"lidar": {"topic": "/points"}},
        "cameras": {
            "camera": {
                "topic": IMAGE, "info": INFO,
                "time_offset_s": calibration.camera().time_offset_s,
            }
        },
    }  # fmt: skip
    (out / RIG).write_text(json.dumps(rig, indent=1) + "\n")


def _write_in_order(events: list[Event], progress: Progress | None) -> None:
    for written, (ns, write) in enumerate(sorted(events, key=lambda event: event[0]), 1):
        write(ns)
        if progress is not None:
            progress(written, len(events))


def _write_cloud(ns: int, bag: BagWriter, scan: Scan) -> None:
    bag.write_cloud(ns, _cloud(scan))  # read when it is its turn


def write_rig(
    simulation: Simulation,
    out: Path,
    layout: Layout,
    progress: Progress | None = None,
    workers: int | None = None,
) -> Path:
    """Write the drive of a rig with its truth into a folder of `out`, see `write_table`; returns the folder."""
    if layout == "kitti-raw":
        raise DataError("KITTI raw has one LiDAR and one camera; choose the layout table, rosbag1 or mcap")
    if layout == "kitti-360":
        return write_kitti_360(simulation, out, progress, workers)
    if layout == "table":
        return write_table(simulation, out, progress, workers)
    target = out / simulation.name
    with made_aside(out, target) as partial:
        drive = write_table(simulation, partial.parent / "table", progress, workers)
        _write_rig_bag(csv_log.read(drive), partial, is_ros1=layout == "rosbag1")
        shutil.move(drive / TRUTH, partial / TRUTH)
    return target


def _write_rig_bag(log: SensorLog, out: Path, is_ros1: bool) -> None:
    """Topics /NAME/points, /NAME/image_raw/compressed and /NAME/camera_info; frames of cameras are NAME_optical."""
    assert log.imu is not None
    assert log.gnss is not None
    assert log.frame is not None
    assert log.initial_attitude is not None
    out.rmdir()  # the writer of a bag makes it
    cameras = log.calibration.cameras
    with BagWriter(out, is_ros1) as bag:
        T_imu_camera = {
            camera.name: log.calibration.T_imu_lidar @ np.linalg.inv(camera.T_camera_lidar)
            for camera in cameras
        }
        edges = [("imu", _name(of), of.calibration.T_imu_lidar) for of in log.by_lidar]
        edges += [("imu", f"{name}_optical", T) for name, T in T_imu_camera.items()]
        bag.write_transforms(_ns(log, float(log.imu.stamps[0])), edges)
        first = Rotation.from_matrix(log.initial_attitude.R_map_imu).as_quat()
        events: list[Event] = []
        for k, stamp in enumerate(log.imu.stamps.tolist()):
            force, rate = log.imu.specific_force[k], log.imu.angular_rate[k]
            events.append((_ns(log, stamp), _later(bag.write_imu, force, rate, None if k else first)))
        places = np.column_stack(log.frame.to_geodetic(log.gnss.positions))
        for k, stamp in enumerate(log.gnss.stamps.tolist()):
            accuracy = float(log.gnss.stddevs[k, 0])
            events.append((_ns(log, stamp), _later(bag.write_fix, places[k], accuracy)))
        for of in log.by_lidar:
            for scan in of.scans:
                events.append((_ns(log, scan.stamp), _later(_write_file, bag, scan, _name(of))))
        for camera in cameras:
            for image in log.images_of(camera.name):
                events += _image_events(log, image, camera, bag)
        _write_in_order(events, None)
    (out / RIG).write_text(json.dumps(_about_rig(log), indent=1) + "\n")


def _write_file(ns: int, bag: BagWriter, scan: Scan, lidar: str) -> None:
    rows = np.fromfile(_file(scan), "<f4").reshape(-1, 5)
    bag.write_cloud(ns, rows, f"/{lidar}/points", lidar)


def _image_events(log: SensorLog, image: Image, camera: Camera, bag: BagWriter) -> list[Event]:
    ns, name = _ns(log, image.stamp), camera.name
    events = [(ns, _later(bag.write_image, _file(image), _image_topic(name), f"{name}_optical"))]
    if not _has_no_info(camera):
        given = (f"/{name}/camera_info", f"{name}_optical", camera.K, camera.image_size, camera.distortion)
        events.append((ns, _later(bag.write_info, *given)))
    return events


def _name(of: SensorLog) -> str:
    return of.lidar or "lidar"


def _image_topic(camera: str) -> str:
    return f"/{camera}/image_raw/compressed"


def _has_no_info(camera: Camera) -> bool:
    return camera.distortion is not None and camera.distortion.model == "mei"


def _about_rig(log: SensorLog) -> dict[str, Any]:
    """What the bag does not say: the noise of the IMU, delays of the cameras, and lenses that ROS does not know."""
    cameras: dict[str, dict[str, Any]] = {}
    for camera in log.calibration.cameras:
        about: dict[str, Any] = {"topic": _image_topic(camera.name), "time_offset_s": camera.time_offset_s}
        if _has_no_info(camera):
            assert camera.distortion is not None
            about |= {"K": camera.K.tolist(), "image_size": camera.image_size}
            about |= {"distortion": camera.distortion.model_dump()}
        else:
            about |= {"info": f"/{camera.name}/camera_info"}
        cameras[camera.name] = about
    noise = None if log.imu_noise is None else log.imu_noise.model_dump()
    return {
        "imu": {"topic": "/imu", "noise": noise, "attitude": True},
        "gnss": {"topic": "/fix"},
        "lidars": {_name(of): {"topic": f"/{_name(of)}/points"} for of in log.by_lidar},
        "cameras": cameras,
    }


def _later(write: Callable[..., None], *values: Any) -> Callable[[int], None]:
    return lambda ns: write(ns, *values)


def _ns(log: SensorLog, stamp: float) -> int:
    return log.epoch_ns + round(stamp * 1e9)


def _imu_rows(drive: Path) -> tuple[NDArray[np.int64], Array]:
    """Unix ns and oxts rows, at 100 Hz where the drive has its twin."""
    twin = drive.with_name(drive.name.replace("_sync", "_extract"))
    stamps, rows, _ = kitti_oxts.oxts_rows(twin if twin.is_dir() else drive)
    return stamps, rows


def _fixes(drive: Path) -> tuple[NDArray[np.int64], Array, Array]:
    """Unix ns, latitude, longitude, height (n, 3), and accuracy (n,) m."""
    stamps, rows, _ = kitti_oxts.oxts_rows(drive)
    return stamps, rows[:, [LAT, LON, ALT]], rows[:, kitti_oxts.POSITION_ACCURACY]


def _cloud(scan: Scan) -> NDArray[np.float32]:
    """x, y, z, intensity and the time after the scan's stamp (n, 5)."""
    assert scan.sweep is not None
    rows = scan.read().rows.reshape(-1, 4)
    return np.column_stack([rows, kitti_raw.seconds_after(rows, scan.stamp, *scan.sweep)])


def _file(item: Any) -> Path:
    path = file_of(item)
    assert path is not None
    return path


def _write_rows(path: Path, header: str, rows: Array) -> None:
    lines = [",".join(map(repr, row)) + "\n" for row in rows.tolist()]
    path.write_text(header + "\n" + "".join(lines))
