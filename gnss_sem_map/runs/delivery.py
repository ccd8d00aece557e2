"""The map of all drives: theirs are linked into it and added, the sum is refined and exported.

OUT/drives/NAME/    raw map, evidence, trajectory, run.json and report of one drive; its point labels, by the map of all
OUT/map, ...        their sum, refined and exported
OUT/                of a map of one drive, both
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from factor_graphs.trajectory import Trajectory
from gnss_sem_map.config import Settings
from gnss_sem_map.export.changes import write_changes
from gnss_sem_map.export.georeference import Georeference
from gnss_sem_map.export.movers import join_movers
from gnss_sem_map.files import ownership
from gnss_sem_map.files.atomic import link_or_copy
from gnss_sem_map.files.run_json import read_run
from gnss_sem_map.files.structured import read_json
from gnss_sem_map.files.untrusted import is_folder
from gnss_sem_map.files.work_folder import DRIVES
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.mapping import evidence
from gnss_sem_map.mapping.checkpoints import objects_from_json
from gnss_sem_map.mapping.raw_map import MAP
from gnss_sem_map.mapping.refining import Refined
from gnss_sem_map.process.run_stats import Progress, RunStats, silent
from gnss_sem_map.runs.about import about_map, seconds_of
from gnss_sem_map.runs.binding import BoundDrives
from gnss_sem_map.runs.drive_job import FINISHED, DriveJob
from gnss_sem_map.runs.drive_tasks import PLACED
from gnss_sem_map.runs.map_job import MapJob
from gnss_sem_map.runs.point_label_files import LabelledDrive, write_point_labels
from gnss_sem_map.runs.run_folder import write_about, write_map_files
from gnss_sem_map.runs.run_settings import COPIES, SETTINGS
from gnss_sem_map.runs.session_changes import changes_in
from gnss_sem_map.runs.source import Source
from gnss_sem_map.runs.tracks import tracks_of
from gnss_sem_map.voxels.attributes import ATTRIBUTES

OF_ONE_DRIVE = (SETTINGS, "run.json", "metrics.json", "report.html")
"""Files of a drive beside its map, evidence and trajectory."""


@dataclass(frozen=True, eq=False)
class RefinedMap:
    """A refined map in its folder: what refinement says beside it, and how long it took."""

    folder: Path
    refined: Refined
    stats: RunStats


def link_drives(drives: Mapping[str, Path], folder: Path) -> list[Path]:
    """Link `drives`, name -> folder, into that of a map; returns their folders there."""
    parts = [folder / DRIVES / name for name in sorted(drives)]
    for part in parts:
        link_map(drives[part.name], part)
        for name in OF_ONE_DRIVE:
            link_or_copy(drives[part.name] / name, part / name)
    return parts


def deliver_drives(
    made: RefinedMap,
    bound: BoundDrives,
    run: MapJob,
    labelled: Sequence[Source] = (),
    align_to: Path | None = None,
) -> dict[str, Any]:
    """Write all files of a map of several drives beside it, and the point labels of those that are `labelled`.

    Returns the content of run.json, with the drives that failed.
    """
    folder, settings, stats = made.folder, run.settings, made.stats
    label_set, parts = open_label_set(settings.classes), sorted((folder / DRIVES).iterdir())
    assert run.frame is not None
    of_drives = (_labelled(source, folder / DRIVES / source.name, settings) for source in labelled)
    with stats.stage("labels"):
        write_point_labels(folder, of_drives, made.refined.kerbs, settings, run.progress)
    with stats.stage("changes"):
        changes = changes_in(folder, parts, bound.passes, label_set)
    if changes is not None:
        write_changes(changes, Georeference.of(run.frame, settings.delivery), label_set, folder)
    join_movers(parts, folder)
    about = _about_drives(parts, run.failed, bound, align_to) | {
        "local_frame": asdict(run.frame),
        "changes": [change.about(label_set) for change in changes or ()],
        "map": about_map(folder, made.refined.report),
    }
    about["warnings"] += stats.warnings
    return write_summary(folder, settings, about, run.progress)


def deliver_one(made: RefinedMap, job: DriveJob, run: MapJob, write_labels: bool) -> None:
    """Write all files of a map of one drive beside it, with point labels if they are wanted."""
    folder, settings, stats = made.folder, run.settings, made.stats
    tracked, about = job.needed(FINISHED).about, read_run(job.made)
    objects = objects_from_json(tracked["objects"])
    report = replace(made.refined.report, tracked=objects, untracked=tracked["untracked"])
    track = Trajectory(**job.needed(PLACED).of("track"))  # not rounded, as that in files
    if write_labels:
        with stats.stage("labels"):
            drives = [replace(_labelled(job.source, folder, settings), trajectory=track)]
            write_point_labels(folder, drives, made.refined.kerbs, settings, run.progress)
    with stats.stage("export"):
        tracks = [track.during(*about["scans_s"])]
        write_map_files(folder, tracks, str(about["name"]), settings.delivery, progress=run.progress)
    about = _about_one(about, stats) | {"map": about_map(folder, report)}
    write_about(folder, settings, about, read_json(job.made / "metrics.json"))


def _about_one(about: dict[str, Any], stats: RunStats) -> dict[str, Any]:
    """What run.json says of a drive and of the map of it alone."""
    doubt, seconds = (about["delivery"] or {}).get("doubt"), seconds_of(stats)
    seconds["export"] = round(seconds["export"] + about["seconds"].get("export", 0.0), 3)
    warnings = [said for said in about["warnings"] if said != doubt]
    peaks = {name: round(peak) for name, peak in stats.peak_memory_mb.items()}
    return {name: value for name, value in about.items() if name not in ("correction", "delivery")} | {
        "seconds": about["seconds"] | seconds,
        "peak_memory_mb": about["peak_memory_mb"] | peaks,
        "warnings": [*warnings, *stats.warnings],
    }


def write_summary(
    folder: Path, settings: Settings, about: dict[str, Any], progress: Progress = silent
) -> dict[str, Any]:
    """Write all files of a map of several drives beside its maps and drives, which are there; returns run.json."""
    changes = about.get("changes", ())
    write_map_files(folder, tracks_of(folder), str(about["name"]), settings.delivery, changes, progress)
    return write_about(folder, settings, about, {})


def _about_drives(
    parts: Sequence[Path], failed: Mapping[str, str], bound: BoundDrives, align_to: Path | None
) -> dict[str, Any]:
    """What run.json says of the drives of a map, which are in these folders, and of what binds them."""
    return {
        "name": parts[0].name if len(parts) == 1 else f"{len(parts)} drives",
        "merged": [part.name for part in parts],
        "drives": {part.name: _summary(part) for part in parts},
        "failed": dict(sorted(failed.items())),
        "aligned_to": None if align_to is None else str(align_to.resolve()),
        "warnings": list(bound.warnings),
        "passes": [
            *(asdict(row) for row in bound.passes),
            *(row for part in parts for row in read_run(part).get("passes", ())),
        ],
    }


def _labelled(source: Source, folder: Path, settings: Settings) -> LabelledDrive:
    log = source.open_log().in_our_conventions(settings.sensors)
    return LabelledDrive(folder, log, Trajectory.load(folder / "trajectory.parquet"))


def _summary(drive: Path) -> dict[str, Any]:
    """What the list of drives says of one."""
    about = read_run(drive)
    steps = np.diff(tracks_of(drive)[0].positions, axis=0)
    return {
        "scans": about["counts"]["scans"],
        "way_m": round(float(np.linalg.norm(steps, axis=1).sum()), 1),
        "skips": about["skips"]["count"],
        "warnings": len(about["warnings"]),
    }


def link_map(drive: Path, part: Path) -> None:
    """Link the map and the trajectory of one drive, out of its own folder or out of a run of this drive alone."""
    part.mkdir(parents=True, exist_ok=True)
    for name in (MAP, ATTRIBUTES, evidence.FOLDER):
        if not is_folder(drive / name):
            continue  # older versions knew no attributes
        ignore = shutil.ignore_patterns(ownership.MARKER)
        shutil.copytree(drive / name, part / name, copy_function=link_or_copy, ignore=ignore)
    copies = [file for name in COPIES for file in drive.glob(name)]
    for file in (*drive.glob("trajectory*"), *drive.glob("objects.*"), *copies):
        link_or_copy(file, part / file.name)
