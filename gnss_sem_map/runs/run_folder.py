"""Writing of the run folder: what is known of drives and of a map."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from factor_graphs.geodesy import LocalFrame
from factor_graphs.trajectory import Trajectory
from factor_graphs.trajectory_plot import write_trajectory_plot
from gnss_sem_map.config import DeliverySettings, Settings
from gnss_sem_map.dynamics.motion_state import TrackedObject
from gnss_sem_map.dynamics.movers import movers_of
from gnss_sem_map.export.dates import are_dates
from gnss_sem_map.export.exported import Exported, sure_part
from gnss_sem_map.export.formats import write_exports
from gnss_sem_map.export.georeference import Georeference, check_delivery
from gnss_sem_map.export.movers import DriveOfMovers, write_movers
from gnss_sem_map.export.navigation import write_attitude, write_sbet
from gnss_sem_map.export.report import write_report
from gnss_sem_map.export.run_files import FILES
from gnss_sem_map.export.trajectories import (
    write_covariance_tum,
    write_geojson,
    write_geoparquet,
    write_kitti,
    write_tum,
)
from gnss_sem_map.files.output_folder import Claim, claimed, new_folder
from gnss_sem_map.files.run_json import read_run
from gnss_sem_map.files.structured import read_json
from gnss_sem_map.files.untrusted import is_folder
from gnss_sem_map.labels.label_set import LabelSet, open_label_set
from gnss_sem_map.labels.roles import MOVABLE
from gnss_sem_map.mapping.raw_map import MAP
from gnss_sem_map.mapping.refining import REFINED, Refined
from gnss_sem_map.mapping.trajectory import DriveTrajectory
from gnss_sem_map.preflight.findings import Preflight
from gnss_sem_map.process.run_stats import Progress, RunStats, silent
from gnss_sem_map.process.thread_pools import leaving_all
from gnss_sem_map.runs.about import about_map, about_run, about_solution, seconds_of
from gnss_sem_map.runs.point_label_files import LabelledDrive, write_point_labels
from gnss_sem_map.runs.run_settings import COPIES, write_settings
from gnss_sem_map.runs.source import Source, source_of
from gnss_sem_map.sensor_log import SensorLog
from gnss_sem_map.voxels import tiles
from gnss_sem_map.voxels.attributes import open_attributes

RUN_FILES = re.compile(
    "|".join(map(re.escape, (*(name for name in FILES if "." in name and name not in COPIES), "report.html")))
    + r"|(map|refined)/(map\.json|-?\d+_-?\d+\.parquet)?"
    r"|(labels|labels_raw|removed)/(\d+\.label)?|(confidence|looks)/(\d+\.bin)?"
)
"""Pattern of all paths in run folders of older versions, which have no list of their files: a calibration or a class
set there is the user's."""


def is_run_file(name: str) -> bool:
    """Whether a run writes a file, or a folder (ending in '/'), of this path."""
    return RUN_FILES.fullmatch(name) is not None


@contextmanager
def claimed_run(
    out: Path, inputs: Iterable[Path | str | None] = (), is_resumable: bool = False
) -> Iterator[Claim]:
    """Hold the output folder of a run exclusively; see `files.output_folder.claimed`."""
    with claimed(out, inputs, is_run_file, is_resumable) as claim, leaving_all():
        yield claim


def places_read(
    sources: Sequence[Source], settings: Settings | None = None, config: Path | None = None
) -> list[Path | str | None]:
    """All inputs of a run that are known before its drives are opened; without settings, those of the output count."""
    specs = [(source.segmenter or "").partition(":")[2].partition("?")[0] or None for source in sources]
    named = [] if settings is None else settings.files
    drives = [place for source in sources for place in (source.drive, source.trajectory)]
    return [*drives, *specs, *named, config]


def write_objects(
    folder: Path, name: str, log: SensorLog, objects: Sequence[TrackedObject], settings: Settings
) -> None:
    """Write what moved in a drive of this name."""
    label_set = open_label_set(settings.classes)
    movable = {label_set.names[label]: str(label_set.roles[label]) for label in label_set.having(*MOVABLE)}
    write_movers(movers_of(objects, movable), DriveOfMovers(name, log.epoch_ns, log.frame), folder)


def write_again(
    folder: Path,
    source: Path,
    trajectory: Trajectory,
    refined: Refined,
    stats: RunStats,
    settings: Settings,
    log: SensorLog | None,
    changed: dict[str, Any],
    known_raw: Path | None = None,
    progress: Progress = silent,
) -> None:
    """Write a finished run once more, with another map of the same drive, which is in the folder already.

    What stays is copied from `source`; scores of the map before do not. Point labels are written where there is a
    `log`, with those before refinement copied from `known_raw`. `changed` is what run.json says anew; what it said of
    moving objects stays where they were not sought again.
    """
    about, metrics = read_run(source), read_json(source / "metrics.json")
    first, last = about["scans_s"]
    for file in (*source.glob("trajectory*"), *source.glob("objects.*")):
        if not (folder / file.name).exists():  # what moved may be known anew
            shutil.copyfile(file, folder / file.name)
    if log is not None:
        with stats.stage("labels"):
            labelled = LabelledDrive(folder, log, trajectory, known_raw)
            write_point_labels(folder, [labelled], refined.kerbs, settings, progress)
    with stats.stage("export"):
        write_map_files(
            folder, [trajectory.during(first, last)], str(about["name"]), settings.delivery, progress=progress
        )
    tracked = about["map"]["refinement"]
    about |= changed
    about |= {
        "seconds": about["seconds"] | seconds_of(stats),
        "counts": about["counts"] | dict(sorted(stats.counts.items())),
        "warnings": list(dict.fromkeys([*about["warnings"], *stats.warnings])),
        "map": about_map(folder, refined.report),
    }
    if not refined.report.tracked:
        about["map"]["refinement"] |= {name: tracked[name] for name in ("tracked", "untracked_segments")}
    write_about(folder, settings, about, {"sharpness": metrics.get("sharpness", {})})


def write_map_files(
    folder: Path,
    tracks: Sequence[Trajectory],
    title: str,
    delivery: DeliverySettings,
    changes: Sequence[Mapping[str, Any]] = (),
    progress: Progress = silent,
) -> None:
    """Write the refined map of a run folder in all formats."""
    write_exports(exported_of(folder, tracks, title, delivery, changes), folder, progress)


def exported_of(
    folder: Path,
    tracks: Sequence[Trajectory],
    title: str,
    delivery: DeliverySettings,
    changes: Sequence[Mapping[str, Any]] = (),
    label_set: LabelSet | None = None,
) -> Exported:
    """What is exported of a run folder; without `label_set`, the classes are those that its map names."""
    refined = tiles.open_map(folder / REFINED, label_set, with_sums=False)
    refined = sure_part(refined, delivery.min_confidence)
    raw = (
        tiles.open_map(folder / MAP, refined.label_set, with_sums=False) if is_folder(folder / MAP) else None
    )
    return Exported(
        refined, tracks, title, changes, delivery.crs, delivery.geoid, open_attributes(folder), raw,
        delivery.nav2, delivery.terrain,
    )  # fmt: skip


def georeference_of(settings: Settings, frame: LocalFrame | None) -> Georeference | None:
    """Coordinates of the files of a map with this frame; raises ConfigError, so ask it before the work."""
    delivery = settings.delivery
    check_delivery(delivery.crs, delivery.geoid)
    return None if frame is None else Georeference.of(frame, delivery)


def write_about(
    folder: Path, settings: Settings, about: dict[str, Any], metrics: dict[str, Any]
) -> dict[str, Any]:
    """Write settings, run.json, metrics.json and the report; returns the content of run.json.

    A doubt about the coordinates is one of its warnings, in place of that about earlier ones.
    """
    frame = about.get("local_frame")
    georeference = georeference_of(settings, None if frame is None else LocalFrame(**frame))
    before, delivery = about.get("delivery") or {}, None if georeference is None else georeference.about()
    warnings = [each for each in about.get("warnings", ()) if each != before.get("doubt")]
    doubts = [delivery["doubt"]] if delivery and "doubt" in delivery else []
    about = about | {"delivery": delivery, "warnings": [*warnings, *doubts]}
    write_settings(folder, settings)
    _write_json(folder / "run.json", about)
    _write_json(folder / "metrics.json", metrics)
    write_report(folder, about, metrics)
    return about


def write_trajectory_run(
    out: Path,
    drive: Path,
    log: SensorLog,
    found: DriveTrajectory,
    stats: RunStats,
    settings: Settings,
    page: Preflight,
) -> dict[str, Any]:
    """Write a run that stopped after its trajectory; returns the content of run.json."""
    with claimed_run(out, [drive]), new_folder(out) as folder:
        rejected = None if found.solution is None else found.solution.rejected
        write_trajectory_files(folder, log, found.trajectory, found.alone, rejected)
        if found.solution is not None and log.gnss is not None:
            write_trajectory_plot(found.solution, log.gnss, folder / "trajectory.png")
        write_settings(folder, settings)
        about = about_run(source_of(drive).name, log, stats) | {
            "preflight": page.as_dict(),
            "trajectory": about_solution(found.solution),
        }
        _write_json(folder / "run.json", about)
    return about


def check_deliverable(trajectory: Trajectory, frame: LocalFrame | None, delivery: DeliverySettings) -> None:
    """Raise ConfigError where files of a map along it could not be delivered in the coordinates that are asked for."""
    if frame is not None:
        Georeference.of(frame, delivery).from_map(trajectory.positions)


def write_trajectory_files(
    folder: Path,
    log: SensorLog,
    trajectory: Trajectory,
    alone: Trajectory | None = None,
    rejected: NDArray[np.bool_] | None = None,
) -> None:
    """Write a trajectory in every format, and that before it was bound, if it was; `rejected` fixes are told."""
    trajectory.save(folder / "trajectory.parquet")
    if alone is not None:
        alone.save(folder / "trajectory_alone.parquet")
    write_tum(trajectory, folder / "trajectory.tum")
    if trajectory.covariances is not None:
        write_covariance_tum(trajectory, folder / "trajectory_covariance.tum")
    write_kitti(trajectory, folder / "trajectory_kitti.txt")
    if log.frame is None:
        return
    write_geojson(trajectory, log.frame, folder / "trajectory.geojson")
    times = log.epoch_ns + np.round(1e9 * trajectory.stamps[[0, -1]]).astype(np.int64)
    if are_dates(times).all():
        write_sbet(trajectory, log.frame, log.epoch_ns, folder / "trajectory.sbet")
    fixes = None if log.gnss is None or rejected is None else log.gnss.stamps
    rejected = None if fixes is None else rejected
    write_geoparquet(
        trajectory, log.frame, log.epoch_ns, folder / "trajectory_wgs84.parquet", fixes, rejected
    )
    write_attitude(trajectory, log.frame, folder / "trajectory_attitude.csv", fixes, rejected)


def _write_json(path: Path, content: dict[str, Any]) -> None:
    path.write_text(json.dumps(content, indent=1) + "\n", "utf-8")
