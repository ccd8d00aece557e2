"""Wrong words on the command line are answered in one line."""

from __future__ import annotations

from pathlib import Path

import pytest
from faults.harness import gnss_sem_map


@pytest.mark.parametrize("words", [("run",), ("rnu",), ("run", "nowhere", "-o", "out"), ("check", "nowhere")])
def test_wrong_words_are_answered_in_one_line(words, trial, tmp_path: Path) -> None:
    outcome = gnss_sem_map(*words, folder=tmp_path)
    assert outcome.code in (1, 2)
    trial("arguments", outcome.faults, outcome)
