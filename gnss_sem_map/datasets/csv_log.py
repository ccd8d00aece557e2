"""CSV logs: a user's own drive as tables, with optional scans and images beside them.

    imu.csv             stamp_s,ax,ay,az,wx,wy,wz      specific force m/s², rad/s; x forward, y left, z up;
                                                       or by `imu_axes`, `force_unit`, `rate_unit` in log.yaml
    gnss.csv            stamp_s,lat_deg,lon_deg,alt_m,std_e_m,std_n_m,std_u_m      position of the antenna; optional:
                                                       corr_en,corr_eu,corr_nu of its errors, and its velocity
                                                       ve_mps,vn_mps,vu_mps,std_ve_mps,std_vn_mps,std_vu_mps,
                                                       and heading_deg,std_heading_deg between two antennas
    wheels.csv          stamp_s,speed_mps              optional: below zero in reverse, if the sensor tells; m/s,
                                                       or by `speed_unit` in log.yaml
    control_points.csv  optional: surveyed points, see `factor_graphs.csv_log.read_points`
    log.yaml            optional: see `log_yaml.LogFile`
    lidar/stamps.csv    number,stamp_s             lidar/<number>.bin     float32 rows x y z intensity [time - stamp],
                                                       or text in <number>.txt;
                                                       intensity from 0 to 1, or to `intensity_max` in log.yaml
    images/stamps.csv   number,stamp_s             images/<number>.png    or .jpg

Of several LiDARs or cameras, each has a folder of its name in lidar/ or images/.

Stamps are seconds on one clock. With a trajectory in a file of its own, lidar/ is enough.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from factor_graphs.csv_log import (
    GNSS_COLUMNS,
    IMU_COLUMNS,
    LONGEST_FIX_STEP_S,
    LONGEST_IMU_STEP_S,
    LONGEST_WHEEL_STEP_S,
    WHEEL_COLUMNS,
    fix_rows,
    parse_columns,
    parse_numbers,
    parse_points,
)
from factor_graphs.errors import MeasurementError
from factor_graphs.geodesy import LocalFrame
from factor_graphs.measurements import ImuSamples, WheelSpeeds, clean_imu, clean_wheels
from factor_graphs.receiver_rows import MORE_COLUMNS
from factor_graphs.surveyed_points import SurveyedPoints
from factor_graphs.tables import layout_of
from gnss_sem_map.datasets import frames
from gnss_sem_map.datasets.gnss_files import GnssFile, read_gnss_file
from gnss_sem_map.datasets.gnss_files.positions import Receiver, measured
from gnss_sem_map.datasets.log_yaml import LidarFile, LogFile, calibration_of, read_log_yaml
from gnss_sem_map.datasets.stamps import (
    LONGEST_FRAME_STEP_S,
    check_date,
    check_unit,
    in_order,
    leave_out_of_sweep,
)
from gnss_sem_map.errors import DataError, errors_of_measurements
from gnss_sem_map.files.pictures import read_picture
from gnss_sem_map.files.untrusted import expect_file, inside, is_file, is_folder, read_bytes, refused, shown
from gnss_sem_map.sensor_log import (
    POSE_OF_LIDAR,
    SENSOR,
    Image,
    Lidar,
    Points,
    Scan,
    SensorLog,
    Skip,
    repaired,
    skipped,
)
from gnss_sem_map.sensor_log.cameras import Camera
from gnss_sem_map.sensor_log.conventions import SensorConventions

Array = NDArray[np.float64]
MOST_TABLE_BYTES = 1 << 30
MOST_DIGITS = 19
SIDES = tuple("NSEWnsew")
"""Letters of the hemispheres, behind a latitude or longitude or in a column of their own."""
MOST_NEGATIVE = 0.1
"""Largest share of intensities below zero; of coordinates that are taken for them it is larger."""
STAMPS = "stamps.csv"
HOW_TO_WRITE = {
    "scan": "; numpy.column_stack([x, y, z, intensity, time]).astype('<f4').tofile(NAME) writes one",
    "image": ", or .jpg: convert them",
}
UNIT_KEYS = {"ax": "force_unit", "wx": "rate_unit", "speed_mps": "speed_unit"}
FORMAT, SIGNS = "table", "imu.csv and gnss.csv, or lidar/stamps.csv (CSV log)"


def is_drive(drive: Path) -> bool:
    """Whether a folder looks like a CSV log."""
    return any(is_file(drive / name) for name in ("imu.csv", "gnss.csv", f"lidar/{STAMPS}"))


def read(drive: Path, with_imu: bool = True) -> SensorLog:
    """Open a CSV log; raises DataError when a table is malformed or empty, and skips those that are missing."""
    about = read_log_yaml(drive / "log.yaml")
    imu, imu_skips = _imu(drive / "imu.csv", about)
    receiver, fix_skips = _receiver(drive, about, None if imu is None else imu.stamps)
    wheels, wheel_skips = _wheels(drive / "wheels.csv", about)
    frame = receiver.frame
    points = None if frame is None else _points(drive / "control_points.csv", frame)
    lidars, scan_skips = _lidars(drive, about)
    calibration = calibration_of(about, drive / "log.yaml")
    images, image_skips = _images(drive / "images", about, calibration.cameras)
    return SensorLog(
        name=shown(drive.name),
        epoch_ns=about.epoch_ns,
        calibration=calibration,
        scans=lidars[0].scans,
        lidar=lidars[0].name,
        others=lidars[1:],
        images=images,
        frame=frame,
        imu=imu,
        gnss=receiver.gnss,
        velocities=receiver.velocities,
        headings=receiver.headings,
        points=points,
        wheels=wheels,
        imu_noise=about.imu_noise,
        imu_sample_instant=about.imu_sample_instant,
        initial_attitude=None if about.initial_attitude is None else about.initial_attitude.prior,
        conventions=about.conventions,
        skips=(*imu_skips, *fix_skips, *wheel_skips, *scan_skips, *image_skips),
    )


def read_imu(drive: Path) -> tuple[ImuSamples, SensorConventions]:
    """The samples of imu.csv and their conventions; nothing else need be there. Raises DataError."""
    about = read_log_yaml(drive / "log.yaml")
    imu, skips = _imu(drive / "imu.csv", about)
    if imu is None:
        raise DataError(f"{skips[0].where}: {skips[0].reason}")
    return imu, about.conventions


def _imu(path: Path, about: LogFile) -> tuple[ImuSamples | None, list[Skip]]:
    if not is_file(path):
        return None, [_missing(path, IMU_COLUMNS)]
    with errors_of_measurements():
        rows, skips = _numbers(path, IMU_COLUMNS, LONGEST_IMU_STEP_S, about)
        imu, repairs = clean_imu(rows[:, 0], rows[:, 1:4], rows[:, 4:7])
    check_date(float(imu.stamps[-1]), about.epoch_ns, shown(path))
    return imu, skips + repaired(path, repairs)


def _receiver(drive: Path, about: LogFile, imu_stamps: Array | None) -> tuple[Receiver, list[Skip]]:
    path = drive / "gnss.csv"
    if about.gnss_file is None and not is_file(path):
        return Receiver(), [_missing(path, GNSS_COLUMNS)]
    with errors_of_measurements():
        rows, skips = _fix_rows(drive, about, imu_stamps)
        found, lost = measured(rows, shown(path), about.baseline)
    return found, [*lost, *skips]


def _missing(path: Path, columns: tuple[str, ...]) -> Skip:
    return Skip(SENSOR, shown(path), f"missing; expected a table with columns {','.join(columns)}")


def _fix_rows(drive: Path, about: LogFile, imu_stamps: Array | None) -> tuple[Array, list[Skip]]:
    """The rows of the receiver that are valid fixes, in file order, and the skipped rows."""
    path, file = drive / "gnss.csv", about.gnss_file
    if file is not None and is_file(path) and file.path != path.name:
        raise refused(path, "there is a gnss_file in log.yaml as well; remove one of the two")
    if file is None and not _is_of_our_columns(path):
        file = GnssFile(path=path.name)
    if file is None:
        given, skips = _numbers(path, GNSS_COLUMNS, LONGEST_FIX_STEP_S, about, MORE_COLUMNS)
    else:
        path, span_ns = drive / file.path, None
        if imu_stamps is not None:
            first, last = about.epoch_ns + np.round(imu_stamps[[0, -1]] * 1e9).astype(np.int64)
            span_ns = int(first), int(last)
        try:
            found = read_gnss_file(file, drive, about.epoch_ns, span_ns)
        except DataError as error:
            keys = f"; such keys are of `gnss_file: {{path: {path.name}}}` in log.yaml"
            raise DataError(f"{error}{'' if about.gnss_file else keys}") from None
        given, skips = found.rows, found.skips
    rows, invalid = fix_rows(given, shown(path))
    return rows, skips + skipped("fix", path, "rows", invalid)


def _is_of_our_columns(path: Path) -> bool:
    """Whether a table has all columns of gnss.csv, as numbers; another is read as other programs write positions."""
    try:
        layout = layout_of(_content(path, GNSS_COLUMNS), GNSS_COLUMNS, MORE_COLUMNS)
        found = [layout.column(name) for name in GNSS_COLUMNS]
    except (DataError, MeasurementError):
        return True  # told by the usual reader
    angles = [one.at for one in found[1:3] if one is not None]
    has_sides = any(layout.first(at)[-1:] in SIDES or layout.first(at + 1) in SIDES for at in angles)
    return not any(found) or (None not in found and not has_sides)


def _wheels(path: Path, about: LogFile) -> tuple[WheelSpeeds | None, list[Skip]]:
    """Wheel speeds and the skipped rows; None where there is no such table."""
    if not is_file(path):
        return None, []
    with errors_of_measurements():
        rows, skips = _numbers(path, WHEEL_COLUMNS, LONGEST_WHEEL_STEP_S, about)
        wheels, repairs = clean_wheels(rows[:, 0], rows[:, 1])
    return wheels, skips + repaired(path, repairs)


def _points(path: Path, frame: LocalFrame) -> SurveyedPoints | None:
    """Surveyed points; None where there is no such table."""
    if not is_file(path):
        return None
    with errors_of_measurements():
        return parse_points(read_bytes(path, MOST_TABLE_BYTES), frame, shown(path))


def _numbers(
    path: Path, columns: tuple[str, ...], longest_step_s: float, about: LogFile, more: tuple[str, ...] = ()
) -> tuple[Array, list[Skip]]:
    """The named columns of a CSV file, (n, c) as `parse_numbers` has them, and what is to be told of its stamps."""
    content, told, where = _content(path, columns), list[str](), shown(path)
    for name in (name for name in UNIT_KEYS if name in columns):
        with errors_of_measurements(f"{where}: "):
            column = layout_of(content, columns).column(name)
        if column is not None and column.scale != 1.0 and getattr(about, UNIT_KEYS[name]) is not None:
            key = UNIT_KEYS[name]
            raise refused(where, f"the unit of {name} is in its header, and {key} in log.yaml; remove {key}")
    rows = parse_numbers(content, columns, where, longest_step_s, more, about.epoch_ns, told)
    return rows, [Skip("unit", where, text, len(rows)) for text in told]


def _content(path: Path, columns: tuple[str, ...]) -> bytes:
    expect_file(path, f"a table with columns {','.join(columns)}")
    return read_bytes(path, MOST_TABLE_BYTES)


def _stamps(path: Path, what: str, epoch_ns: int) -> tuple[dict[int, float], list[Skip]]:
    """Stamp of every frame, the first one if there are several; and the skipped lines.

    A number may have 19 digits: it is never a floating number.
    """
    columns, told = {"number": "string", "stamp_s": "float64"}, list[str]()
    with errors_of_measurements():
        table = parse_columns(
            _content(path, tuple(columns)), columns, shown(path), epoch_ns, (), LONGEST_FRAME_STEP_S, told
        )
    texts, seconds = table["number"].to_pylist(), table["stamp_s"].to_numpy().astype(np.float64)
    check_unit(seconds, LONGEST_FRAME_STEP_S, shown(path))
    skips = [Skip("unit", shown(path), text, len(texts)) for text in told]
    stamps: dict[int, float] = {}
    for line, (text, stamp) in enumerate(zip(texts, seconds.tolist(), strict=True), 2):
        number = _whole(text or "")
        if number is None or not np.isfinite(stamp):
            skips.append(Skip(what, f"{shown(path)}: line {line}", "no number, or no stamp"))
        elif number in stamps:
            skips.append(Skip(what, f"{shown(path)}: line {line}", f"frame {number} has a stamp already"))
        else:
            stamps[number] = stamp
    if not stamps:
        raise refused(path, f"found no whole number with a stamp among {len(texts)} rows")
    return stamps, skips


def _whole(text: str) -> int | None:
    """A frame number, written `7`, `0007` or `7.0`; None for anything else."""
    whole = text.strip()
    head, point, tail = whole.partition(".")
    if point and not tail.strip("0"):
        whole = head
    return int(whole) if whole.isdecimal() and len(whole) <= MOST_DIGITS else None


def _stamped(
    what: str, folder: Path, epoch_ns: int, *suffixes: str
) -> tuple[list[tuple[int, Path, float]], list[Skip]]:
    """Number, file and stamp of every frame that has a stamp and a file; and the skipped frames."""
    found = frames.numbered(what, folder, *suffixes)
    others = [path for path in (inside(folder) if is_folder(folder) else []) if path.name != STAMPS]
    if not found.files and others:
        endings = sorted({path.suffix for path in others} - {*suffixes})[:5]
        name = f"{what}s are named by their numbers, such as 0000000007{suffixes[0]}"
        told, way = (f" ({', '.join(endings)})", HOW_TO_WRITE[what]) if endings else ("", "")
        reason = f"found {len(others)} others{told}; {name}{way}"
        found.skips.append(Skip(what, shown(folder), reason, len(others)))
    if not found.files and not is_file(folder / STAMPS):
        return [], found.skips
    stamps, skips = _stamps(folder / STAMPS, what, epoch_ns)
    joined, lost = found.joined(stamps)
    return joined, skips + lost


def _lidars(drive: Path, about: LogFile) -> tuple[tuple[Lidar, ...], list[Skip]]:
    """All LiDARs; the only one has no name."""
    found: list[Lidar] = []
    skips: list[Skip] = []
    for name, one in about.all_lidars:
        scans, lost = _scans(drive / "lidar" / name, one, about.epoch_ns)
        called = name if len(about.all_lidars) > 1 else ""
        found.append(Lidar(called, np.array(one.T_imu_lidar, np.float64), scans))
        skips += lost
    if found[0].scans and not about.lidars and about.T_imu_lidar is None:
        reason = "not given: taken as that of the IMU; give T_imu_lidar in log.yaml"
        skips.append(Skip(POSE_OF_LIDAR, shown(drive / "log.yaml"), reason))
    return tuple(found), skips


def _scans(folder: Path, about: LidarFile, epoch_ns: int) -> tuple[tuple[Scan, ...], list[Skip]]:
    found, skips = _stamped("scan", folder, epoch_ns, *frames.SCAN_SUFFIXES)
    scans = [
        Scan(path.stem, n, t, partial(_read_scan, path, t, about, frames.state_of(path)))
        for n, path, t in found
    ]
    return in_order("scan", scans, skips), skips


def _read_scan(path: Path, stamp: float, about: LidarFile, state: frames.State | None) -> Points:
    rows = frames.read_points(path, 4 if about.is_compensated else 5, state)
    _check_columns(rows, shown(path))
    frames.scale_intensity(rows, about.intensity_max)
    if about.is_compensated:
        return Points(rows[:, :3], rows[:, 3], None)
    with np.errstate(invalid="ignore"):  # of signalling NaN
        after = rows[:, 4].astype(np.float64)
    leave_out_of_sweep(rows, after, shown(path))
    return Points(rows[:, :3], rows[:, 3], stamp + after)


def _check_columns(rows: NDArray[np.float32], where: str) -> None:
    """Raise DataError for numbers in rows of another length: coordinates fall into the column of intensities."""
    negative = float((rows[:, 3] < 0).mean())
    if negative > MOST_NEGATIVE:
        raise refused(
            where,
            f"{negative:.0%} of the intensities are below zero: are these rows of another count of columns?"
            f" expected {rows.shape[1]}, x y z intensity{'' if rows.shape[1] == 4 else ' time'}; lidar_is_compensated"
            " in log.yaml (is_compensated in lidars) says whether there are times",
        )


def _images(
    folder: Path, about: LogFile, cameras: tuple[Camera, ...]
) -> tuple[tuple[Image, ...], list[Skip]]:
    """The images of all cameras; several have a folder each."""
    places = (
        [(folder / name, camera) for name, camera in zip(about.cameras, cameras, strict=True)]
        if about.cameras
        else [(folder, cameras[0] if cameras else None)]
    )
    images: list[Image] = []
    skips: list[Skip] = []
    for place, camera in places:
        size, name = (None, "") if camera is None else (camera.image_size, camera.name)
        found, lost = _stamped("image", place, about.epoch_ns, *frames.IMAGE_SUFFIXES)
        of_camera = [Image(n, t, partial(read_picture, path, size), name) for n, path, t in found]
        images += in_order("image", of_camera, lost)
        skips += lost
        if camera is None and found:
            n = len(found)
            skips.append(Skip("image", shown(place), f"no camera in log.yaml: {n} images not used", n))
    return tuple(sorted(images, key=lambda image: image.stamp)), skips
