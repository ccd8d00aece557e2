"""check.html: the findings of the pre-flight check on one page."""

from __future__ import annotations

from pathlib import Path

from gnss_sem_map.errors import DataError
from gnss_sem_map.evaluation.preflight.findings import Level, Preflight
from gnss_sem_map.export.page import page as html_page
from gnss_sem_map.files.atomic import replacing

SUMMARIES = {
    Level.GREEN: "No check found a fault in this drive.",
    Level.AMBER: "Some checks are amber: read them before you trust the map.",
    Level.RED: "A run stops here: the red findings would make a wrong map. Correct them, or run with --force.",
}
GENERATOR = b'<meta name="generator" content="gnss-sem-map">'


def check_writable(path: Path) -> None:
    """Raise DataError when `path` exists and is not a page of ours."""
    if path.is_dir():
        raise DataError(f"{path}: is a folder, expected a file to write; choose another -o")
    if path.exists() and GENERATOR not in path.read_bytes()[:2000]:
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
