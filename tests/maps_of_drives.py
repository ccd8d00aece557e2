"""Maps of several drives: how tests make them, and what of them must not depend on how they came to be."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from street_drives import Drives

from gnss_sem_map.config import Settings
from gnss_sem_map.runs.many_drives import HowMapped, ManyDrives, run_drives
from gnss_sem_map.segmentation import DEMO_CALIBRATION

# with a file that they name: each result has a copy of its own; `test_classifying.py` has the classifiers of drives
CHOSEN = (f"calibration={DEMO_CALIBRATION}", "geometric_classifier.enabled=false")
SETTINGS = Settings().changed(*CHOSEN)
OF_MOMENT = ("run.json", "report.html")
"""Files of a drive that hold times and memory."""


def products(out: Path) -> dict[str, bytes]:
    """What must not depend on how a map came to be: every file but the list of files and times of the drives."""
    files = {path.relative_to(out).as_posix(): path for path in out.rglob("*") if path.is_file()}
    return {
        name: path.read_bytes()
        for name, path in files.items()
        if path.name != ".gnss-sem-map.json" and not (name.startswith("drives/") and path.name in OF_MOMENT)
    }


def assert_same(a: Path, b: Path) -> None:
    found, expected = products(a), products(b)
    assert found.keys() == expected.keys()
    assert [name for name in found if found[name] != expected[name]] == []


def mapped(names: str, drives: Drives, out: Path, how: HowMapped) -> ManyDrives:
    return run_drives([drives.by_name[name] for name in names], out, SETTINGS, how)


def run_of(places: Sequence[Path | str], drives: Drives, out: Path, *more: str | Path) -> list[str | Path]:
    chosen = [word for setting in CHOSEN for word in ("--set", setting)]
    return ["run", *places, "--segmenter", drives.labels, *chosen, "--force", "-o", out, *more]
