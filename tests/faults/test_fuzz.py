"""Whatever a file holds, a reader gives its content or one of our own errors, in a second and half a gigabyte."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from faults.fuzzing import LONGEST_S, MOST_MB, fuzz
from faults.readers import READERS

QUICK, WHOLE = 40, 2000


@pytest.fixture(scope="module")
def table() -> Iterator[list[str]]:
    """What was measured, one line for each reader; printed at the end where pytest shows output (-s)."""
    lines: list[str] = []
    yield lines
    print(*sorted(lines), sep="\n")  # noqa: T201


def _check(name: str, first: int, count: int, trial, table: list[str], folder: Path) -> None:
    report = fuzz(READERS[name], name, first, count, folder)
    table.append(
        f"| {name} | {report.inputs} | {report.refused} | {report.slowest_s:.2f} s | {report.peak_mb:.0f} MB |"
    )
    trial("fuzzing", report.faults[:10])
    assert report.slowest_s <= LONGEST_S
    assert report.peak_mb <= MOST_MB


@pytest.mark.parametrize("name", READERS)
def test_some_damaged_files_are_read_or_refused(name: str, trial, table: list[str], tmp_path: Path) -> None:
    _check(name, 0, QUICK, trial, table, tmp_path)


@pytest.mark.faults
@pytest.mark.parametrize("name", READERS)
def test_many_damaged_files_are_read_or_refused(name: str, trial, table: list[str], tmp_path: Path) -> None:
    _check(name, QUICK, WHOLE, trial, table, tmp_path)
