"""KITTI raw drives: `<date>/<date>_drive_<nnnn>_sync`, calibration in the date folder.

Facts that this reader stands on (measured on drives 0005 and 0009 of 2011_09_26): the sweep starts at the rear and
turns clockwise; raw scans are not motion-compensated; the stamp of a scan is its middle; the image is exposed 8.5 ms
before its stamp; oxts jitters against the scans, so nothing may be paired by index. Line k of a stamp file belongs
to frame k, and is blank when the frame is missing.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from factor_graphs.alignment import AttitudePrior
from factor_graphs.geodesy import LocalFrame
from factor_graphs.measurements import GnssFixes, ImuNoise, ImuSamples
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.errors import DataError
from gnss_sem_map.io import frames, kitti_calibration
from gnss_sem_map.sensor_log import Calibration, Image, Points, Scan, SensorLog, Skip

Array = NDArray[np.float64]
T = TypeVar("T", Scan, Image)

CAMERA_TIME_OFFSET_S = -0.0085
ATTITUDE_STDDEVS_RAD = np.array([0.005, 0.005, 0.01])
"""How far the unit's first roll, pitch and yaw are believed; a looser yaw lets a short track turn the whole map."""
OXTS_NOISE = ImuNoise(
    accelerometer_noise_density=5e-4,
    gyroscope_noise_density=6e-5,
    accelerometer_bias_walk=1e-5,
    gyroscope_bias_walk=1e-6,
    accelerometer_bias_stddev=0.02,
    gyroscope_bias_stddev=1e-4,
)
"""Of the RT3003, whose rates and forces are already corrected for bias by its own filter. Gyroscopes by its data sheet,
0.2 °/√h and stable to 2 °/h; accelerometers worse than by that, 0.005 m/s/√h, for it stands in a car that shakes."""
OXTS_COLUMNS = 30
LAT, LON, ALT, ROLL, PITCH, YAW = range(6)
SPECIFIC_FORCE = slice(11, 14)
"""ax ay az: in the body; af al au are levelled with the unit's own attitude and would leak it."""
ANGULAR_RATE = slice(17, 20)
POSITION_ACCURACY = 23


def read(drive: Path) -> SensorLog:
    """Open a KITTI raw drive; raises DataError when calibration, oxts or stamps are missing or malformed."""
    calibration = _calibration(drive.parent, has_images=(drive / "image_02").is_dir())
    oxts_ns, oxts, skips = _oxts(drive)
    epoch_ns = int(oxts_ns[0])
    frame = LocalFrame(*(float(v) for v in oxts[0, [LAT, LON, ALT]]))
    stamps = _seconds(oxts_ns, epoch_ns)
    accuracy = np.maximum(oxts[:, POSITION_ACCURACY], 0.01)
    gnss = GnssFixes(
        stamps, frame.to_map(*oxts[:, [LAT, LON, ALT]].T), np.repeat(accuracy[:, None], 3, axis=1)
    )
    reference = Trajectory(stamps, _reference_poses(gnss.positions, oxts))
    imu_stamps, imu_rows, imu_skips = _imu_rows(drive, epoch_ns, stamps, oxts)
    scans, scan_skips = _scans(drive, epoch_ns)
    images, image_skips = _images(drive, epoch_ns, calibration.image_size)
    return SensorLog(
        name=drive.name,
        epoch_ns=epoch_ns,
        calibration=calibration,
        scans=scans,
        images=images,
        frame=frame,
        imu=ImuSamples(imu_stamps, imu_rows[:, SPECIFIC_FORCE], imu_rows[:, ANGULAR_RATE]),
        gnss=gnss,
        imu_noise=OXTS_NOISE,
        initial_attitude=AttitudePrior(reference.T_map_imu[0, :3, :3], ATTITUDE_STDDEVS_RAD),
        reference=reference,
        skips=(*skips, *imu_skips, *scan_skips, *image_skips),
    )


def _calibration(date: Path, has_images: bool) -> Calibration:
    imu_to_velo = kitti_calibration.read_rows(date / "calib_imu_to_velo.txt", {"R": 9, "T": 3})
    T_lidar_imu = kitti_calibration.transform(imu_to_velo["R"], imu_to_velo["T"])
    T_imu_lidar = np.asarray(np.linalg.inv(T_lidar_imu), np.float64)
    if not has_images:
        return Calibration(T_imu_lidar)
    velo_to_cam = kitti_calibration.read_rows(date / "calib_velo_to_cam.txt", {"R": 9, "T": 3})
    cameras = kitti_calibration.read_rows(
        date / "calib_cam_to_cam.txt", {"R_rect_00": 9, "P_rect_02": 12, "S_rect_02": 2}
    )
    K, T_camera_camera0 = kitti_calibration.split_projection(cameras["P_rect_02"])
    T_camera0_rectified = kitti_calibration.transform(cameras["R_rect_00"], np.zeros(3))
    T_camera0_lidar = kitti_calibration.transform(velo_to_cam["R"], velo_to_cam["T"])
    width, height = (int(v) for v in cameras["S_rect_02"])
    return Calibration(
        T_imu_lidar=T_imu_lidar,
        T_camera_lidar=T_camera_camera0 @ T_camera0_rectified @ T_camera0_lidar,
        K=K,
        image_size=(width, height),
        camera_time_offset_s=CAMERA_TIME_OFFSET_S,
    )


def _stamps_ns(path: Path) -> dict[int, int]:
    """Unix nanoseconds by frame number; blank lines are frames that do not exist."""
    if not path.is_file():
        raise DataError(f"{path}: missing stamps; expected one line `date time` per frame")
    stamps = {}
    for number, line in enumerate(path.read_text("utf-8", errors="replace").splitlines()):
        if line.strip():
            try:
                stamps[number] = int(np.datetime64(line.strip().replace(" ", "T"), "ns").astype(np.int64))
            except ValueError:
                raise DataError(
                    f"{path}: line {number + 1}: found {line.strip()[:40]!r}, expected `yyyy-mm-dd hh:mm:ss.nnnnnnnnn`"
                ) from None
    return stamps


def _seconds(stamps_ns: NDArray[np.int64], epoch_ns: int) -> Array:
    return np.asarray((stamps_ns - epoch_ns) * 1e-9, np.float64)


def _oxts(drive: Path) -> tuple[NDArray[np.int64], Array, list[Skip]]:
    """Stamps and rows of the navigation unit, sorted, without repeats; and what was left out."""
    folder = drive / "oxts"
    files, stamps = frames.numbered(folder / "data", ".txt"), _stamps_ns(folder / "timestamps.txt")
    rows: dict[int, Array] = {}
    skips = _left_out("oxts", folder, ".txt", stamps, files)
    for number, path in files.items():
        try:
            row = np.array(path.read_text("utf-8").split(), np.float64)
        except (ValueError, UnicodeDecodeError):
            row = np.empty(0)
        if number not in stamps:
            skips.append(Skip("oxts", str(path), "no stamp for this frame"))
        elif row.shape != (OXTS_COLUMNS,) or not np.isfinite(row).all():
            skips.append(
                Skip("oxts", str(path), f"found {row.size} numbers, expected {OXTS_COLUMNS} finite ones")
            )
        elif stamps[number] in rows:
            skips.append(Skip("oxts", str(path), "repeated stamp"))
        else:
            rows[stamps[number]] = row
    if len(rows) < 3:
        raise DataError(
            f"{drive / 'oxts'}: found {len(rows)} usable rows of {len(files)}, expected at least 3"
        )
    order = sorted(rows)
    return np.array(order, np.int64), np.stack([rows[stamp] for stamp in order]), skips


def _imu_rows(drive: Path, epoch_ns: int, stamps: Array, oxts: Array) -> tuple[Array, Array, list[Skip]]:
    """The 100 Hz rows of the `_extract` twin when it lies beside the drive, else the 10 Hz rows of the drive."""
    twin = drive.with_name(drive.name.replace("_sync", "_extract"))
    if twin == drive or not (twin / "oxts" / "data").is_dir():
        return stamps, oxts, []
    twin_ns, rows, skips = _oxts(twin)
    return _seconds(twin_ns, epoch_ns), rows, skips


def _reference_poses(positions: Array, oxts: Array) -> Array:
    """What the unit itself says: T_map_imu (k, 4, 4). Yaw is 0 towards east, counter-clockwise."""
    from scipy.spatial.transform import Rotation

    T_map_imu = np.tile(np.eye(4), (len(oxts), 1, 1))
    T_map_imu[:, :3, :3] = Rotation.from_euler("ZYX", oxts[:, [YAW, PITCH, ROLL]]).as_matrix()
    T_map_imu[:, :3, 3] = positions
    return T_map_imu


def _scans(drive: Path, epoch_ns: int) -> tuple[tuple[Scan, ...], list[Skip]]:
    folder = drive / "velodyne_points"
    files = frames.numbered(folder / "data", ".bin")
    if not files:
        return (), _all_missing("scan", folder)
    middle, start, end = (_stamps_ns(folder / f"timestamps{part}.txt") for part in ("", "_start", "_end"))
    scans, skips = [], _left_out("scan", folder, ".bin", middle, files)
    for number, path in files.items():
        if number not in middle or number not in start or number not in end:
            skips.append(Skip("scan", str(path), "no stamp for this frame"))
        elif not start[number] < end[number]:
            skips.append(Skip("scan", str(path), "the sweep ends before it starts"))
        else:
            sweep = (start[number] - epoch_ns) * 1e-9, (end[number] - epoch_ns) * 1e-9
            stamp = (middle[number] - epoch_ns) * 1e-9
            scans.append(Scan(path.stem, number, stamp, partial(_read_sweep, path, *sweep), sweep))
    return _in_order(scans, skips)


def _read_sweep(path: Path, start: float, end: float) -> Points:
    """A sweep with the stamp of every point, from its azimuth: rear, left, front, right, rear."""
    rows = frames.read_points(path)
    azimuths = np.arctan2(rows[:, 1], rows[:, 0], dtype=np.float64)
    stamps = azimuths * ((start - end) / (2 * np.pi))
    stamps += (start + end) / 2
    return Points(rows[:, :3], rows[:, 3], stamps)


def _images(drive: Path, epoch_ns: int, size: tuple[int, int] | None) -> tuple[tuple[Image, ...], list[Skip]]:
    folder = drive / "image_02"
    files = frames.numbered(folder / "data", ".png")
    if not files:
        return (), _all_missing("image", folder)
    stamps = _stamps_ns(folder / "timestamps.txt")
    images, skips = [], _left_out("image", folder, ".png", stamps, files)
    for number, path in files.items():
        if number in stamps:
            stamp = (stamps[number] - epoch_ns) * 1e-9
            images.append(Image(number, stamp, partial(frames.read_image, path, size)))
        else:
            skips.append(Skip("image", str(path), "no stamp for this frame"))
    return _in_order(images, skips)


def _left_out(
    what: str, folder: Path, suffix: str, stamps: dict[int, int], files: dict[int, Path]
) -> list[Skip]:
    """Frames with a stamp and no file, and files of a frame that has another one."""
    return [
        *frames.missing(what, folder, stamps, files),
        *frames.repeated(folder / "data", suffix, what, files),
    ]


def _all_missing(what: str, folder: Path) -> list[Skip]:
    """The frames of a sensor that has no file at all, if it has stamps."""
    stamps = folder / "timestamps.txt"
    return frames.missing(what, folder, _stamps_ns(stamps), {}) if stamps.is_file() else []


def _in_order(items: list[T], skips: list[Skip]) -> tuple[tuple[T, ...], list[Skip]]:
    """Sorted by stamp; of two with the same stamp the first stays."""
    kept: list[T] = []
    for item in sorted(items, key=lambda item: (item.stamp, item.number)):
        if kept and item.stamp == kept[-1].stamp:
            skips.append(Skip(type(item).__name__.lower(), f"frame {item.number}", "repeated stamp"))
        else:
            kept.append(item)
    return tuple(kept), skips
