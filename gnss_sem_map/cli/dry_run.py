"""`run --dry-run`: what would be read and written, and what it would take."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from gnss_sem_map.cli.console import refuse_unlabelled

if TYPE_CHECKING:
    from factor_graphs.geodesy import LocalFrame
    from gnss_sem_map.config import Settings
    from gnss_sem_map.runs.expected_cost import Expected
    from gnss_sem_map.runs.source import Source
    from gnss_sem_map.sensor_log import SensorLog


def print_plan(
    sources: Iterable[Source],
    settings: Settings,
    workers: int,
    origin: LocalFrame | None = None,
    align_to: Path | None = None,
) -> None:
    """Open every drive and its segmenter, and print what is there; raises what these raise, ends as a run would.

    `origin` is that of the map, by default that of the first drive that has one; `align_to` as `run_drives` has it.
    """
    from gnss_sem_map.datasets.laz_cloud import read_base
    from gnss_sem_map.mapping.trajectory import check_georeference
    from gnss_sem_map.runs.run_folder import georeference_of

    seconds = memory_mb = 0.0
    if align_to is not None and origin is not None:
        read_base(align_to, origin, settings.delivery.geoid)
    for source in sources:
        log = source.open_log()
        if source.segmenter is None and log.cameras:
            refuse_unlabelled(source.drive)
        source.open_network(settings, log)
        log.check_scans()
        origin = origin or log.frame
        georeference_of(settings, origin)
        check_georeference(log, origin, settings.mapping.voxel_size_m)
        for line in _of_drive(source, log, origin):
            typer.echo(line)
        cost = _cost(log, workers)
        seconds, memory_mb = seconds + cost.seconds, max(memory_mb, cost.memory_mb)
    typer.echo(
        f"expected: about {seconds / 60:.1f} min with {workers} {'process' if workers == 1 else 'processes'} that map,"
        f" {memory_mb / 1000:.1f} GB of memory (the constants of docs/scale.md, measured with labels from files; a"
        " network that segments images comes on top)"
    )
    typer.echo("dry run: nothing was written")


def _of_drive(source: Source, log: SensorLog, origin: LocalFrame | None) -> Iterable[str]:
    first, last = log.scans[0].stamp, log.scans[-1].stamp
    yield f"{source.name}: {log.scan_count} scans over {last - first:.1f} s, {len(log.images)} images"
    if log.given is not None:
        yield f"  trajectory: {log.given_how or f'{len(log.given)} poses given with the drive'}"
    elif log.imu is not None and log.gnss is not None:
        wheels = "" if log.wheels is None else f", {len(log.wheels.stamps)} wheel speeds"
        yield f"  trajectory: smoothed from {len(log.imu)} IMU samples and {len(log.gnss)} GNSS fixes{wheels}"
    yield f"  labels: {source.segmenter or 'none'}"
    where = (
        "none: the map is not georeferenced"
        if origin is None
        else f"{origin.lat_deg:.6f}, {origin.lon_deg:.6f}"
    )
    yield f"  origin: {where}"
    for skip in log.skips:
        yield f"  not usable: {skip.what}, {skip.where}: {skip.reason}"


def _cost(log: SensorLog, workers: int) -> Expected:
    from gnss_sem_map.errors import DataError
    from gnss_sem_map.runs.expected_cost import POINTS_PER_SCAN, expected_cost

    points: float = POINTS_PER_SCAN
    with suppress(DataError):  # the run skips a damaged scan
        points = len(log.scans[len(log.scans) // 2].read().xyz)
    hours = (log.scans[-1].stamp - log.scans[0].stamp) / 3600
    return expected_cost(log.scan_count, points, hours, workers)
