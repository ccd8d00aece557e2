"""check.html: the findings of the pre-flight check on one page."""

from __future__ import annotations

import os
from pathlib import Path

from gnss_sem_map.errors import DataError
from gnss_sem_map.export.page import page as html_page
from gnss_sem_map.files.atomic import replacing
from gnss_sem_map.files.untrusted import open_file
from gnss_sem_map.preflight.findings import Level, Preflight

SUMMARIES = {
    Level.GREEN: "No check found a fault in this drive.",
    Level.AMBER: "Some checks are amber: read them before you trust the map.",
    Level.RED: "A run stops here: the red findings would make a wrong map. Correct them, or run with --force.",
}
GENERATOR = b'<meta name="generator" content="gnss-sem-map">'
HEAD_BYTES = 2000
"""So much of a page is read to know it: another file may be a large one."""


def check_writable(path: Path) -> None:
    """Raise DataError when `path` exists and is not a page of ours."""
    if path.is_dir():
        raise DataError(f"{path}: is a folder, expected a file to write; choose another -o")
    if not path.exists():
        return
    with os.fdopen(open_file(path), "rb", buffering=0) as file:  # refuses pipes and devices
        head = file.read(HEAD_BYTES)
    if GENERATOR not in head:
        raise DataError(f"{path}: exists and is no page of gnss-sem-map; choose another -o or move it away")


def write_check_page(path: Path, name: str, page: Preflight) -> None:
    """Write the findings of a drive as one self-contained page, replacing an earlier one; raises DataError."""
    check_writable(path)
    content = html_page(
        "check.html.j2",
        title=f"Pre-flight of {name}",
        facts=f"{SUMMARIES[page.level]} Checked in {page.seconds:.1f} s.",
        findings=page.as_dict()["findings"],
    )
    with replacing(path) as file:
        file.write(content)
