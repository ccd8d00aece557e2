"""Runs of the small street, and the files that they make."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from gnss_sem_map import Run, Settings
from gnss_sem_map.runs import finished_run

MADE_ANEW = {"run.json", "report.html", ".gnss-sem-map.json"}
"""They say how long it took."""
FEW_ROWS = Settings().changed("geometric_classifier.rows_per_fold=1000")
"""The classifier of each run is soon trained."""


def run(drive: Path, out: Path, segmenter: str = "none", settings: Settings = FEW_ROWS, **more: Any) -> Run:
    return finished_run.run(drive, out, segmenter, settings, **more)


def files(folder: Path) -> dict[str, bytes]:
    found = (path for path in folder.rglob("*") if path.is_file() and path.name not in MADE_ANEW)
    return {str(path.relative_to(folder)): path.read_bytes() for path in found}
