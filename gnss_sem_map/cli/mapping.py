"""Commands that make a map or a trajectory: `run`, `merge`, `trajectory`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from gnss_sem_map.cli.console import print_merged, print_run, progress_bars, warn
from gnss_sem_map.cli.options import (
    Config,
    Device,
    Drive,
    Force,
    Format,
    Frames,
    Json,
    Out,
    Segmenter,
    Set,
    open_log,
    settings_of,
)


def run(
    drive: Drive,
    out: Out,
    segmenter: Segmenter = None,
    device: Device = "auto",
    config: Config = None,
    set_: Set = None,
    frames: Frames = None,
    drive_format: Format = None,
    workers: Annotated[int, typer.Option(min=1, help="Processes that map; the result is the same.")] = 1,
    resume: Annotated[
        bool, typer.Option(help="Continue an interrupted run of the same drive and settings.")
    ] = False,
    write_labels: Annotated[bool, typer.Option(help="Also write a class per original LiDAR point.")] = False,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Make trajectory, semantic map, refined map and all exports of one drive."""
    from gnss_sem_map.runs import finished_run
    from gnss_sem_map.runs.run_folder import claimed_run, places_read
    from gnss_sem_map.segmentation import no_segmenter_message

    settings = settings_of(config, set_)
    with claimed_run(out, places_read(drive, settings, segmenter, config)):
        log = open_log(drive, drive_format, frames)
        if segmenter is None and log.images:
            typer.echo(no_segmenter_message(str(drive)), err=True)
            raise typer.Exit(1)
        with progress_bars() as progress:
            finished = finished_run.run(
                drive, out, segmenter, settings,
                log=log, frames=frames, device=device, workers=workers, resume=resume, write_labels=write_labels,
                force=force, progress=progress,
            )  # fmt: skip
    about = finished.about
    warn(about["warnings"])
    print_run(about, out, as_json)


def merge(
    first: Annotated[Path, typer.Argument(help="Folder of a run; the merged map has its frame.")],
    second: Annotated[Path, typer.Argument(help="Folder of another run, of the same place.")],
    out: Out,
    match: Annotated[
        bool,
        typer.Option(help="Register the second map to the first, because both positions have errors."),
    ] = True,
    as_json: Json = False,
) -> None:
    """Merge two runs of the same place into one map, refined again."""
    from gnss_sem_map.runs.merged_run import merge_run_folders

    about = merge_run_folders(first, second, out, match)
    if as_json:
        typer.echo(json.dumps(about))
    else:
        print_merged(about, out)


def trajectory(
    drive: Drive,
    out: Out,
    config: Config = None,
    set_: Set = None,
    drive_format: Format = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Make only the trajectory: GNSS and IMU smoothed, with covariance, in every format, and a plot of its quality."""
    from gnss_sem_map import pipeline
    from gnss_sem_map.run_stats import RunStats
    from gnss_sem_map.runs import run_folder

    settings = settings_of(config, set_)
    with run_folder.claimed_run(out, run_folder.places_read(drive, settings, config=config)):
        log = open_log(drive, drive_format, None)
        stats = RunStats(skips=list(log.skips))
        page = pipeline.check_drive(log, None, settings, stats, force)
        with progress_bars() as progress, stats.stage("trajectory"):
            found = pipeline.locate(log, settings, stats, progress, page.solution)
        about = run_folder.write_trajectory_run(out, drive, log, found, stats, settings, page)
    warn(stats.warnings)
    if as_json:
        typer.echo(json.dumps(about))
    else:
        poses = found.trajectory
        typer.echo(f"{log.name}: {len(poses)} poses over {poses.end - poses.start:.1f} s; results in {out}")
