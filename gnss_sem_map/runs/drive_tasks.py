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

from factor_graphs.errors import FactorGraphError
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
from gnss_sem_map.mapping.execution import Executor, Task, run_tasks
from gnss_sem_map.run_stats import Progress
from gnss_sem_map.runs import run_folder
from gnss_sem_map.runs.bound_drives import BoundDrives, read_correction
from gnss_sem_map.runs.match_tasks import SavedMatches
from gnss_sem_map.runs.run_settings import differing, read_settings
from gnss_sem_map.runs.source import Source


def map_all(
    sources: Sequence[Source],
    work: Path,
    bound: BoundDrives,
    settings_file: Path,
    force: bool,
    frame: LocalFrame,
    executor: Executor,
    progress: Progress,
) -> dict[str, str]:
    """Map every drive into the folder `work`; name -> reason of those that fail."""
    origin = [frame.lat_deg, frame.lon_deg, frame.alt_m]
    tasks = []
    for source in sources:
        arguments = (
            asdict(source),
            str(work / DRIVES / source.name),
            str(settings_file),
            origin,
            force,
            str(bound.corrections.get(source.name, "")),
        )
        tasks.append(Task(source.name, f"{map_one.__module__}:{map_one.__name__}", arguments))
    found = run_tasks(tasks, executor, lambda done, total: progress("drives", done, total), lost=str)
    return {task.name: reason.removeprefix(f"{task.name}: ") for task, reason in found if reason}


def map_one(
    source: Mapping[str, Any],
    folder: str,
    settings: str,
    origin: Sequence[float],
    force: bool,
    correction: str,
) -> str:
    """Map one drive into a folder of its own: a task. Returns the reason when it fails, else nothing."""
    try:
        _map_one(
            Source(**source),
            Path(folder),
            config.load(Path(settings)),
            LocalFrame(*origin),
            force,
            correction,
        )
    except (SemMapError, FactorGraphError) as error:
        return str(error)
    except OSError as error:
        return f"{error.filename or 'a file'}: {error.strerror or error}"
    return ""


def _map_one(
    source: Source, folder: Path, settings: Settings, frame: LocalFrame, force: bool, correction_file: str
) -> None:
    log, (correction, digest) = source.open_log(), read_correction(correction_file)
    read = fingerprints.of_log(log, source.labels_from, open_label_set(settings.classes))
    # what is not to be used was removed before
    if _is_done(folder, settings, source.inputs, frame, read, digest):
        return
    with run_folder.claimed_run(folder, run_folder.places_read([source], settings)) as claim:
        refuse_inputs(claim.out, sorted(log.folders))
        network = source.open_network(settings, log)
        with new_folder(folder) as part:
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
