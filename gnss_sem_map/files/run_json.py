"""Reading run.json, which may be damaged or of another program."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from gnss_sem_map.errors import DataError
from gnss_sem_map.files.structured import read_json
from gnss_sem_map.files.untrusted import is_file, is_folder, shown
from gnss_sem_map.files.work_folder import DRIVES


def read_run(out: Path) -> dict[str, Any]:
    """The content of run.json; raises DataError where there is none, or a damaged one, or one of the former `merge`."""
    path = out / "run.json"
    if not is_file(path):
        raise DataError(
            f"{shown(path)}: no run folder here; expected the -o of an earlier `gnss-sem-map run`"
        )
    about = read_json(path)
    if "merged" in about and not is_folder(out / DRIVES):
        raise DataError(
            f"{shown(out)}: was merged by a version before this one, and keeps no drives; map them together with"
            " `gnss-sem-map run DRIVE DRIVE`"
        )
    return about


def inputs_of(out: Path) -> dict[str, str]:
    """What a run was made of, see `Source.inputs`, as far as its run.json names it; raises DataError."""
    inputs = read_run(out).get("inputs", {})
    if not isinstance(inputs, dict):
        raise DataError(f"{shown(out / 'run.json')}: damaged (inputs: found {type(inputs).__name__})")
    names = ("drive", "segmenter", "frames", "drive_format", "trajectory")
    found = {name: inputs[name] for name in names if inputs.get(name) is not None}
    wrong = [name for name, value in found.items() if not isinstance(value, str) or not value]
    if wrong:
        raise DataError(f"{shown(out / 'run.json')}: damaged (inputs: {wrong[0]} is no text)")
    return found
