"""Commands that make a map or a trajectory: `run`, `add`, `remove`, `trajectory`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gnss_sem_map.cli.console import (
    print_many,
    print_run,
    progress_bars,
    refuse_unlabelled,
    warn,
)
from gnss_sem_map.cli.dry_run import print_plan
from gnss_sem_map.cli.options import (
    Config,
    Crs,
    Device,
    Drive,
    Force,
    Format,
    Frames,
    Geoid,
    Json,
    Out,
    Poses,
    Segmenter,
    Set,
    default_workers,
    drives_of,
    frame_of,
    open_log,
    settings_of,
)

if TYPE_CHECKING:
    from factor_graphs.geodesy import LocalFrame
    from gnss_sem_map.config import Settings
    from gnss_sem_map.runs.many_drives import HowMapped


Workers = Annotated[
    int | None,
    typer.Option(
        min=1, help="Processes that map; the result is the same. Default: all cores but one, with 2 GB each."
    ),
]
Scheduler = Annotated[
    str | None,
    typer.Option(help="Address of a Dask scheduler whose workers map instead (docs/cluster.md)."),
]
Resume = Annotated[bool, typer.Option(help="Continue an interrupted run of the same drives and settings.")]


def run(
    drives: Annotated[
        list[str],
        typer.Argument(
            metavar="DRIVE...",
            help="A drive: a folder of KITTI raw, KITTI odometry, KITTI-360 or a CSV log, or a ROS bag; several become"
            " one map."
            " @FILE stands for the drives in a file, one per line.",
        ),
    ],
    out: Out,
    segmenter: Segmenter = None,
    device: Device = "auto",
    config: Config = None,
    set_: Set = None,
    frames: Frames = None,
    drive_format: Format = None,
    trajectory: Poses = None,
    origin: Annotated[
        str | None,
        typer.Option(
            help="Origin of the map as LAT,LON,ALT in degrees and m; default: that of the first drive."
        ),
    ] = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    resume: Resume = False,
    write_labels: Annotated[
        bool,
        typer.Option(
            help="Also write a class per original LiDAR point (of several drives, in OUT/drives/NAME/)."
        ),
    ] = False,
    crs: Crs = None,
    geoid: Geoid = None,
    align_to: Annotated[
        Path | None,
        typer.Option(
            help="A georeferenced LAS or LAZ of the same place, which stands: the drives are held onto it."
        ),
    ] = None,
    force: Force = False,
    as_json: Json = False,
    dry_run: Annotated[
        bool,
        typer.Option(
            "--dry-run", help="Open everything, print what would be done and its cost; write nothing."
        ),
    ] = False,
) -> None:
    """Make trajectory, semantic map, refined map and all exports of one drive, or one map of several."""
    with progress_bars() as progress:
        progress("loading", 0, 1)  # of large packages, which takes a second
        from gnss_sem_map.runs import finished_run
        from gnss_sem_map.runs.many_drives import HowMapped, frame_of_all
        from gnss_sem_map.runs.run_folder import claimed_run, places_read
        from gnss_sem_map.runs.source import source_of

        progress("loading", 1, 1)
    settings, frame, found = settings_of(config, set_, crs, geoid), frame_of(origin), drives_of(drives)
    _refuse_both(scheduler, workers)
    is_of_many = len(found) > 1 or align_to is not None
    if is_of_many and segmenter is None:
        refuse_unlabelled(found[0])
    sources = [source_of(drive, segmenter, frames, drive_format, device, trajectory) for drive in found]
    with claimed_run(out, [*places_read(sources, settings, config), align_to], is_resumable=not dry_run):
        if dry_run:
            if is_of_many:
                frame = frame_of_all(sources, settings, frame)
            print_plan(sources, settings, workers or default_workers(), frame, align_to)
            return
        if is_of_many:
            how = HowMapped(segmenter, frames, drive_format, device, force, resume, trajectory)
            _run_many(found, out, settings, how, frame, workers, scheduler, write_labels, align_to, as_json)
            return
        [drive] = found
        log = open_log(drive, drive_format, frames, trajectory)
        if segmenter is None and log.cameras:
            refuse_unlabelled(drive)
        with progress_bars() as progress:
            finished = finished_run.run(
                drive, out, segmenter, settings,
                log=log, frames=frames, drive_format=drive_format, device=device, trajectory=trajectory,
                origin=frame, workers=workers or default_workers(), scheduler=scheduler, resume=resume,
                write_labels=write_labels, force=force, progress=progress,
            )  # fmt: skip
    about = finished.about
    warn(about["warnings"])
    print_run(about, out, as_json)


def _refuse_both(scheduler: str | None, workers: int | None) -> None:
    if scheduler is not None and workers is not None:
        raise typer.BadParameter("a scheduler has its own workers", param_hint="--workers")


def _run_many(
    drives: list[Path],
    out: Path,
    settings: Settings,
    how: HowMapped,
    origin: LocalFrame | None,
    workers: int | None,
    scheduler: str | None,
    write_labels: bool,
    align_to: Path | None,
    as_json: bool,
) -> None:
    from gnss_sem_map.runs.many_drives import run_drives

    with progress_bars() as progress:
        made = run_drives(
            drives, out, settings, how,
            origin=origin, workers=workers or default_workers(), scheduler=scheduler,
            write_labels=write_labels, align_to=align_to, progress=progress,
        )  # fmt: skip
    warn(made.about["warnings"])
    print_many(made.about, out, as_json)
    if made.failed:
        raise typer.Exit(1)


def add(
    out: Annotated[Path, typer.Argument(help="Folder of a finished map.")],
    drive: Drive,
    segmenter: Segmenter = None,
    device: Device = "auto",
    frames: Frames = None,
    drive_format: Format = None,
    trajectory: Poses = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    resume: Resume = False,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Add a drive to a finished map, with the map's settings: the same bytes as a run of all drives at once."""
    from gnss_sem_map.runs.finished_run import Run
    from gnss_sem_map.runs.many_drives import HowMapped, add_drive
    from gnss_sem_map.runs.point_label_files import has_point_labels

    _refuse_both(scheduler, workers)
    Run.open(out)
    if segmenter is None:
        refuse_unlabelled(drive)
    how = HowMapped(segmenter, frames, drive_format, device, force, resume, trajectory)
    had_labels = has_point_labels(out)
    with progress_bars() as progress:
        made = add_drive(
            out, drive, how, workers=workers or default_workers(), scheduler=scheduler, progress=progress
        )
    warn([*made.about["warnings"], *_labels_gone(had_labels)])
    print_many(made.about, out, as_json)


def _labels_gone(had_labels: bool) -> list[str]:
    message = (
        "the point labels were those of the map as it was, and are gone; `gnss-sem-map run` of all drives with"
        " --write-labels writes those of the new map"
    )
    return [message] if had_labels else []


def remove(
    out: Annotated[Path, typer.Argument(help="Folder of a finished map of several drives.")],
    name: Annotated[str, typer.Argument(help="Name of the drive, as in OUT/drives/.")],
    workers: Workers = None,
    scheduler: Scheduler = None,
    resume: Resume = False,
    as_json: Json = False,
) -> None:
    """Take a drive out of a finished map: the same bytes as a run of the others."""
    from gnss_sem_map.runs.finished_run import Run
    from gnss_sem_map.runs.many_drives import remove_drive
    from gnss_sem_map.runs.point_label_files import has_point_labels

    _refuse_both(scheduler, workers)
    Run.open(out)
    had_labels = has_point_labels(out)
    with progress_bars() as progress:
        made = remove_drive(
            out, name,
            workers=workers or default_workers(), scheduler=scheduler, resume=resume, progress=progress,
        )  # fmt: skip
    warn([*made.about["warnings"], *_labels_gone(had_labels)])
    print_many(made.about, out, as_json)


def trajectory(
    drive: Drive,
    out: Out,
    config: Config = None,
    set_: Set = None,
    drive_format: Format = None,
    given: Poses = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Make only the trajectory: GNSS and IMU smoothed, with covariance, in every format, and a plot of its quality."""
    from gnss_sem_map.process.run_stats import RunStats
    from gnss_sem_map.runs import pipeline, run_folder
    from gnss_sem_map.runs.source import source_of

    settings = settings_of(config, set_)
    source = source_of(drive, drive_format=drive_format, trajectory=given)
    with run_folder.claimed_run(out, run_folder.places_read([source], settings, config)):
        log = open_log(drive, drive_format, None, given)
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
        parts = () if found.solution is None else (found.solution.vehicle, found.solution.wheels)
        for part in parts:
            if part is not None:
                typer.echo(part.verdict)
        for verdict in () if found.solution is None else found.solution.beside:
            typer.echo(verdict)
