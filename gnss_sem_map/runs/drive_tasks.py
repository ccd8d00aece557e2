"""Each of many drives is mapped into a folder of its own: a task, which is the name of a function, paths and settings.

WORK/drives/config.TOKEN.yaml    the settings, for the tasks of this run
            failed.json          the drives that have failed
            NAME/                raw map, evidence, trajectory, run.json and report of one drive
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from factor_graphs.geodesy import LocalFrame
from gnss_sem_map import config
from gnss_sem_map.files.output_folder import new_folder, refuse_inputs
from gnss_sem_map.files.work_folder import DRIVES
from gnss_sem_map.process.execution import failure_of
from gnss_sem_map.runs import pipeline, run_folder
from gnss_sem_map.runs.bound_drives import BoundDrives, read_correction
from gnss_sem_map.runs.match_tasks import SavedMatches
from gnss_sem_map.runs.same_run import digest_of, is_made_from
from gnss_sem_map.runs.several_drives import SeveralDrives, refuse_earlier
from gnss_sem_map.runs.source import Source
from gnss_sem_map.voxels.reuse import read_record, write_record

FAILED = "failed.json"


def map_all(sources: Sequence[Source], bound: BoundDrives, force: bool, run: SeveralDrives) -> dict[str, str]:
    """Map every drive into the work folder; name -> reason of those that fail."""
    if not sources:
        return {}
    more = (
        (str(run.work / DRIVES / source.name), force, str(bound.corrections.get(source.name, "")))
        for source in sources
    )
    reasons = run.call(map_one, "drives", zip(sources, more, strict=True))
    return {name: reason.removeprefix(f"{name}: ") for name, reason in reasons.items() if reason}


def save_failed(failed: Mapping[str, str], run: SeveralDrives) -> None:
    """Save which drives have failed, and why; raises DataError."""
    write_record(dict(failed), run.work / DRIVES / FAILED)


def failed_before(run: SeveralDrives) -> set[str]:
    """Names of the drives that had failed when the run was interrupted."""
    return set(read_record(run.work / DRIVES / FAILED) or ())


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
            Path(settings),
            LocalFrame(*origin),
            Path(folder),
            force,
            correction,
        )
    )


def _map_one(
    source: Source, settings_file: Path, frame: LocalFrame, folder: Path, force: bool, correction_file: str
) -> None:
    settings, log = config.load(settings_file), source.open_log()
    correction, digest = read_correction(correction_file)
    read = digest_of(log, source, settings)

    def is_done() -> bool:
        return is_made_from(folder, source, settings, frame, read, digest)

    if is_done():
        return
    with run_folder.claimed_run(folder, run_folder.places_read([source], settings), waits=True) as claim:
        # it has waited where a cluster called it again while the call that it took for lost went on
        refuse_earlier(settings_file)
        if is_done():
            return
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
