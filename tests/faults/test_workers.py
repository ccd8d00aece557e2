"""Processes that map: one that dies is an error in one line, and none outlives the command that started it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from faults.killing import street_drive
from processes import group, wait_until
from street import Street

from gnss_sem_map.errors import DataError
from gnss_sem_map.process.worker_processes import Processes
from gnss_sem_map.runs import pipeline
from gnss_sem_map.runs.drive_job import job_for
from gnss_sem_map.runs.map_job import MapJob
from gnss_sem_map.runs.source import source_of

pytestmark = pytest.mark.faults
"""`mapping/test_execution.py` states the same of small tasks, at every commit."""

UNGUARDED = """
import sys
import gnss_sem_map

drive, labels, out = sys.argv[1:]
settings = gnss_sem_map.Settings(dynamics={"window_scans": 2})
if True:
    gnss_sem_map.run(drive, out, f"labels:{labels}", settings, workers=2, force=True)
"""
GUARDED = UNGUARDED.replace("if True:", "if __name__ == '__main__':")
DEADLY = """
import os, signal

def look(pixels):
    os.kill(os.getpid(), signal.SIGKILL)

look.class_names = ["road", "other"]
"""


def start(script: str, street: Street, folder: Path) -> subprocess.Popen[str]:
    file = folder / "script.py"
    file.write_text(script)
    words = [sys.executable, file, street.drive, street.labels, folder / "out"]
    pipe = subprocess.PIPE
    return subprocess.Popen(words, stdout=pipe, stderr=pipe, text=True, start_new_session=True)


def test_a_script_without_a_guard_gets_an_error_and_does_not_hang(small_drive, trial, tmp_path: Path) -> None:
    process = start(UNGUARDED, small_drive, tmp_path)
    try:
        _, err = process.communicate(timeout=600)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        trial("workers", ["hang"])
    told = next((line for line in err.splitlines() if "given up after" in line), "")
    faults = ["not explained"] * ("a worker process died" not in told or "__main__" not in told)
    trial("workers", [*faults, *["orphans"] * (not wait_until(lambda: not group(process.pid)))], err)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_workers_end_when_their_parent_is_killed(
    small_drive, number: signal.Signals, trial, tmp_path: Path
) -> None:
    with start(GUARDED, small_drive, tmp_path) as process:
        begun = wait_until(lambda: len(group(process.pid)) > 2)
        process.send_signal(number)
    orphans = not wait_until(lambda: not group(process.pid), 120.0)
    trial("workers", ["never began"] * (not begun) + ["orphans"] * orphans)


def test_a_worker_that_is_killed_again_and_again_is_an_error_in_one_line(
    small_drive, trial, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "deadly_network.py").write_text(DEADLY)
    monkeypatch.syspath_prepend(tmp_path)
    settings = street_drive(small_drive.drive, small_drive.labels).settings
    labels = source_of(small_drive.drive, f"labels:{small_drive.labels}")
    run = MapJob(settings, None, tmp_path, Processes(2), is_one=True)
    with pytest.raises(
        DataError, match=r"chunks \d to \d: given up after 3 attempts: 3 x a worker process died"
    ):
        pipeline.bound_and_mapped(
            [job_for(replace(labels, segmenter="python:deadly_network:look"), run, True)], run
        )
    trial("workers")
