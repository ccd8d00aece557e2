"""Whatever a file holds, a reader gives its content or one of our own errors, in a second and half a gigabyte."""

from __future__ import annotations

from pathlib import Path

import pytest
from faults.fuzzing import fuzz
from faults.readers import READERS

QUICK, WHOLE = 20, 2000


@pytest.mark.parametrize(
    ("first", "count"),
    [(0, QUICK), pytest.param(QUICK, WHOLE, marks=pytest.mark.faults)],
    ids=["some", "many"],
)
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (n % 8 > 0)) for n, name in enumerate(READERS)]
)
def test_damaged_files_are_read_or_refused(name: str, first: int, count: int, trial, tmp_path: Path) -> None:
    report = fuzz(READERS[name], name, first, count, tmp_path)
    figures = f"{report.inputs} | {report.refused} | {report.slowest_s:.2f} s | {report.peak_mb:.0f} MB"
    print(f"\n| {name} | {figures} |")  # noqa: T201 (a table, where pytest shows output: -s)
    trial("fuzzing", report.faults[:10])
