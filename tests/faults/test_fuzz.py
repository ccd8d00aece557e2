"""Whatever a file holds, a reader gives its content or one of our own errors, in a second and half a gigabyte."""

from __future__ import annotations

from pathlib import Path

import pytest
from faults.fuzzing import fuzz
from faults.readers import READERS

QUICK, WHOLE = 20, 2000


def _check(name: str, first: int, count: int, trial, folder: Path) -> None:
    report = fuzz(READERS[name], name, first, count, folder)
    figures = f"{report.inputs} | {report.refused} | {report.slowest_s:.2f} s | {report.peak_mb:.0f} MB"
    print(f"\n| {name} | {figures} |")  # noqa: T201 (a table, where pytest shows output: -s)
    trial("fuzzing", report.faults[:10])


@pytest.mark.parametrize("name", READERS)
def test_some_damaged_files_are_read_or_refused(name: str, trial, tmp_path: Path) -> None:
    _check(name, 0, QUICK, trial, tmp_path)


@pytest.mark.faults
@pytest.mark.parametrize("name", READERS)
def test_many_damaged_files_are_read_or_refused(name: str, trial, tmp_path: Path) -> None:
    _check(name, QUICK, WHOLE, trial, tmp_path)
