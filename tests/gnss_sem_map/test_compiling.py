"""Compiled code that is kept on disk is that of the function, whatever happened while it was saved."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

FUNCTION = """
from gnss_sem_map.compiling import njit

@njit(cache=True)
def times(x):
    return {factor} * x
"""
CALLED = """
import os, signal, sys

def look(event, details):
    if event == "os.rename" and os.fsdecode(details[1]).endswith(".nbc"):  # the code is put away
        os.kill(os.getpid(), signal.SIGKILL)

if sys.argv[1:]:
    sys.addaudithook(look)
from function import times
print(times(1))
"""


@pytest.mark.integration
def test_code_of_an_earlier_version_is_not_called_where_a_process_was_killed(tmp_path: Path) -> None:
    def called(*words: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-c", CALLED, *words]
        return subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)

    (tmp_path / "function.py").write_text(FUNCTION.format(factor=1))
    assert called().stdout == "1\n"
    (tmp_path / "function.py").write_text(FUNCTION.format(factor=20))
    assert called("killed").returncode < 0
    assert called().stdout == "20\n"
