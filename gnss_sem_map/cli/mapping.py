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
    inputs_of,
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
    resume: Annotated[bool, typer.Option(help="Go on with what an interrupted run of this mapped.")] = False,
    write_labels: Annotated[bool, typer.Option(help="Also write a class per original LiDAR point.")] = False,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Trajectory, semantic map, refined map and all exports of one drive."""
    from gnss_sem_map import pipeline
    from gnss_sem_map.files.output_folder import refuse_inputs
    from gnss_sem_map.labels.label_set import open_label_set
    from gnss_sem_map.runs import run_folder
    from gnss_sem_map.segmentation import no_segmenter_message, open_segmenter

    settings = settings_of(config, set_)
    with run_folder.claimed_run(out, inputs_of(drive, config, settings, segmenter)) as claim:
        log = open_log(drive, drive_format, frames)
        refuse_inputs(claim.out, sorted(log.folders))
        network = None
        if segmenter is None and log.images:
            typer.echo(no_segmenter_message(str(drive)), err=True)
            raise typer.Exit(1)
        if segmenter not in (None, "none"):
            label_set = open_label_set(settings.classes)
            network = open_segmenter(str(segmenter), label_set, device, log.calibration.image_size)
        with progress_bars() as progress:
            result = pipeline.run(
                log,
                network,
                settings,
                progress,
                work=claim.work,
                resume=resume,
                workers=workers,
                labels_from=str(segmenter),
                force=force,
            )
            about = run_folder.write_run(out, drive, log, result, settings, write_labels, segmenter, frames)
    warn(result.stats.warnings)
    print_run(about, out, as_json)


def merge(
    first: Annotated[Path, typer.Argument(help="Folder of a run; the merged map has its frame.")],
    second: Annotated[Path, typer.Argument(help="Folder of another run, of the same place.")],
    out: Out,
    match: Annotated[
        bool,
        typer.Option(
            help="Align the surfaces of the second map with those of the first: positions of both err."
        ),
    ] = True,
    as_json: Json = False,
) -> None:
    """One map of two runs of the same place, refined again."""
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
    """Only the trajectory: GNSS and IMU smoothed, with covariance, in every format, and a plot of its quality."""
    from gnss_sem_map import pipeline
    from gnss_sem_map.run_stats import RunStats
    from gnss_sem_map.runs import run_folder

    settings = settings_of(config, set_)
    with run_folder.claimed_run(out, inputs_of(drive, config, settings)):
        log = open_log(drive, drive_format, None)
        stats = RunStats(skips=list(log.skips))
        page = pipeline.check_drive(log, None, settings, stats, force)
        with progress_bars() as progress, stats.stage("trajectory"):
            estimate, solution = pipeline.estimate_trajectory(log, settings, stats, progress)
        about = run_folder.write_trajectory_run(out, drive, log, estimate, solution, stats, settings, page)
    warn(stats.warnings)
    if as_json:
        typer.echo(json.dumps(about))
    else:
        typer.echo(
            f"{log.name}: {len(estimate)} poses over {estimate.end - estimate.start:.1f} s; results in {out}"
        )
