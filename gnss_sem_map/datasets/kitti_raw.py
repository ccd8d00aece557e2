"""KITTI raw drives: `<date>/<date>_drive_<nnnn>_sync` or `_extract`, calibration in the date folder.

Of an `_extract` drive, scans are text, images are not rectified, and oxts has 100 Hz. One camera is used: the first of
`CAMERAS` that has images.

Facts that this reader relies on (measured on drives 0005 and 0009 of 2011_09_26): the sweep starts at the rear and
turns clockwise; raw scans are not motion-compensated; the stamp of a scan is its middle; the image is exposed 8.5 ms
before its stamp.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.datasets import frames, kitti_calibration
from gnss_sem_map.datasets.kitti_calibration import CalibrationFile, stamps_ns
from gnss_sem_map.datasets.kitti_oxts import OXTS_NOISE, navigation
from gnss_sem_map.datasets.stamps import in_order, sweep_fault
from gnss_sem_map.errors import DataError
from gnss_sem_map.files.pictures import read_picture
from gnss_sem_map.files.untrusted import is_file, is_folder, shown
from gnss_sem_map.sensor_log import Calibration, Image, Points, Scan, SensorLog, Skip
from gnss_sem_map.sensor_log.cameras import Camera, Distortion

Array = NDArray[np.float64]

CAMERAS = ("02", "03", "00", "01")
"""Colour left and right, grey left and right."""
CAMERA_TIME_OFFSET_S = -0.0085

FORMAT, SIGNS = "kitti-raw", "oxts/ (KITTI raw)"
IMU_TO_LIDAR, R_AND_T = "calib_imu_to_velo.txt", {"R": 9, "T": 3}


def is_drive(drive: Path) -> bool:
    """Whether a folder looks like a KITTI raw drive."""
    return is_folder(drive / "oxts")


def read(drive: Path, with_imu: bool = True) -> SensorLog:
    """Open a KITTI raw drive; raises DataError when calibration, oxts or stamps are missing or malformed.

    Without `with_imu`, the thousands of files of its `_extract` twin are not read.
    """
    camera = _camera(drive)
    calibration = _calibration(date_folder(drive), drive, camera)
    unit = navigation(drive, _twins(drive), with_imu)
    epoch_ns = unit.epoch_ns
    scans, scan_skips = _scans(drive, epoch_ns)
    of_scans = {scan.number: epoch_ns + round(scan.stamp * 1e9) for scan in scans}
    images, image_skips = _images(
        drive / f"image_{camera}", epoch_ns, calibration.image_sizes.get(""), of_scans
    )
    return SensorLog(
        name=shown(drive.name or drive.resolve().name),
        epoch_ns=epoch_ns,
        calibration=calibration,
        scans=scans,
        images=images,
        frame=unit.frame,
        imu=unit.imu,
        gnss=unit.gnss,
        imu_noise=OXTS_NOISE,
        initial_attitude=unit.attitude,
        reference=unit.reference,
        skips=(*unit.skips, *scan_skips, *image_skips),
    )


def date_folder(drive: Path) -> Path:
    """The folder with the calibration: beside the drive, or, if `drive` is a link or `.`, beside its target.

    Else in the drive, or above it, as it may be unpacked.
    """
    whole = drive.resolve()
    date = whole.name[:10]
    places = [drive.parent, whole.parent, drive, whole.parent.parent]
    places += [place / f"{date}_calib" / date for place in (whole.parent, whole.parent.parent)]
    return next((place for place in places if is_file(place / IMU_TO_LIDAR)), whole.parent)


def _camera(drive: Path) -> str:
    """Number of the camera that is used: the first with images, else the first that has a folder, or empty."""
    there = [camera for camera in CAMERAS if is_folder(drive / f"image_{camera}")]
    seen = (camera for camera in there if _image_files(drive / f"image_{camera}").files)
    return next(seen, there[0] if there else "")


def _image_files(folder: Path) -> frames.Frames:
    return frames.numbered("image", folder / "data", *frames.IMAGE_SUFFIXES)


def _calibration(date: Path, drive: Path, camera: str) -> Calibration:
    T_lidar_imu = kitti_calibration.exact(lidar_from_imu(date))
    T_imu_lidar = np.asarray(np.linalg.inv(T_lidar_imu), np.float64)
    if not camera:
        return Calibration(T_imu_lidar)
    size = frames.first_size(_image_files(drive / f"image_{camera}").files.values())
    return Calibration(T_imu_lidar, (camera_from_lidar(date, camera, size),))


def camera_from_lidar(date: Path, camera: str = "02", seen: tuple[int, int] | None = None) -> Camera:
    """A camera by the calibration of a date: rectified, unless images of a size `seen` are those of its sensor."""
    of_cameras, size_name, P = date / "calib_cam_to_cam.txt", f"S_rect_{camera}", f"P_rect_{camera}"
    T_camera0_lidar = CalibrationFile(date / "calib_velo_to_cam.txt", R_AND_T).pose(*R_AND_T)
    about = CalibrationFile(of_cameras, {"R_rect_00": 9, P: 12, size_name: 2})
    size = about.size(size_name)
    if seen is not None and seen != size:
        raw = _sensor(of_cameras, camera, T_camera0_lidar)
        if raw.image_size == seen:
            return raw
    K, T_camera_camera0 = about.projection(P)
    T = kitti_calibration.exact(T_camera_camera0 @ about.pose("R_rect_00") @ T_camera0_lidar)
    return Camera(T, K, size, CAMERA_TIME_OFFSET_S)


def _sensor(of_cameras: Path, camera: str, T_camera0_lidar: Array) -> Camera:
    """A camera whose images are not rectified."""
    S, K, D, R, T = (f"{name}_{camera}" for name in "SKDRT")
    try:
        about = CalibrationFile(of_cameras, {S: 2, K: 9, D: 5, R: 9, T: 3})
    except DataError as error:
        raise DataError(f"{error}; its images are not rectified, of the size S_rect_{camera}") from None
    lens = Distortion(model="brown", coefficients=tuple(about.rows[D].tolist()))
    T_camera_lidar = kitti_calibration.exact(about.pose(R, T) @ T_camera0_lidar)
    return Camera(T_camera_lidar, about.rows[K].reshape(3, 3), about.size(S), CAMERA_TIME_OFFSET_S, lens)


def lidar_from_imu(date: Path) -> Array:
    """T_lidar_imu (4, 4), as the calibration of a date has it."""
    return CalibrationFile(date / IMU_TO_LIDAR, R_AND_T).pose(*R_AND_T)


def _twins(drive: Path) -> tuple[Path, ...]:
    """Where the `_extract` twin of a drive may be: beside it, or beside its target if it is a link."""
    places = [place for place in (drive, drive.resolve()) if "_sync" in place.name]
    return tuple(place.parent / place.name.replace("_sync", "_extract") for place in places)


def _scans(drive: Path, epoch_ns: int) -> tuple[tuple[Scan, ...], list[Skip]]:
    folder = drive / "velodyne_points"
    found = frames.numbered("scan", folder / "data", *frames.SCAN_SUFFIXES)
    if not found.files:
        return (), _all_missing(found)
    middle, skips = stamps_ns(folder / "timestamps.txt")
    start, in_start = _ends_of_sweeps(folder / "timestamps_start.txt", middle, -0.5)
    end, in_end = _ends_of_sweeps(folder / "timestamps_end.txt", middle, 0.5)
    of_files, lost = found.joined(
        {n: (t, start[n], end[n]) for n, t in middle.items() if n in start and n in end}
    )
    skips += in_start + in_end + lost
    scans = []
    for number, path, moments in of_files:
        stamp, *sweep = ((t - epoch_ns) * 1e-9 for t in moments)
        if fault := sweep_fault(stamp, *sweep):
            skips.append(Skip("scan", shown(path), fault))
        else:
            scans.append(scan_of(path, number, stamp, sweep[0], sweep[1]))
    return in_order("scan", scans, skips), skips


def scan_of(path: Path, number: int, stamp: float, start: float, end: float) -> Scan:
    """A scan that is read when it is needed, see `read_sweep`."""
    read = partial(read_sweep, path, stamp, start, end, frames.state_of(path))
    return Scan(path.stem, number, stamp, read, (start, end))


def _ends_of_sweeps(path: Path, middle: dict[int, int], share: float) -> tuple[dict[int, int], list[Skip]]:
    """Starts or ends of sweeps, ns; without a file, so much of the usual step from their middle."""
    if is_file(path) or len(middle) < 2:
        return stamps_ns(path)
    shift = round(share * float(np.median(np.diff(sorted(middle.values())))))
    told = f"missing: {len(middle)} sweeps are taken to fill the time between their stamps"
    return {number: stamp + shift for number, stamp in middle.items()}, [
        Skip("stamps", shown(path), told, len(middle))
    ]


def read_sweep(path: Path, stamp: float, start: float, end: float, state: frames.State | None) -> Points:
    """A scan whose points are measured from `start` to `end`, s, see `seconds_after`."""
    rows = frames.read_points(path, state=state)
    stamps = seconds_after(rows, stamp, start, end).astype(np.float64)
    stamps += stamp
    return Points(rows[:, :3], rows[:, 3], stamps)


def seconds_after(rows: NDArray[np.float32], stamp: float, start: float, end: float) -> NDArray[np.float32]:
    """When the points (n, 4) were measured, s after its stamp, by their azimuth: rear, left, front, right, rear.

    As float32, to 4 ns: the same as in the fields of other formats.
    """
    from gnss_sem_map.scans.angles import azimuths_deg  # compiled: only those who read scans need it

    after = azimuths_deg(rows)
    after *= (start - end) / 360
    after += (start + end) / 2 - stamp
    return after.astype(np.float32)


def _images(
    folder: Path, epoch_ns: int, size: tuple[int, int] | None, of_scans: dict[int, int]
) -> tuple[tuple[Image, ...], list[Skip]]:
    found = _image_files(folder)
    if not found.files:
        return (), _all_missing(found)
    return stamped_images(found, epoch_ns, size, of_scans=of_scans or None)


def stamped_images(
    found: frames.Frames,
    epoch_ns: int,
    size: tuple[int, int] | None,
    camera: str = "",
    of_scans: dict[int, int] | None = None,
) -> tuple[tuple[Image, ...], list[Skip]]:
    """The images of a camera whose files were found and whose stamps are in its folder, and the skipped frames.

    Without stamps of their own, they have those `of_scans` of their numbers, which triggered them.
    """
    file, count = found.folder.parent / "timestamps.txt", len(found.files)
    if of_scans is not None and count and not is_file(file):
        stamps = {n: of_scans[n] for n in found.files if n in of_scans}
        told = f"missing: {count} images have the stamps of the scans of their numbers"
        skips = [Skip("stamps", shown(file), told, count)]
    else:
        stamps, skips = stamps_ns(file)
    of_files, lost = found.joined(stamps)
    skips += lost
    images = [
        Image(n, (ns - epoch_ns) * 1e-9, partial(read_picture, path, size), camera)
        for n, path, ns in of_files
    ]
    return in_order("image", images, skips), skips


def _all_missing(found: frames.Frames) -> list[Skip]:
    """The frames of a sensor that has no file at all, if it has stamps."""
    path = found.folder.parent / "timestamps.txt"
    return found.skips + (found.missing(stamps_ns(path)[0]) if is_file(path) else [])
