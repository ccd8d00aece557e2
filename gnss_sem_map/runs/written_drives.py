"""The map of several drives: their folders are linked into it, their maps are added, the sum is refined and exported.

OUT/drives/NAME/    raw map, evidence, trajectory, run.json and report of one drive; its point labels, by the map of all
OUT/map, ...        their sum, refined and exported as the map of one drive is
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict
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
from gnss_sem_map.files.output_folder import new_folder
from gnss_sem_map.files.run_json import read_run
from gnss_sem_map.files.untrusted import is_folder
from gnss_sem_map.files.work_folder import DRIVES
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.mapping import evidence
from gnss_sem_map.mapping.raw_map import MAP, write_sum
from gnss_sem_map.process.run_stats import Progress, RunStats, silent
from gnss_sem_map.runs import pipeline
from gnss_sem_map.runs.about import about_map
from gnss_sem_map.runs.bound_drives import BoundDrives
from gnss_sem_map.runs.point_label_files import LabelledDrive, write_point_labels
from gnss_sem_map.runs.run_folder import write_about, write_map_files
from gnss_sem_map.runs.run_settings import COPIES, SETTINGS
from gnss_sem_map.runs.session_changes import changes_in
from gnss_sem_map.runs.several_drives import SeveralDrives
from gnss_sem_map.runs.source import Source
from gnss_sem_map.runs.tracks import tracks_of
from gnss_sem_map.voxels.attributes import ATTRIBUTES

OF_ONE_DRIVE = (SETTINGS, "run.json", "metrics.json", "report.html")
"""Files of a drive beside its map, evidence and trajectory."""


def write_drives(
    out: Path,
    drives: Mapping[str, Path],
    failed: Mapping[str, str],
    bound: BoundDrives,
    run: SeveralDrives,
    labelled: Sequence[Source] = (),
    align_to: Path | None = None,
) -> dict[str, Any]:
    """Write the map of `drives`, name -> folder, into `out`, and the point labels of those that are `labelled`.

    Returns the content of run.json, with the drives that `failed`.
    """
    settings, stats, label_set = run.settings, RunStats(), open_label_set(run.settings.classes)
    executor, work = run.executor, run.work
    with new_folder(out) as folder:
        parts = [folder / DRIVES / name for name in sorted(drives)]
        for part in parts:
            _link_all(drives[part.name], part)
        with stats.stage("mapping"):
            write_sum(parts, folder, run.frame, settings.classes, out, executor=executor, work=work)
        # tiles that are taken from an earlier map do not say which points of kerbs are which
        earlier = None if labelled else out
        refined = pipeline.refine(
            folder, settings, stats, run.progress, earlier, executor=executor, work=work
        )
        if labelled:
            of_drives = (_labelled(source, folder / DRIVES / source.name, settings) for source in labelled)
            with stats.stage("labels"):
                write_point_labels(folder, of_drives, refined.kerbs, settings, run.progress)
        with stats.stage("changes"):
            changes = changes_in(folder, parts, bound.passes, label_set)
        if changes is not None:
            write_changes(changes, Georeference.of(run.frame, settings.delivery), label_set, folder)
        join_movers(parts, folder)
        about = _about_drives(parts, failed, bound, align_to) | {
            "local_frame": asdict(run.frame),
            "changes": [change.about(label_set) for change in changes or ()],
            "map": about_map(folder, refined.report),
        }
        about["warnings"] += stats.warnings
        return write_summary(folder, settings, about, run.progress)


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
    unbound = sorted(bound.failed.keys() & {part.name for part in parts})
    return {
        "name": parts[0].name if len(parts) == 1 else f"{len(parts)} drives",
        "merged": [part.name for part in parts],
        "drives": {part.name: _summary(part) for part in parts},
        "failed": dict(sorted(failed.items())),
        "aligned_to": None if align_to is None else str(align_to.resolve()),
        "warnings": [
            *bound.warnings,
            *(f"{name}: could not be bound to other drives ({bound.failed[name]})" for name in unbound),
        ],
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


def _link_all(drive: Path, part: Path) -> None:
    """Link what belongs to one drive, out of its own folder or out of a run of this drive alone."""
    part.mkdir(parents=True)
    for name in (MAP, ATTRIBUTES, evidence.FOLDER):
        if not is_folder(drive / name):
            continue  # older versions knew no attributes
        ignore = shutil.ignore_patterns(ownership.MARKER)
        shutil.copytree(drive / name, part / name, copy_function=link_or_copy, ignore=ignore)
    for file in (
        *drive.glob("trajectory*"),
        *drive.glob("objects.*"),
        *(file for name in COPIES for file in drive.glob(name)),
        *(drive / name for name in OF_ONE_DRIVE),
    ):
        link_or_copy(file, part / file.name)
