"""The command line. Everything heavy is imported inside the commands, so that --help answers at once."""

from __future__ import annotations

import io
import json
import os
import signal
import sys
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, cast, get_args

import typer

from gnss_sem_map.cli.console import (
    print_cache,
    print_merged,
    print_metrics,
    print_preflight,
    print_run,
    progress_bars,
    warn,
)

if TYPE_CHECKING:
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
    str | None,
    typer.Option(
        "--frames",
        help="Only frames A to B - 1, as A:B, by frame number; LiDAR odometry sees only these too, GNSS and IMU all"
        " of the drive.",
    ),
]
Segmenter = Annotated[
    str | None,
    typer.Option(
        help="Where class probabilities come from: labels:DIR, refinenet:FILE, hf:MODEL, onnx:FILE,"
        " python:MODULE:CALLABLE; none: geometry only."
    ),
]
Device = Annotated[str, typer.Option(help="Where a network runs: auto, cpu, cuda.")]
Force = Annotated[bool, typer.Option("--force", help="Go on where the pre-flight (see `check`) is red.")]
Json = Annotated[bool, typer.Option("--json", help="Print a summary as JSON.")]


@app.command()
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
    from gnss_sem_map.export import run_folder
    from gnss_sem_map.files.output_folder import refuse_inputs
    from gnss_sem_map.labels.label_set import open_label_set
    from gnss_sem_map.segmentation import no_segmenter_message, open_segmenter

    settings = _settings(config, set_)
    with run_folder.claimed_run(out, _inputs(drive, config, settings, segmenter)) as claim:
        log = _open(drive, drive_format, frames)
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
            about = run_folder.write_run(out, drive, log, result, settings, write_labels, segmenter)
    warn(result.account.warnings)
    print_run(about, out, as_json)


@app.command()
def merge(
    first: Annotated[Path, typer.Argument(help="Folder of a run; the merged map has its frame.")],
    second: Annotated[Path, typer.Argument(help="Folder of another run, of the same place.")],
    out: Out,
    match: Annotated[
        bool,
        typer.Option(help="Lay the surfaces of the second onto those of the first: positions of both err."),
    ] = True,
    as_json: Json = False,
) -> None:
    """One map of two runs of the same place, refined again."""
    from gnss_sem_map.export.merged_run import merge_run_folders

    about = merge_run_folders(first, second, out, match)
    if as_json:
        typer.echo(json.dumps(about))
    else:
        print_merged(about, out)


@app.command()
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
    from gnss_sem_map.export import run_folder
    from gnss_sem_map.run_stats import RunStats

    settings = _settings(config, set_)
    with run_folder.claimed_run(out, _inputs(drive, config, settings)):
        log = _open(drive, drive_format, None)
        account = RunStats(skips=list(log.skips))
        page = pipeline.check_drive(log, None, settings, account, force)
        with progress_bars() as progress, account.stage("trajectory"):
            estimate, solution = pipeline.estimate_trajectory(log, settings, account, progress)
        about = run_folder.write_trajectory_run(out, drive, log, estimate, solution, account, settings, page)
    warn(account.warnings)
    if as_json:
        typer.echo(json.dumps(about))
    else:
        typer.echo(
            f"{log.name}: {len(estimate)} poses over {estimate.end - estimate.start:.1f} s; results in {out}"
        )


@app.command()
def segment(
    drive: Drive,
    out: Annotated[
        Path, typer.Option("-o", "--out", help="Folder for the class probabilities; resumed if there.")
    ],
    segmenter: Annotated[str, typer.Option(help="The network: refinenet:FILE, hf:MODEL, onnx:FILE, ...")],
    device: Device = "auto",
    batch_size: Annotated[
        int, typer.Option(min=1, help="Images per step: one is fastest on a processor, more are on a GPU.")
    ] = 1,
    classes: Annotated[str, typer.Option(help="Class set: a shipped one, or a YAML file.")] = "urban",
    drive_format: Format = None,
) -> None:
    """Class probabilities of all images, once; later runs read them with --segmenter labels:OUT."""
    from gnss_sem_map.labels.label_set import open_label_set
    from gnss_sem_map.segmentation import open_segmenter
    from gnss_sem_map.segmentation.cache import write_cache

    log = _open(drive, drive_format, None)
    label_set = open_label_set(classes)
    network = open_segmenter(segmenter, label_set, device, log.calibration.image_size)
    with progress_bars() as progress:
        try:
            report = write_cache(log.images, network, label_set, out, segmenter, batch_size, progress)
        except Stopped as stopped:
            stopped.add_note("what is segmented is kept: the same command goes on")
            raise
    warn([f"{skip.where}: {skip.reason}" for skip in report.skips])
    print_cache(report, out)


@app.command()
def train(
    data: Annotated[
        list[str],
        typer.Option(
            help="Training data, as IMAGES,LABELS[,EVERY] (folders with the same names); repeatable."
        ),
    ],
    validation: Annotated[list[str], typer.Option(help="Validation data, likewise.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for the network, its state and the log.")],
    initial: Annotated[Path | None, typer.Option(help="Checkpoint to begin with.")] = None,
    taxonomy: Annotated[
        str, typer.Option(help="What the ids in the labels mean: cityscapes, camvid, FILE.")
    ] = "cityscapes",
    ids: Annotated[
        str | None, typer.Option(help="Kind of id, where the taxonomy has several: train_id, label_id.")
    ] = None,
    classes: Annotated[
        str, typer.Option(help="Class set to learn: a shipped one, or a YAML file.")
    ] = "urban",
    set_: Set = None,
    device: Device = "auto",
    resume: Annotated[bool, typer.Option(help="Go on where an interrupted training stopped.")] = False,
) -> None:
    """Train or fine-tune a RefineNet on images with label PNGs (the paper: Cityscapes, then CamVid)."""
    from gnss_sem_map import config
    from gnss_sem_map.labels.label_set import open_label_set
    from gnss_sem_map.segmentation.training import TrainingSettings
    from gnss_sem_map.segmentation.training import train as train_network
    from gnss_sem_map.segmentation.training_data import LabelledFolder

    settings = config.parse(TrainingSettings, set_ or ())
    learnt, checked = ([LabelledFolder.parse(text) for text in texts] for texts in (data, validation))
    with progress_bars() as progress:
        try:
            report = train_network(
                learnt,
                checked,
                out,
                open_label_set(classes),
                taxonomy,
                ids,
                settings,
                initial,
                device,
                resume,
                progress,
            )
        except Stopped as stopped:
            stopped.add_note("the same command with --resume goes on from the last validation")
            raise
    typer.echo(
        f"{report.network}: validation mean IoU {report.best_mean_iou:.3f} at step {report.best_step} of {report.steps}"
    )


@app.command()
def evaluate(
    run_folder: Annotated[
        Path, typer.Argument(metavar="OUT", help="Folder of a run made with --write-labels.")
    ],
    truth: Annotated[Path, typer.Option(help="Truth: a folder of .label files, or one with labels/ in it.")],
    restrict_to: Annotated[
        Path | None, typer.Option(help="Score only points that are labelled in these .label files.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Score a run against the truth: accuracy and IoU per class, what moved, calibration, trajectory."""
    from gnss_sem_map.errors import DataError
    from gnss_sem_map.evaluation.score_run import score_run
    from gnss_sem_map.export.report import write_report
    from gnss_sem_map.files.output_folder import locked, real_path
    from gnss_sem_map.files.run_json import read_run
    from gnss_sem_map.files.untrusted import shown

    with locked(real_path(run_folder)):
        metrics = score_run(run_folder, truth, restrict_to=restrict_to)
        try:
            write_report(run_folder, read_run(run_folder), metrics)
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise DataError(
                f"{shown(run_folder / 'run.json')}: damaged ({type(error).__name__} {error}); make the run again"
            ) from None
    if as_json:
        typer.echo(json.dumps(metrics))
    else:
        print_metrics(metrics)


@app.command()
def calibrate(
    run_folders: Annotated[
        list[Path], typer.Argument(metavar="OUT...", help="Folders of runs, one or more.")
    ],
    truth: Annotated[
        list[Path], typer.Option(help="Truth of each run, in the same order: .label files, or labels/ in it.")
    ],
    out: Annotated[Path, typer.Option("-o", "--out", help="Calibration file to write.")] = Path(
        "calibration.yaml"
    ),
    drive: Annotated[Path | None, typer.Option(help="The drive, where it is no longer where it was.")] = None,
    segmenter: Segmenter = None,
) -> None:
    """Measure what the network's answers are worth; use it with --set calibration=FILE."""
    from gnss_sem_map.evaluation.fit_sensor_model import calibrate as measure
    from gnss_sem_map.files.atomic import replacing
    from gnss_sem_map.labels.sensor_model import check_replaceable

    if len(truth) != len(run_folders):
        raise typer.BadParameter(f"found {len(truth)} for {len(run_folders)} runs", param_hint="--truth")
    check_replaceable(out)
    with progress_bars() as progress:
        found = measure(list(zip(run_folders, truth, strict=True)), drive, segmenter, progress)
    with replacing(out) as file:
        file.write(found.to_yaml().encode())
    points = sum(int(drive.answers.sum()) for drive in found.drives)
    typer.echo(
        f"{points} points of {len(found.drives)} drives, temperature {found.temperature:.2f};"
        f" now use --set calibration={out}"
    )


@app.command()
def check(
    drive: Drive,
    out: Annotated[Path, typer.Option("-o", "--out", help="Page to write.")] = Path("check.html"),
    segmenter: Segmenter = None,
    config: Config = None,
    set_: Set = None,
    frames: Frames = None,
    drive_format: Format = None,
    as_json: Json = False,
) -> None:
    """The pre-flight: a log against physics, and its sensors against each other; 1 when something is red."""
    from gnss_sem_map.evaluation import preflight
    from gnss_sem_map.evaluation.preflight.findings import Level
    from gnss_sem_map.export.check_page import check_writable, write_check_page
    from gnss_sem_map.labels.label_set import open_label_set
    from gnss_sem_map.segmentation import open_segmenter

    check_writable(out)
    settings = _settings(config, set_)
    log = _open(drive, drive_format, frames)
    network = None
    if segmenter not in (None, "none"):
        label_set = open_label_set(settings.classes)
        network = open_segmenter(str(segmenter), label_set, expected_size=log.calibration.image_size)
    page = preflight.check(log, settings, network)
    write_check_page(out, log.name, page)
    if as_json:
        typer.echo(json.dumps(page.as_dict()))
    else:
        print_preflight(log.name, page, out)
    if page.level is Level.RED:
        raise typer.Exit(1)


@app.command()
def simulate(
    out: Out,
    seconds: Annotated[float, typer.Option(min=0.3, help="Length of the drive, s.")] = 30.0,
    seed: Annotated[
        int, typer.Option(min=0, help="Town, traffic and noise; the same seed gives the same bytes.")
    ] = 0,
) -> None:
    """Write a simulated drive in KITTI raw format, with the exact truth beside it."""
    from gnss_sem_map.simulation import simulate as write_drive

    with progress_bars() as progress:
        drive = write_drive(out, seconds, seed, lambda done, total: progress("simulate", done, total))
    typer.echo(f"drive in {drive}")


@app.command()
def demo(
    out: Annotated[
        Path, typer.Option("-o", "--out", help="Folder of the results; the drive goes into OUT_drive.")
    ] = Path("demo"),
    seconds: Annotated[float, typer.Option(min=3.0, help="Length of the simulated drive, s.")] = 30.0,
    seed: Annotated[int, typer.Option(min=0, help="Town and traffic.")] = 0,
    labels: Annotated[
        Literal["network", "corrupted"],
        typer.Option(
            help="Class probabilities: from the small network made for this simulator, or the true class images,"
            " corrupted as a network would."
        ),
    ] = "network",
) -> None:
    """Simulate a drive, map it, score it against the exact truth, and say where the pictures are."""
    from gnss_sem_map.cli.demo import LABELS, demonstrate

    with progress_bars() as progress:
        done = demonstrate(out, seconds, seed, labels, progress)
    warn(done.about["warnings"])
    print_run(done.about, out, as_json=False)
    print_metrics(done.metrics)
    typer.echo(f"labels          {LABELS[labels]}")
    for picture in done.pictures:
        typer.echo(f"look at         {picture}")


@app.command()
def config(config: Config = None, set_: Set = None) -> None:
    """Print all settings as YAML, with the values that a run would use."""
    typer.echo(_settings(config, set_).to_yaml(), nl=False)


def _settings(file: Path | None, overrides: list[str] | None) -> Settings:
    from gnss_sem_map import config

    return config.load(file, overrides or ())


def _inputs(
    drive: Path, config: Path | None, settings: Settings, segmenter: str | None = None
) -> list[Path | str | None]:
    """Every place that a run reads, as far as it is known before the drive is opened."""
    place = (segmenter or "").partition(":")[2].partition("?")[0]
    classes = settings.classes if Path(settings.classes).suffix else None
    return [drive, config, place or None, settings.calibration, classes]


def _open(drive: Path, drive_format: str | None, frames: str | None) -> SensorLog:
    from dataclasses import replace

    from gnss_sem_map.datasets import DriveFormat, open_drive

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


class Stopped(BaseException):
    """Somebody asked us to stop: Ctrl-C, `kill`, or a terminal that was closed."""

    def __init__(self, number: int) -> None:
        super().__init__(f"stopped by {signal.Signals(number).name}")
        self.number = number


def _stop(number: int, _: object) -> None:
    raise Stopped(number)


def main() -> None:
    """Entry point: one line on stderr for every mistake; exit code 2 for wrong usage, 1 for an error that is ours.

    A signal ends it as orderly, with 128 and its number.
    """
    from factor_graphs.errors import FactorGraphError
    from gnss_sem_map.errors import SemMapError

    if not sys.warnoptions:
        warnings.simplefilter("ignore")  # those of other packages; ours are printed as such
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # names that are no UTF-8
    try:
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if signal.getsignal(number) is not signal.SIG_IGN:  # as `nohup` wants it
                signal.signal(number, _stop)
        code = app(prog_name="gnss-sem-map", standalone_mode=False)
        sys.stdout.flush()
    except Stopped as stopped:
        code = _say("; ".join([str(stopped), *getattr(stopped, "__notes__", [])]), 128 + stopped.number)
    except typer.TyperException as error:
        code = _wrong_usage(error)
    except (SemMapError, FactorGraphError) as error:
        code = _say(str(error), 1)
    except MemoryError as error:
        code = _say(
            f"not enough memory ({error}); take fewer --workers, larger voxels or a part of the drive", 1
        )
    except OSError as error:  # what the system refused, and nobody explained better
        code = _say(f"{error.filename or 'output'}: {error.strerror or error}", 1)
        _close_stdout()
    except (UnicodeError, RecursionError) as error:
        code = _say(f"{type(error).__name__} {error}", 1)
    sys.exit(code)


def _say(message: str, code: int) -> int:
    """One line on stderr; returns the exit code."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # we are ending already
    typer.echo(f"gnss-sem-map: {' '.join(message.split())}", err=True)
    return code


def _close_stdout() -> None:
    """What could not be printed will not be tried again at the end."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _wrong_usage(error: typer.TyperException) -> int:
    """Say in one line what was typed wrongly and where to read how; returns the exit code."""
    message = " ".join(error.format_message().split())
    context: typer.Context | None = getattr(error, "ctx", None)
    command = "gnss-sem-map" if context is None else context.command_path
    if message:  # no command at all: its help has been shown
        typer.echo(f"gnss-sem-map: {message.rstrip('.')}; see {command} --help", err=True)
    return error.exit_code


if __name__ == "__main__":
    main()
