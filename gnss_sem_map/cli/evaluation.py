"""Commands that measure: `evaluate`, `calibrate`, `fit-classifier`, `check`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from gnss_sem_map.cli.console import print_metrics, print_preflight, progress_bars
from gnss_sem_map.cli.options import (
    Config,
    Drive,
    Format,
    Frames,
    Json,
    Poses,
    Segmenter,
    Set,
    open_log,
    settings_of,
)


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
    """Score a run against the truth: accuracy and IoU per class, moving objects, calibration, trajectory."""
    from gnss_sem_map.errors import DataError
    from gnss_sem_map.evaluation.score_run import score_run
    from gnss_sem_map.export.report import write_report
    from gnss_sem_map.files.output_folder import locked, real_path
    from gnss_sem_map.files.ownership import is_as_written
    from gnss_sem_map.files.run_json import read_run
    from gnss_sem_map.files.untrusted import shown

    with locked(real_path(run_folder)):
        metrics = score_run(run_folder, truth, restrict_to=restrict_to)
        try:
            write_report(run_folder, read_run(run_folder), metrics)
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            if is_as_written(run_folder, "run.json"):
                raise  # an error of ours
            raise DataError(
                f"{shown(run_folder / 'run.json')}: damaged ({type(error).__name__} {error}); make the run again"
            ) from None
    if as_json:
        typer.echo(json.dumps(metrics))
    else:
        print_metrics(metrics)


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
    drive: Annotated[Path | None, typer.Option(help="The drive, if it was moved since.")] = None,
    segmenter: Segmenter = None,
) -> None:
    """Measure the confusion model of the network; use it with --set calibration=FILE."""
    from gnss_sem_map.files.atomic import replacing
    from gnss_sem_map.labels.sensor_model import check_replaceable
    from gnss_sem_map.runs.calibrating import calibrate as measure

    if len(truth) != len(run_folders):
        raise typer.BadParameter(f"found {len(truth)} for {len(run_folders)} runs", param_hint="--truth")
    check_replaceable(out)
    with progress_bars() as progress:
        found = measure(list(zip(run_folders, truth, strict=True)), drive, segmenter, progress)
    with replacing(out) as file:
        file.write(found.to_yaml().encode())
    points = sum(int(one.answers.sum()) for one in found.drives)
    typer.echo(
        f"{points} points of {len(found.drives)} drives, temperature {found.temperature:.2f};"
        f" now use --set calibration={out}"
    )


def fit_classifier(
    run_folders: Annotated[
        list[Path], typer.Argument(help="Folders of finished runs with labels of images.")
    ],
    out: Annotated[Path, typer.Option("-o", "--out", help="Classifier file to write.")] = Path(
        "classifier.npz"
    ),
) -> None:
    """Fit one geometric classifier to many runs; use it with --set geometric_classifier.model=FILE."""
    from gnss_sem_map.files.atomic import replacing
    from gnss_sem_map.runs.classifier_fitting import check_replaceable
    from gnss_sem_map.runs.classifier_fitting import fit_classifier as fit

    check_replaceable(out)
    with progress_bars() as progress:
        fitted, drives = fit(run_folders, progress)
    with replacing(out) as file:
        file.write(fitted.to_bytes())
    typer.echo(f"fitted to {drives} drives; now use --set geometric_classifier.model={out}")


def check(
    drive: Drive,
    out: Annotated[Path, typer.Option("-o", "--out", help="Page to write.")] = Path("check.html"),
    segmenter: Annotated[
        str | None,
        typer.Option(help="labels:FOLDER: check these class probabilities as well; a network is not run."),
    ] = None,
    config: Config = None,
    set_: Set = None,
    frames: Frames = None,
    drive_format: Format = None,
    trajectory: Poses = None,
    as_json: Json = False,
) -> None:
    """Pre-flight: check a log against physics, and its sensors against each other; exit code 1 if a check is red."""
    from gnss_sem_map import preflight
    from gnss_sem_map.labels.label_set import open_label_set
    from gnss_sem_map.preflight.findings import Level
    from gnss_sem_map.runs.check_page import check_writable, write_check_page
    from gnss_sem_map.segmentation import open_segmenter

    check_writable(out)
    settings = settings_of(config, set_)
    log = open_log(drive, drive_format, frames, trajectory)
    network = None
    if segmenter not in (None, "none"):
        label_set = open_label_set(settings.classes)
        network = open_segmenter(str(segmenter), label_set, sizes=log.calibration.image_sizes)
    page = preflight.check(log, settings, network)
    write_check_page(out, log.name, page)
    if as_json:
        typer.echo(json.dumps(page.as_dict()))
    else:
        print_preflight(log.name, page, log.skips, out)
    if page.level is Level.RED:
        raise typer.Exit(1)
