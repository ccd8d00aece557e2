"""Table logs: a user's own drive as plain tables, with scans and images beside them where there are any.

    imu.csv             stamp_s,ax,ay,az,wx,wy,wz      specific force m/s², rad/s; x forward, y left, z up;
                                                       or as `imu_axes`, `force_unit`, `rate_unit` of log.yaml say
    gnss.csv            stamp_s,lat_deg,lon_deg,alt_m,std_e_m,std_n_m,std_u_m      position of the antenna
    log.yaml            optional: see `LogFile`
    lidar/stamps.csv    number,stamp_s             lidar/<number>.bin     float32 rows x y z intensity [time - stamp]
    images/stamps.csv   number,stamp_s             images/<number>.png    rectified

Stamps are seconds on one clock.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, ValidationError

from factor_graphs.geodesy import LocalFrame
from factor_graphs.measurements import ImuNoise, clean_gnss, clean_imu
from gnss_sem_map.conventions import SensorConventions
from gnss_sem_map.errors import DataError
from gnss_sem_map.io import frames
from gnss_sem_map.sensor_log import Calibration, Image, Points, Scan, SensorLog, Skip

Array = NDArray[np.float64]
Matrix4 = tuple[
    tuple[float, float, float, float],
    tuple[float, float, float, float],
    tuple[float, float, float, float],
    tuple[float, float, float, float],
]
IDENTITY: Matrix4 = ((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1))

IMU_COLUMNS = ("stamp_s", "ax", "ay", "az", "wx", "wy", "wz")
GNSS_COLUMNS = ("stamp_s", "lat_deg", "lon_deg", "alt_m", "std_e_m", "std_n_m", "std_u_m")


class LogFile(SensorConventions):
    """What `log.yaml` may say about the drive; its axes, units and clocks are those of `SensorConventions`."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    epoch_ns: int = Field(0, description="Unix time, ns, of stamp zero.")
    p_imu_antenna: tuple[float, float, float] = Field(
        (0, 0, 0), description="GNSS antenna in the imu frame, m."
    )
    T_imu_lidar: Matrix4 = Field(IDENTITY, description="LiDAR to IMU.")
    T_camera_lidar: Matrix4 | None = Field(None, description="LiDAR to rectified camera.")
    K: tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]] | None = (
        Field(None, description="Intrinsics of the rectified camera, px.")
    )
    image_size: tuple[int, int] | None = Field(None, description="Width and height of the images, px.")
    camera_time_offset_s: float = Field(0.0, description="Moment of exposure minus image stamp.")
    imu_noise: ImuNoise | None = Field(
        None, description="Noise of the IMU; a good consumer unit when absent."
    )
    lidar_is_compensated: bool = Field(
        False, description="Scans of four columns are already motion-compensated to their stamp."
    )


def read(drive: Path) -> SensorLog:
    """Open a table log; raises DataError when a table is missing, malformed or empty."""
    about = _about(drive / "log.yaml")
    imu_rows, gnss_rows = _table(drive / "imu.csv", IMU_COLUMNS), _table(drive / "gnss.csv", GNSS_COLUMNS)
    frame = _origin(gnss_rows, drive / "gnss.csv")
    gnss_rows[(gnss_rows[:, 1:3] == 0).all(axis=1)] = np.nan  # what receivers write when they have no fix
    positions = frame.to_map(*gnss_rows[:, 1:4].T)
    imu, imu_repairs = clean_imu(imu_rows[:, 0], imu_rows[:, 1:4], imu_rows[:, 4:7])
    gnss, gnss_repairs = clean_gnss(gnss_rows[:, 0], positions, gnss_rows[:, 4:7])
    skips = [
        Skip("samples", str(drive / name), str(repairs))
        for name, repairs in (("imu.csv", imu_repairs), ("gnss.csv", gnss_repairs))
        if repairs.dropped
    ]
    scans, scan_skips = _scans(drive / "lidar", about.lidar_is_compensated)
    images, image_skips = _images(drive / "images", about.image_size)
    return SensorLog(
        name=drive.name,
        epoch_ns=about.epoch_ns,
        calibration=_calibration(about, drive / "log.yaml"),
        scans=scans,
        images=images,
        frame=frame,
        imu=imu,
        gnss=gnss,
        imu_noise=about.imu_noise,
        conventions=SensorConventions(**about.model_dump(include=set(SensorConventions.model_fields))),
        skips=(*skips, *scan_skips, *image_skips),
    )


def _about(path: Path) -> LogFile:
    if not path.is_file():
        return LogFile()
    try:
        return LogFile.model_validate(yaml.safe_load(path.read_text("utf-8")) or {})
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        raise DataError(
            f"{path}: {place}: {first['msg']}; known keys are {sorted(LogFile.model_fields)}"
        ) from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: not YAML ({str(error).splitlines()[0]})") from None


def _calibration(about: LogFile, path: Path) -> Calibration:
    camera = (about.T_camera_lidar, about.K, about.image_size)
    if any(part is None for part in camera) and any(part is not None for part in camera):
        raise DataError(
            f"{path}: a camera needs all of T_camera_lidar, K and image_size; found only some of them"
        )
    return Calibration(
        T_imu_lidar=np.array(about.T_imu_lidar, np.float64),
        T_camera_lidar=None if about.T_camera_lidar is None else np.array(about.T_camera_lidar, np.float64),
        K=None if about.K is None else np.array(about.K, np.float64),
        image_size=about.image_size,
        p_imu_antenna=np.array(about.p_imu_antenna, np.float64),
        camera_time_offset_s=about.camera_time_offset_s,
    )


def _table(path: Path, columns: tuple[str, ...]) -> Array:
    """The named columns of a CSV file, whatever their order: (n, len(columns))."""
    import pyarrow as pa
    from pyarrow import csv

    if not path.is_file():
        raise DataError(f"{path}: missing; expected a table with columns {','.join(columns)}")
    try:
        options = csv.ConvertOptions(
            include_columns=list(columns),
            column_types=dict.fromkeys(columns, pa.float64()),
            strings_can_be_null=True,
        )
        table = csv.read_csv(path, convert_options=options)
    except (pa.ArrowInvalid, pa.ArrowKeyError) as error:
        raise DataError(
            f"{path}: {str(error).splitlines()[0]}; expected numbers in columns {','.join(columns)}"
        ) from None
    if table.num_rows == 0:
        raise DataError(f"{path}: empty; expected rows of {','.join(columns)}")
    return np.column_stack([table[name].to_numpy() for name in columns]).astype(np.float64)


def _origin(gnss_rows: Array, path: Path) -> LocalFrame:
    """The first fix that is a place on Earth."""
    for lat, lon, alt in gnss_rows[:, 1:4]:
        if np.isfinite((lat, lon, alt)).all() and abs(lat) <= 90 and abs(lon) <= 360 and (lat, lon) != (0, 0):
            return LocalFrame(float(lat), float(lon), float(alt))
    raise DataError(
        f"{path}: no usable fix among {len(gnss_rows)} rows; expected degrees and metres of WGS 84"
    )


def _stamps(path: Path, what: str) -> tuple[dict[int, float], list[Skip]]:
    """Stamp of every frame, the first where there are several; and the lines that were left out."""
    stamps: dict[int, float] = {}
    skips = []
    for line, (number, stamp) in enumerate(_table(path, ("number", "stamp_s")), 2):
        if not np.isfinite((number, stamp)).all():
            skips.append(Skip(what, f"{path}: line {line}", "no number, or no stamp"))
        elif int(number) in stamps:
            skips.append(Skip(what, f"{path}: line {line}", f"frame {int(number)} has a stamp already"))
        else:
            stamps[int(number)] = float(stamp)
    return stamps, skips


def _stamped(folder: Path, suffix: str, what: str) -> tuple[list[tuple[int, float, Path]], list[Skip]]:
    """Number, stamp and file of every frame that has both, sorted by stamp; and what was left out."""
    files = frames.numbered(folder, suffix)
    if not files and not (folder / "stamps.csv").is_file():
        return [], []
    stamps, skips = _stamps(folder / "stamps.csv", what)
    skips += [
        Skip(what, str(path), "no stamp for this frame") for n, path in files.items() if n not in stamps
    ]
    skips += frames.missing(what, folder, stamps, files) + frames.repeated(folder, suffix, what, files)
    found: list[tuple[int, float, Path]] = []
    for number in sorted(set(files) & set(stamps), key=lambda n: (stamps[n], n)):
        if found and stamps[number] == found[-1][1]:
            skips.append(Skip(what, f"frame {number}", "repeated stamp"))
        else:
            found.append((number, stamps[number], files[number]))
    return found, skips


def _scans(folder: Path, is_compensated: bool) -> tuple[tuple[Scan, ...], list[Skip]]:
    found, skips = _stamped(folder, ".bin", "scan")
    return tuple(
        Scan(path.stem, n, t, partial(_read_scan, path, t, is_compensated)) for n, t, path in found
    ), skips


def _read_scan(path: Path, stamp: float, is_compensated: bool) -> Points:
    if is_compensated:
        rows = frames.read_points(path, 4)
        return Points(rows[:, :3], rows[:, 3], None)
    rows = frames.read_points(path, 5)
    return Points(rows[:, :3], rows[:, 3], stamp + rows[:, 4].astype(np.float64))


def _images(folder: Path, size: tuple[int, int] | None) -> tuple[tuple[Image, ...], list[Skip]]:
    found, skips = _stamped(folder, ".png", "image")
    return tuple(Image(n, t, partial(frames.read_image, path, size)) for n, t, path in found), skips
