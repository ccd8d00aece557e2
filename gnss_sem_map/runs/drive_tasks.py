"""Each of many drives is mapped into a folder of its own: a task, which is the name of a function, paths and settings.

WORK/drives/config.yaml    the settings, for tasks
            NAME/          raw map, evidence, trajectory, run.json and report of one drive
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from factor_graphs.geodesy import LocalFrame
from gnss_sem_map import config, pipeline
from gnss_sem_map.config import Settings
from gnss_sem_map.errors import SemMapError
from gnss_sem_map.files.output_folder import new_folder, refuse_inputs
from gnss_sem_map.files.run_json import read_run
from gnss_sem_map.files.untrusted import is_file
from gnss_sem_map.files.work_folder import DRIVES
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.mapping import fingerprints
from gnss_sem_map.mapping.execution import failure_of
from gnss_sem_map.runs import run_folder
from gnss_sem_map.runs.bound_drives import BoundDrives, read_correction
from gnss_sem_map.runs.match_tasks import SavedMatches
from gnss_sem_map.runs.run_settings import differing, read_settings
from gnss_sem_map.runs.several_drives import SeveralDrives
from gnss_sem_map.runs.source import Source


def map_all(sources: Sequence[Source], bound: BoundDrives, force: bool, run: SeveralDrives) -> dict[str, str]:
    """Map every drive into the work folder; name -> reason of those that fail."""
    more = (
        (str(run.work / DRIVES / source.name), force, str(bound.corrections.get(source.name, "")))
        for source in sources
    )
    reasons = run.call(map_one, "drives", zip(sources, more, strict=True))
    return {name: reason.removeprefix(f"{name}: ") for name, reason in reasons.items() if reason}


def map_one(
    source: Mapping[str, Any],
    settings: str,
    origin: Sequence[float],
    folder: str,
    force: bool,
    correction: str,
) -> str:
    """Map one drive into a folder of its own: a task. Returns the reason when it fails, else nothing."""
    return failure_of(
        lambda: _map_one(
            Source(**source),
            config.load(Path(settings)),
            LocalFrame(*origin),
            Path(folder),
            force,
            correction,
        )
    )


def _map_one(
    source: Source, settings: Settings, frame: LocalFrame, folder: Path, force: bool, correction_file: str
) -> None:
    log, (correction, digest) = source.open_log(), read_correction(correction_file)
    read = fingerprints.of_log(log, source.labels_from, open_label_set(settings.classes))
    # what is not to be used was removed before
    if _is_done(folder, settings, source.inputs, frame, read, digest):
        return
    with run_folder.claimed_run(folder, run_folder.places_read([source], settings)) as claim:
        refuse_inputs(claim.out, sorted(log.folders))
        network = source.open_network(settings, log)
        with new_folder(folder, all_content=True) as part:
            mapped = pipeline.run(
                log, network, settings, part, claim.work,
                origin=frame, resume=True, match=SavedMatches(source, claim.work, resume=True),
                labels_from=source.labels_from, force=force, correction=correction,
                write=partial(run_folder.write_trajectory_files, part, delivery=settings.delivery),
            )  # fmt: skip
            run_folder.write_drive(part, source, mapped, settings, read, digest)


def _is_done(
    folder: Path, settings: Settings, inputs: dict[str, Any], frame: LocalFrame, read: str, correction: str
) -> bool:
    """Whether a folder holds this drive, mapped from the same inputs in the same way."""
    if not is_file(folder / "run.json"):
        return False
    try:
        about = read_run(folder)
        same = about["inputs"] == inputs and about["local_frame"] == asdict(frame)
        same = same and about["read"] == read and about["correction"] == correction
        return bool(same and not differing(read_settings(folder), settings))
    except (SemMapError, KeyError):
        return False
