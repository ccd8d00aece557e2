"""The drives whose evidence the map of a run holds, so that none counts twice."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from gnss_sem_map.errors import DataError
from gnss_sem_map.files.run_json import read_run
from gnss_sem_map.files.untrusted import is_folder, shown
from gnss_sem_map.files.work_folder import DRIVES

HELD = "made_of"
"""In run.json of a map of `merge`, which keeps no folders of drives: a list of `_of_run`."""


def held_drives(run: Path) -> list[dict[str, Any]]:
    """Name, folder and time of all drives in the map of a run; nothing of those that an older `merge` did not note."""
    about = read_run(run)
    if is_folder(run / DRIVES):
        return [_of_run(read_run(part)) for part in sorted((run / DRIVES).iterdir())]
    if "merged" in about:
        held = about.get(HELD, [])
        if not isinstance(held, list) or not all(isinstance(one, dict) for one in held):
            raise DataError(f"{shown(run / 'run.json')}: damaged ({HELD}: expected a list of drives)")
        return held
    return [_of_run(about)]


def check_none_twice(first: Path, second: Path) -> None:
    """Raise DataError when a drive, or a part of one, is in the maps of both runs."""
    known = held_drives(first)
    for drive in held_drives(second):
        if any(_is_same(drive, other) for other in known):
            raise DataError(
                f"{shown(second)}: the drive {drive.get('drive')} is in {shown(first)} too, and all evidence of one"
                " drive counts once; merge runs of other drives, or take it out of one with `gnss-sem-map remove`"
            )


def _of_run(about: dict[str, Any]) -> dict[str, Any]:
    inputs = about.get("inputs")
    place = inputs.get("drive") if isinstance(inputs, dict) else None
    return {"place": place} | {name: about.get(name) for name in ("drive", "epoch_ns", "scans_s")}


def _is_same(one: dict[str, Any], other: dict[str, Any]) -> bool:
    """Whether two have scans in common: they are of one folder and time, or copies, of one name and the same times.

    Drives of one name in different folders may differ, and so may two parts (`--frames`) of one drive.
    """
    if one.get("place") is not None and one.get("place") == other.get("place"):
        return _overlap(one.get("scans_s"), other.get("scans_s"))
    names = ("drive", "epoch_ns", "scans_s")
    return all(one.get(name) is not None and one.get(name) == other.get(name) for name in names)


def _overlap(one: Any, other: Any) -> bool:
    """Whether two spans of time, s, do; also where a damaged or older run does not say one of them."""
    try:
        (start, end), (other_start, other_end) = one, other
        return bool(start <= other_end and other_start <= end)
    except (TypeError, ValueError):
        return True
