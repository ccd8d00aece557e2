"""Commands on a finished run: `refine`, `relabel`, `export`, `view`."""

from __future__ import annotations

import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gnss_sem_map.cli.console import print_many, print_run, progress_bars, warn
from gnss_sem_map.cli.options import Crs, Device, Geoid, Json, Set, delivered_in

if TYPE_CHECKING:
    from gnss_sem_map.config import Settings
    from gnss_sem_map.runs.finished_run import Run

Finished = Annotated[Path, typer.Argument(help="Folder of a finished run.")]
Other = Annotated[
    Path | None, typer.Option("-o", "--out", help="Folder to write; default: the run itself is replaced.")
]


def refine(
    run: Finished,
    set_: Set = None,
    out: Other = None,
    crs: Crs = None,
    geoid: Geoid = None,
    as_json: Json = False,
) -> None:
    """Refine the map of a run again with other refinement settings; scans are not matched or segmented again."""
    from gnss_sem_map.runs.finished_run import Run

    finished = Run.open(run)
    settings = delivered_in(finished.settings.changed(*(set_ or ())), crs, geoid)
    with progress_bars() as progress:
        again = finished.refine(settings, out, progress=progress)
    about = again.about
    _warn_of_coordinates(again, again.settings)
    if "drives" in about:
        print_many(about, again.folder, as_json)
    else:
        print_run(about, again.folder, as_json, ("refinement", "labels", "export"))


def relabel(
    run: Finished,
    segmenter: Annotated[
        str, typer.Option(help="Source of class probabilities: labels:DIR, refinenet:FILE, ...")
    ],
    device: Device = "auto",
    out: Other = None,
    as_json: Json = False,
) -> None:
    """Map the drive of a run again with other labels, along the same trajectory."""
    from gnss_sem_map.runs.finished_run import Run

    with progress_bars() as progress:
        again = Run.open(run).relabel(segmenter, out, device=device, progress=progress)
    print_run(again.about, again.folder, as_json, ("mapping", "refinement", "labels", "export"))


def export(
    run: Finished,
    formats: Annotated[
        str,
        typer.Option(
            "--format",
            help="Some of viewer, laz, removed, ply, geotiff, geopackage, topview, perspective, flight, copc, nav2, "
            "terrain; with commas.",
        ),
    ],
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="Folder to write; default: the run.")
    ] = None,
    crs: Crs = None,
    geoid: Geoid = None,
    min_confidence: Annotated[
        float | None,
        typer.Option(
            help="Voxels whose label is less sure than this (0 to 1) are written as unlabelled; default: 0."
        ),
    ] = None,
    set_: Set = None,
) -> None:
    """Write the refined map of a run in some formats; delivered otherwise than the run into a folder of their own."""
    from gnss_sem_map.errors import ConfigError
    from gnss_sem_map.runs.finished_run import Run

    finished = Run.open(run)
    if others := [each for each in set_ or () if not each.startswith("delivery.")]:
        raise ConfigError(
            f"export: found --set {others[0][:100]}, expected settings of `delivery`, such as delivery.nav2.step_m=0.05"
        )
    settings = delivered_in(finished.settings.changed(*(set_ or ())), crs, geoid, min_confidence)
    with progress_bars() as progress:
        files = finished.export(
            [name.strip() for name in formats.split(",")], out, settings.delivery, progress
        )
    _warn_of_coordinates(finished, settings)
    for file in files:
        typer.echo(str(file))


def _warn_of_coordinates(finished: Run, settings: Settings) -> None:
    """Say how inaccurate the coordinates of files are, where they are."""
    from gnss_sem_map.runs.run_folder import georeference_of

    georeference = georeference_of(settings, finished.frame)
    warn([georeference.doubt] if georeference is not None and georeference.doubt else [])


def view(
    run: Finished,
    browser: Annotated[bool, typer.Option(help="Open it in a browser; else only print its path.")] = True,
) -> None:
    """Open the viewer of a run in a browser."""
    from gnss_sem_map.runs.finished_run import Run

    finished = Run.open(run)
    file = finished.folder / "viewer.html"
    if not file.is_file():
        [file] = finished.export(["viewer"])
    if not (browser and webbrowser.open(file.resolve().as_uri())):
        typer.echo(f"open in a browser: {file.resolve()}")
