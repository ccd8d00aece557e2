"""The fault campaign counts its trials; the summary says how many there were of each kind, and what went wrong."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest
import street
from faults.drive_files import small_street
from made_once import made_once

TRIALS: Counter[str] = Counter()


@pytest.fixture
def trial(request: pytest.FixtureRequest) -> Callable[..., None]:
    """Count one trial of a kind, and fail with all its faults when it has some: `trial("rights", faults, outcome)`."""

    def count(kind: str, faults: list[str] | None = None, about: object = "") -> None:
        request.node.user_properties.append(("trial", kind))
        assert not faults, f"{kind}: {'; '.join(faults or [])}\n{about}"

    return count


@pytest.fixture(scope="session")
def drives(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The same small street in three layouts."""

    def make(folder: Path) -> dict[str, Path]:
        made = small_street(folder / "kitti")
        return {
            "kitti": made.drive,
            "odometry": street.write_odometry(folder / "odometry", made),
            "table": street.write_table_log(folder / "table", made),
        }

    return made_once(tmp_path_factory, "layouts", make)


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    # reports come from every process that runs tests: a counter in each of them would not
    if report.when == "call":
        TRIALS.update(str(kind) for what, kind in report.user_properties if what == "trial")


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    if TRIALS:
        kinds = ", ".join(f"{kind} {count}" for kind, count in sorted(TRIALS.items()))
        terminalreporter.write_line(f"fault campaign: {sum(TRIALS.values())} trials ({kinds})")
