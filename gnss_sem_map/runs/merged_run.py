"""Merging of two run folders into a third: both maps in the frame of the first, added, refined again and exported."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from gnss_sem_map.config import Settings
from gnss_sem_map.errors import DataError
from gnss_sem_map.files.output_folder import new_folder, read_whole
from gnss_sem_map.files.run_json import read_run
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.mapping.classifying import fit_classifiers
from gnss_sem_map.mapping.merging import Alignment, merge_runs
from gnss_sem_map.mapping.raw_map import open_raw
from gnss_sem_map.mapping.refining import refine_map
from gnss_sem_map.run_stats import Progress, silent
from gnss_sem_map.runs.about import about_map
from gnss_sem_map.runs.held_drives import HELD, check_none_twice, held_drives
from gnss_sem_map.runs.run_folder import claimed_run, write_about, write_map_files
from gnss_sem_map.runs.run_settings import read_settings
from gnss_sem_map.runs.tracks import keep_tracks, tracks_of


def merge_run_folders(first: Path, second: Path, out: Path, match: bool = True) -> dict[str, Any]:
    """Write the merged run into `out`, refined with the settings of the first; returns the content of run.json.

    With `match`, the second is registered to the first. Pictures show the tracks of the first. Raises DataError for
    folders that hold no run, a run with itself, runs that hold the same drive, and maps that do not fit together.
    """
    for run in (first, second):
        read_run(run)
    if first.resolve() == second.resolve():
        raise DataError(
            f"{second}: is the first run as well, and all its evidence would count twice; give another run"
        )
    with claimed_run(out, [first, second]), new_folder(out) as folder, read_whole(first, second):
        check_none_twice(first, second)
        return _merge(first, second, folder, match)


def _merge(first: Path, second: Path, folder: Path, match: bool) -> dict[str, Any]:
    settings = read_settings(first)
    label_set = open_label_set(settings.classes)
    merged = merge_runs(first, second, label_set, match)
    merged.write_raw(folder)
    warnings = fit_classifiers(folder, settings)
    refined = refine_map(open_raw(folder, label_set), folder, settings)
    about = {
        "name": f"{first.name} + {second.name}",
        "merged": [first.name, second.name],
        HELD: [*held_drives(first), *held_drives(second)],
        "local_frame": asdict(merged.frame),
        "map": about_map(folder, refined.report),
        "match": _about(merged.alignment),
        "warnings": warnings,
    }
    keep_tracks(folder, tracks_of(first))
    return write_merged(folder, settings, about)


def write_merged(
    folder: Path, settings: Settings, about: dict[str, Any], progress: Progress = silent
) -> dict[str, Any]:
    """Write the files of a run of several drives beside its maps and tracks, which are there; returns run.json."""
    write_map_files(
        folder, tracks_of(folder), str(about["name"]), settings.delivery, about.get("changes", ()), progress
    )
    return write_about(folder, settings, about, {})


def _about(alignment: Alignment) -> dict[str, Any]:
    """How the second map was aligned to the first, for run.json."""
    found = alignment.match
    return {
        "shift_m": None if found is None else round(found.shift_m, 3),
        "turn_deg": None if found is None else round(found.turn_deg, 3),
        "T_first_second": None if found is None else found.T_target_source.tolist(),
        "reason": alignment.reason,
        "overlap": dict(zip(("by_georeference", "aligned"), alignment.overlap, strict=True)),
    }
