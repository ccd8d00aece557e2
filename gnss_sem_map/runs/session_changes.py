"""What changed from drive to drive of a map: between each and the last one before it that it is bound to."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from gnss_sem_map.evaluation.changes import changes_between
from gnss_sem_map.export.changes import Change
from gnss_sem_map.files.run_json import read_run
from gnss_sem_map.files.work_folder import DRIVES
from gnss_sem_map.labels.label_set import LabelSet
from gnss_sem_map.mapping.passes import TwoPasses
from gnss_sem_map.mapping.raw_map import open_raw


def changes_in(
    folder: Path, parts: Sequence[Path], passes: Sequence[TwoPasses], label_set: LabelSet
) -> list[Change] | None:
    """What changed from each drive to the next one that is bound to it; None where no two drives are bound."""
    begun = {part.name: _begun(part) for part in parts}
    bound = [
        tuple(sorted((row.first, row.second), key=begun.__getitem__))
        for row in passes
        if row.bound and row.first != row.second and {row.first, row.second} <= begun.keys()
    ]
    if not bound:
        return None
    found: list[Change] = []
    for after in sorted({pair[1] for pair in bound}, key=begun.__getitem__):
        before = max((pair[0] for pair in bound if pair[1] == after), key=begun.__getitem__)
        first, second = (open_raw(folder / DRIVES / name, label_set) for name in (before, after))
        found += [Change(before, after, thing) for thing in changes_between(first, second)]
    return found


def _begun(drive: Path) -> tuple[int, str]:
    """When a drive began, ns; those of one moment are ordered by name."""
    about = read_run(drive)
    return int(about["epoch_ns"] or 0) + int(1e9 * about["scans_s"][0]), drive.name
