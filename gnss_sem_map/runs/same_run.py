"""Whether a folder holds already what a command is to make: then an interrupted one has nothing left to do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from factor_graphs.errors import FactorGraphError
from factor_graphs.geodesy import LocalFrame
from gnss_sem_map.config import Settings
from gnss_sem_map.errors import SemMapError
from gnss_sem_map.files import ownership
from gnss_sem_map.files.run_json import read_run
from gnss_sem_map.files.untrusted import is_file, is_folder
from gnss_sem_map.files.work_folder import DRIVES
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.mapping import fingerprints
from gnss_sem_map.mapping.refining import REFINED
from gnss_sem_map.runs.point_label_files import has_point_labels
from gnss_sem_map.runs.run_settings import differing, read_settings
from gnss_sem_map.runs.source import Source
from gnss_sem_map.sensor_log import SensorLog


def digest_of(log: SensorLog, source: Source, settings: Settings) -> str:
    """Digest of all that is read of a drive, for its run.json."""
    return fingerprints.of_log(log, source.labels_from, open_label_set(settings.classes))


def is_made_from(
    folder: Path,
    source: Source,
    settings: Settings,
    frame: LocalFrame | None,
    read: str,
    correction: str | None = None,
) -> bool:
    """Whether a folder holds this drive, mapped from the same inputs in the same way.

    `read` is its digest; `correction` that of how it is bound to other drives, which is not looked at without.
    """
    if not is_file(folder / "run.json"):
        return False
    try:
        about = read_run(folder)
        same = about["inputs"] == source.inputs and about["read"] == read
        same = same and about["local_frame"] == (None if frame is None else asdict(frame))
        same = same and correction in (None, about.get("correction"))
        return bool(same and not differing(read_settings(folder), settings))
    except (SemMapError, KeyError):
        return False


def is_run_of(
    out: Path, source: Source, settings: Settings, frame: LocalFrame | None, read: str, write_labels: bool
) -> bool:
    """Whether a folder holds the whole map of this drive alone, with point labels just if they are to be written.

    `read` is the digest of the drive.
    """
    return (
        _is_whole(out, write_labels)
        and is_folder(out / REFINED)
        and not is_folder(out / DRIVES)
        and is_made_from(out, source, settings, frame, read)
    )


def is_map_of(
    out: Path, sources: Sequence[Source], settings: Settings, frame: LocalFrame, write_labels: bool
) -> bool:
    """Whether a folder holds the whole map of these drives, none of which failed; point labels as in `is_run_of`."""
    if not _is_whole(out, write_labels):
        return False
    try:
        about = read_run(out)
        names = sorted(source.name for source in sources)
        if about.get("failed") or about.get("aligned_to") or about.get("merged") != names:
            return False
        return all(
            is_made_from(
                out / DRIVES / one.name, one, settings, frame, digest_of(one.open_log(), one, settings)
            )
            for one in sources
        )
    except (SemMapError, FactorGraphError, OSError):
        return False


def _is_whole(out: Path, write_labels: bool) -> bool:
    """Whether a folder holds a whole result, with point labels just if they are to be written."""
    return is_file(out / "run.json") and has_point_labels(out) == write_labels and ownership.is_whole(out)
