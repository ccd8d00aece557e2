"""Files of results: figures by part, and for each part the machine and the code that it was measured with."""

from __future__ import annotations

import json
import os
import platform
import subprocess
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

MADE_BY = "made by"
RESULTS = Path(__file__).resolve().parent / "results"


def keep(file: Path, parts: Mapping[str, Any], *packages: str) -> None:
    """Write parts of the results into a JSON file, with what they were made by; parts that are there already stay.

    `packages` are named with their versions.
    """
    known = json.loads(file.read_text("utf-8")) if file.exists() else {}
    made = known.pop(MADE_BY, {}) | dict.fromkeys(parts, made_by(*packages))
    known |= parts
    if set(known) - {"machine"} <= set(made):  # of results that were written before
        known.pop("machine", None)
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps({MADE_BY: made} | known, indent=1, default=float) + "\n", "utf-8")


def made_by(*packages: str) -> str:
    """Processor, cores, versions and commit, in words."""
    versions = [f"{name} {version(name)}" for name in packages]
    machine = f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}"
    return ", ".join([machine, *versions, f"commit {_commit()}"])


def _commit() -> str:
    """The commit that is checked out, and whether files other than results were changed since."""
    commit = _git("rev-parse", "--short", "HEAD")
    changed = _git(
        "status", "--porcelain", "--untracked-files=no", "--", ":/", ":(exclude,top)benchmarks/results"
    )
    return f"{commit} with changes" if commit and changed else commit or "not known"


def _git(*words: str) -> str:
    asked = ["git", "-C", str(Path(__file__).parent), *words]
    return subprocess.run(asked, capture_output=True, text=True, check=False).stdout.strip()
