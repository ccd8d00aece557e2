"""Commands that simulate: `simulate`, `demo`."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Literal

import typer

from gnss_sem_map.cli.console import print_metrics, print_run, progress_bars, warn
from gnss_sem_map.cli.options import NewDrive


def simulate(
    out: NewDrive,
    seconds: Annotated[
        float | None,
        typer.Option(
            min=0.3,
            help="Length of the drive, s; 30, or as long as the laps take (about 50 s each).",
            show_default=False,
        ),
    ] = None,
    seed: Annotated[
        int, typer.Option(min=0, help="Town, traffic and noise; the same seed gives the same bytes.")
    ] = 0,
    laps: Annotated[
        int, typer.Option(min=1, help="From 2 on: so many times around a block of the town, in one drive.")
    ] = 1,
    session: Annotated[
        int,
        typer.Option(
            min=0,
            help="The same town so many days later: other traffic, other parked cars, some things built or gone.",
        ),
    ] = 0,
    gnss: Annotated[
        Literal["unit", "consumer"],
        typer.Option(
            help="Positions of an inertial unit (0.35 m, drifting), or of a consumer's receiver (1 m)."
        ),
    ] = "unit",
    layout: Annotated[
        Literal["kitti-raw", "table", "rosbag1", "mcap", "kitti-360"] | None,
        typer.Option(
            help="KITTI raw, a CSV log, a ROS 1 bag, or a ROS 2 bag: the same drive, and the same map. KITTI-360: its"
            " own rig. Default: KITTI raw, of other rigs a CSV log.",
            show_default=False,
        ),
    ] = None,
    rig: Annotated[
        Literal["kitti", "surround", "kitti-360"] | None,
        typer.Option(
            help="KITTI's LiDAR and camera; two LiDARs of 32 rings and four cameras, one of them a fisheye; or"
            " KITTI-360's LiDAR, two cameras and two fisheyes. Default: that of the layout, else KITTI's.",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Write a simulated drive, with the exact truth beside it."""
    from gnss_sem_map.simulation import prepare
    from gnss_sem_map.simulation import simulate as write_drive
    from gnss_sem_map.simulation.drive import drive_name, refuse_there
    from gnss_sem_map.simulation.layouts import write_in_layout, write_rig
    from gnss_sem_map.simulation.rigs import RIGS

    with progress_bars() as progress:
        rig = rig or ("kitti-360" if layout == "kitti-360" else "kitti")
        layout = layout or ("kitti-raw" if rig == "kitti" else "table")
        if layout != "kitti-raw":  # what writes that layout refuses at once
            refuse_there(out / drive_name(seed, session))
        if rig != "kitti" or layout == "kitti-360":
            simulation = prepare(seconds, seed, laps=laps, session=session, gnss=gnss, rig=RIGS[rig]())
            drive = write_rig(simulation, out, layout, lambda done, total: progress("simulate", done, total))
            typer.echo(f"drive in {drive}")
            return
        drive = write_in_layout(
            out, layout,
            lambda folder: write_drive(
                folder, seconds, seed, lambda done, total: progress("simulate", done, total),
                laps=laps, session=session, gnss=gnss,
            ),
            lambda done, total: progress("write", done, total),
        )  # fmt: skip
    typer.echo(f"drive in {drive}")


def demo(
    out: Annotated[
        Path, typer.Option("-o", "--out", help="Folder of the results; the drive goes into OUT_drive.")
    ] = Path("demo"),
    seconds: Annotated[float, typer.Option(min=3.0, help="Length of the simulated drive, s.")] = 30.0,
    seed: Annotated[int, typer.Option(min=0, help="Town and traffic.")] = 0,
    labels: Annotated[
        Literal["network", "corrupted"] | None,
        typer.Option(
            help="Class probabilities: from the small network made for this simulator, or the true class images,"
            " corrupted as a network would. Default: the network, without torch the latter.",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Simulate a drive, map it, score it against the exact truth, and list the pictures."""
    from gnss_sem_map.cli.demo import LABELS, demonstrate

    if labels is None:
        labels = "network" if find_spec("torch") and find_spec("safetensors") else "corrupted"
        if labels == "corrupted":
            warn(
                ["torch and safetensors are not installed: the demo takes corrupted true labels, no network"]
            )
    with progress_bars() as progress:
        done = demonstrate(out, seconds, seed, labels, progress)
    warn(done.about["warnings"])
    print_run(done.about, out, as_json=False)
    print_metrics(done.metrics)
    typer.echo(f"labels          {LABELS[labels]}")
    for picture in done.pictures:
        typer.echo(f"look at         {picture}")
