"""A simulated drive in other layouts than KITTI raw: a CSV log, a ROS 1 bag, a ROS 2 bag (MCAP).

Stamps, points, pixels and calibration are those of the KITTI raw drive to the bit, and so is the map.
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

from gnss_sem_map.datasets import kitti_raw
from gnss_sem_map.datasets.ros.rig import NAME as RIG
from gnss_sem_map.errors import DataError
from gnss_sem_map.sensor_log import Scan, SensorLog, file_of
from gnss_sem_map.simulation.bags import BagWriter

Array = NDArray[np.float64]
Layout = Literal["kitti-raw", "table", "rosbag1", "mcap"]
TRUTH: Final = "truth"
LAT, LON, ALT = kitti_raw.LAT, kitti_raw.LON, kitti_raw.ALT


def write_in_layout(
    out: Path,
    layout: Layout,
    simulate: Callable[[Path], Path],
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """A drive in a layout, in `out`; `simulate` writes it in KITTI raw into a folder, and returns the drive's own."""
    if layout == "kitti-raw":
        return simulate(out)
    out.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(prefix=".simulated-", dir=out) as folder:
        return rewrite(simulate(Path(folder)), out, layout, progress)


def rewrite(
    drive: Path, out: Path, layout: Layout, progress: Callable[[int, int], None] | None = None
) -> Path:
    """Write a KITTI raw drive of the simulator in another layout, with its truth; returns its folder in `out`.

    Raises DataError when it is already there.
    """
    target = out / drive.name.removesuffix("_sync")
    if target.exists():
        raise DataError(f"{target}: is already there; remove it or simulate into another folder")
    log = kitti_raw.read(drive)
    partial = drive.parent / f"{target.name}.{layout}"
    if layout == "table":
        _write_table(drive, log, partial, progress)
    else:
        _write_bag(drive, log, partial, layout, progress)
    if (drive / TRUTH).is_dir():
        shutil.copytree(drive / TRUTH, partial / TRUTH)
    out.mkdir(parents=True, exist_ok=True)
    shutil.move(partial, target)
    return target


def _write_table(drive: Path, log: SensorLog, out: Path, progress: Callable[[int, int], None] | None) -> None:
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
            "quaternion_xyzw": kitti_raw.quaternions(_imu_rows(drive)[1][:1])[0].tolist(),
            "stddevs_rad": kitti_raw.ATTITUDE_STDDEVS_RAD.tolist(),
        },
    }


def _write_bag(
    drive: Path, log: SensorLog, out: Path, layout: Layout, progress: Callable[[int, int], None] | None
) -> None:
    """Messages in the order of their stamps, as a recorder writes them."""
    with BagWriter(out, is_ros1=layout == "rosbag1") as bag:
        calibration = log.calibration
        T_camera_lidar, K, size = kitti_raw.camera_from_lidar(kitti_raw.date_folder(drive))
        T_lidar_imu = kitti_raw.lidar_from_imu(kitti_raw.date_folder(drive))
        imu_ns, imu = _imu_rows(drive)
        fix_ns, fixes, accuracy = _fixes(drive)
        start_ns = int(min(imu_ns[0], fix_ns[0]))
        bag.write_transforms(start_ns, [("camera", "lidar", T_camera_lidar), ("lidar", "imu", T_lidar_imu)])
        attitudes = kitti_raw.quaternions(imu)
        events: list[tuple[int, Callable[[int], None]]] = []
        for k, ns in enumerate(imu_ns.tolist()):
            events.append((ns, _later(bag.write_imu, imu[k], attitudes[k])))
        for k, ns in enumerate(fix_ns.tolist()):
            events.append((ns, _later(bag.write_fix, fixes[k], float(accuracy[k]))))
        for scan in log.scans:
            events.append((_ns(log, scan.stamp), _later(_write_cloud, bag, scan)))
        for image in log.images:
            events.append((_ns(log, image.stamp), _later(bag.write_image, _file(image), K, size)))
        for written, (ns, write) in enumerate(sorted(events, key=lambda event: event[0]), 1):
            write(ns)
            if progress is not None:
                progress(written, len(events))
    rig = {
        "imu": {
            "topic": "/imu", "noise": None if log.imu_noise is None else log.imu_noise.model_dump(), "attitude": True,
        },
        "gnss": {"topic": "/fix"},
        "lidars": {"lidar": {"topic": "/points"}},
        "cameras": {
            "camera": {
                "topic": "/camera/image_rect_color/compressed", "info": "/camera/camera_info",
                "time_offset_s": calibration.camera().time_offset_s,
            }
        },
    }  # fmt: skip
    (out / RIG).write_text(json.dumps(rig, indent=1) + "\n")


def _write_cloud(ns: int, bag: BagWriter, scan: Scan) -> None:
    bag.write_cloud(ns, _cloud(scan))  # read when it is its turn


def _later(write: Callable[..., None], *values: Any) -> Callable[[int], None]:
    return lambda ns: write(ns, *values)


def _ns(log: SensorLog, stamp: float) -> int:
    return log.epoch_ns + round(stamp * 1e9)


def _imu_rows(drive: Path) -> tuple[NDArray[np.int64], Array]:
    """Unix ns and oxts rows, at 100 Hz where the drive has its twin."""
    twin = drive.with_name(drive.name.replace("_sync", "_extract"))
    stamps, rows, _ = kitti_raw.oxts_rows(twin if twin.is_dir() else drive)
    return stamps, rows


def _fixes(drive: Path) -> tuple[NDArray[np.int64], Array, Array]:
    """Unix ns, latitude, longitude, height (n, 3), and accuracy (n,) m."""
    stamps, rows, _ = kitti_raw.oxts_rows(drive)
    return stamps, rows[:, [LAT, LON, ALT]], rows[:, kitti_raw.POSITION_ACCURACY]


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
