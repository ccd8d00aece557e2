"""What the tiers of tests promise: unit tests start nothing, and nothing that is declared present is skipped."""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import sys
from collections.abc import Callable

import pytest
from declared import DATA, absent

from gnss_sem_map.simulation import prepare


@pytest.mark.parametrize(
    ("act", "what"),
    [
        (lambda: subprocess.run([sys.executable, "-c", ""], check=True), "starts a process"),
        (lambda: multiprocessing.get_context("spawn").Process().start(), "starts a process"),
        (lambda: os.fork(), "starts a process"),
        (lambda: prepare(1.0, 0), "simulates a drive"),
    ],
)
def test_a_unit_test_fails_that_starts_a_process_or_simulates_a_drive(
    act: Callable[[], object], what: str
) -> None:
    with pytest.raises(pytest.fail.Exception, match=what):
        act()


@pytest.mark.integration
def test_an_integration_test_may() -> None:
    assert subprocess.run([sys.executable, "-c", ""], check=True).returncode == 0


def test_what_is_absent_is_skipped_but_not_where_it_is_declared_present(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv(DATA, raising=False)
    with pytest.raises(pytest.skip.Exception, match="no data"):
        absent(DATA, "no data")
    monkeypatch.setenv(DATA, "/nowhere")
    with pytest.raises(pytest.fail.Exception, match="no data; but GNSS_SEM_MAP_DATA=/nowhere declares"):
        absent(DATA, "no data")
