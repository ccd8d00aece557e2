"""The command line. Everything heavy is imported inside the commands, so that --help answers at once."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast, get_args

import typer

if TYPE_CHECKING:
    from gnss_sem_map.account import Progress
    from gnss_sem_map.config import Settings
    from gnss_sem_map.sensor_log import SensorLog

app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="A drive log (GNSS, IMU, LiDAR, camera) in, a clean, georeferenced, semantic 3D map out.",
    epilog="Example: gnss-sem-map run 2011_09_26/2011_09_26_drive_0005_sync --segmenter labels:probabilities -o out",
)

Drive = Annotated[
    Path, typer.Argument(help="Folder of the drive: KITTI raw, KITTI odometry, or a table log.")
]
Out = Annotated[Path, typer.Option("-o", "--out", help="Folder to write; an earlier run there is replaced.")]
Config = Annotated[Path | None, typer.Option("--config", help="YAML file of settings (see `config`).")]
Set = Annotated[
    list[str] | None, typer.Option("--set", help="One setting, as section.name=value; repeatable.")
]
Format = Annotated[
    str | None, typer.Option("--format", help="kitti-raw, kitti-odometry or table; default: what is there.")
]
Frames = Annotated[
    str | None, typer.Option("--frames", help="Only frames A to B - 1, as A:B, by frame number.")
]
Json = Annotated[bool, typer.Option("--json", help="Print a summary as JSON.")]


@app.command()
def run(
    drive: Drive,
    out: Out,
    segmenter: Annotated[
        str | None,
        typer.Option(help="Where class probabilities come from: labels:DIR, refinenet:FILE, hf:MODEL, ..."),
    ] = None,
    config: Config = None,
    set_: Set = None,
    frames: Frames = None,
    drive_format: Format = None,
    write_labels: Annotated[bool, typer.Option(help="Also write a class per original LiDAR point.")] = False,
    as_json: Json = False,
) -> None:
    """Trajectory, semantic map, refined map and all exports of one drive."""
    from gnss_sem_map import labels, pipeline
    from gnss_sem_map.export import run_folder
    from gnss_sem_map.segmentation import open_segmenter

    run_folder.check_replaceable(out)
    settings = _settings(config, set_)
    log = _open(drive, drive_format, frames)
    label_set = labels.label_set(settings.classes)
    segment = None
    if segmenter is not None:
        segment = open_segmenter(segmenter, label_set, expected_size=log.calibration.image_size)
    with _progress() as progress:
        result = pipeline.run(log, segment, settings, progress)
        about = run_folder.write_run(out, drive, log, result, settings, write_labels)
    for warning in result.account.warnings:
        typer.echo(f"warning: {warning}", err=True)
    _report(about, out, as_json)


@app.command()
def config(config: Config = None, set_: Set = None) -> None:
    """Print all settings as YAML, with the values that a run would use."""
    typer.echo(_settings(config, set_).to_yaml(), nl=False)


def _settings(file: Path | None, overrides: list[str] | None) -> Settings:
    from gnss_sem_map import config

    return config.load(file, overrides or ())


def _open(drive: Path, drive_format: str | None, frames: str | None) -> SensorLog:
    from dataclasses import replace

    from gnss_sem_map.io import DriveFormat, open_drive

    if drive_format is not None and drive_format not in get_args(DriveFormat):
        raise typer.BadParameter(
            f"found {drive_format!r}, expected one of {get_args(DriveFormat)}", param_hint="--format"
        )
    log = open_drive(drive, cast("DriveFormat | None", drive_format))
    if frames is None:
        return log
    first, last = _frame_range(frames)
    return replace(log, scans=tuple(scan for scan in log.scans if first <= scan.number < last))


def _frame_range(frames: str) -> tuple[int, float]:
    first, colon, last = frames.partition(":")
    try:
        if not colon:
            raise ValueError
        return int(first or 0), int(last) if last else float("inf")
    except ValueError:
        raise typer.BadParameter(
            f"found {frames!r}, expected A:B with frame numbers", param_hint="--frames"
        ) from None


@contextmanager
def _progress() -> Iterator[Progress]:
    """A progress bar per stage on stderr; nothing when that is not a terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description:>12}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    console = Console(stderr=True)
    with Progress(*columns, console=console, disable=not console.is_terminal, transient=True) as bars:
        tasks: dict[str, Any] = {}

        def show(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = bars.add_task(stage, total=total)
            bars.update(tasks[stage], completed=done, total=total)

        yield show


def _report(about: dict[str, Any], out: Path, as_json: bool) -> None:
    if as_json:
        typer.echo(json.dumps(about))
        return
    counts, seconds = about["counts"], about["seconds"]
    typer.echo(
        f"{about['name']}: {counts.get('scans', 0)} scans, {counts.get('points', 0)} points,"
        f" {about['map']['voxels']} voxels, {about['skips']['count']} skips"
    )
    typer.echo("  ".join(f"{stage} {value:.1f} s" for stage, value in seconds.items()))
    typer.echo(f"results in {out}")


def main() -> None:
    """Entry point: one line on stderr and exit code 1 for every error that is ours."""
    from factor_graphs.errors import FactorGraphError
    from gnss_sem_map.errors import SemMapError

    try:
        app()
    except (SemMapError, FactorGraphError) as error:
        typer.echo(f"gnss-sem-map: {' '.join(str(error).split())}", err=True)
        sys.exit(1)


if __name__ == "__main__":
    main()
