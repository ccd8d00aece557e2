"""Options that several commands share, and the settings and drives that they name."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from factor_graphs.geodesy import LocalFrame
    from gnss_sem_map.config import Settings
    from gnss_sem_map.sensor_log import SensorLog

WORKER_BYTES = 2 << 30
"""Memory of a worker, which maps the scans of an HDL-64E in 1 GB; the machine is divided by one more than workers."""

Drive = Annotated[
    Path,
    typer.Argument(
        help="The drive: a folder of KITTI raw, KITTI odometry, KITTI-360 or a CSV log, or a ROS bag."
    ),
]
Out = Annotated[Path, typer.Option("-o", "--out", help="Folder to write; an earlier run there is replaced.")]
NewDrive = Annotated[
    Path,
    typer.Option("-o", "--out", help="Folder to write the drive into; a drive that is there is refused."),
]
Config = Annotated[Path | None, typer.Option("--config", help="YAML file of settings (see `config`).")]
Set = Annotated[
    list[str] | None, typer.Option("--set", help="One setting, as section.name=value; repeatable.")
]
Format = Annotated[
    str | None,
    typer.Option(
        "--format", help="kitti-raw, kitti-odometry, kitti-360, table (CSV log) or rosbag; default: detected."
    ),
]
Frames = Annotated[
    str | None,
    typer.Option(
        "--frames",
        help="Only frames A to B - 1, as A:B, by frame number; LiDAR odometry uses only these too; GNSS and IMU"
        " are used completely.",
    ),
]
Poses = Annotated[
    str | None,
    typer.Option(
        "--trajectory",
        help="Poses in place of those smoothed from GNSS and IMU: TUM (T_map_imu), trajectory.parquet of a run, or"
        " SBET (.sbet, .out). {drive} stands for the name of the drive.",
    ),
]
Segmenter = Annotated[
    str | None,
    typer.Option(
        help="Source of class probabilities: labels:DIR, refinenet:FILE, hf:MODEL, onnx:FILE,"
        " python:MODULE:CALLABLE; none: geometry only. {drive} stands for the name of the drive."
    ),
]
Crs = Annotated[
    int | None,
    typer.Option(
        help="EPSG code of the files' CRS, a projected one in metres; default: UTM (WGS 84) at the map's origin."
    ),
]
Geoid = Annotated[
    Path | None,
    typer.Option(
        help="Grid of geoid heights as PROJ reads it (.tif, .gtx): heights are orthometric; default: above the"
        " WGS 84 ellipsoid."
    ),
]
Device = Annotated[str, typer.Option(help="Device of a network: auto, cpu, cuda.")]
Force = Annotated[bool, typer.Option("--force", help="Continue even if the pre-flight (see `check`) is red.")]
Json = Annotated[bool, typer.Option("--json", help="Print a summary as JSON.")]


def settings_of(
    file: Path | None, overrides: list[str] | None, crs: int | None = None, geoid: Path | None = None
) -> Settings:
    """The settings of `--config`, `--set`, `--crs` and `--geoid`; raises ConfigError."""
    from gnss_sem_map import config

    return delivered_in(config.load(file, overrides or ()), crs, geoid)


def delivered_in(
    settings: Settings, crs: int | None, geoid: Path | None, min_confidence: float | None = None
) -> Settings:
    """Settings with the coordinates and the least confidence that are given; raises ConfigError for impossible ones."""
    from gnss_sem_map.config import DeliverySettings, parse
    from gnss_sem_map.export.georeference import check_delivery

    new = {
        "crs": crs,
        "geoid": None if geoid is None else str(geoid.resolve()),
        "min_confidence": min_confidence,
    }
    given = {name: value for name, value in new.items() if value is not None}
    delivery = parse(DeliverySettings, (), settings.delivery.model_dump(mode="json") | given, "delivery")
    check_delivery(delivery.crs, delivery.geoid)
    return settings.model_copy(update={"delivery": delivery})


def open_log(
    drive: Path, drive_format: str | None, frames: str | None, trajectory: str | None = None
) -> SensorLog:
    """The drive, with the scans that `--frames` names; raises DataError, and BadParameter for a wrong option."""
    from gnss_sem_map.datasets import open_drive, readers
    from gnss_sem_map.errors import ConfigError
    from gnss_sem_map.runs.source import source_of

    if drive_format is not None and drive_format not in readers():
        raise typer.BadParameter(
            f"found {drive_format!r}, expected one of {sorted(readers())}", param_hint="--format"
        )
    log = open_drive(drive, drive_format, trajectory=source_of(drive, trajectory=trajectory).trajectory)
    try:
        return log.between(frames)
    except ConfigError as error:
        raise typer.BadParameter(str(error), param_hint="--frames") from None


def drives_of(words: list[str]) -> list[Path]:
    """The drives that are named, those of a file for @FILE; raises BadParameter."""
    from gnss_sem_map.files.untrusted import read_lines

    found: list[Path] = []
    for word in words:
        if not word.startswith("@"):
            found.append(Path(word))
            continue
        lines = [line.strip() for line in read_lines(Path(word[1:]))]
        found += [Path(word[1:]).parent / line for line in lines if line and not line.startswith("#")]
    if not found:
        raise typer.BadParameter(f"found no drive in {' '.join(words)}", param_hint="DRIVE")
    return found


def frame_of(origin: str | None) -> LocalFrame | None:
    """The frame with this origin, LAT,LON,ALT; raises BadParameter."""
    from factor_graphs.errors import MeasurementError
    from factor_graphs.geodesy import LocalFrame

    if origin is None:
        return None
    try:
        lat_deg, lon_deg, alt_m = map(float, origin.split(","))
    except ValueError:
        raise typer.BadParameter(
            f"found {origin[:100]!r}, expected three numbers LAT,LON,ALT in degrees and m, e.g. 49.01,8.43,112.8",
            param_hint="--origin",
        ) from None
    try:
        return LocalFrame(lat_deg, lon_deg, alt_m)
    except MeasurementError as error:
        raise typer.BadParameter(str(error), param_hint="--origin") from None


def default_workers() -> int:
    """All cores but one, as long as each worker, and this process, has enough memory."""
    from gnss_sem_map.process.machine import cores, memory_bytes

    return max(min(cores(), memory_bytes() // WORKER_BYTES) - 1, 1)
