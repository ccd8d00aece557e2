"""Processes that map: one that dies is an error in one line, and none outlives the command that started it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from faults.killing import street_drive
from street import Street

from gnss_sem_map.errors import DataError
from gnss_sem_map.mapping.fusion import map_scans
from gnss_sem_map.mapping.labelled_scans import Drive
from gnss_sem_map.run_stats import RunStats

UNGUARDED = """
import sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from faults.killing import street_drive
from gnss_sem_map.run_stats import RunStats
from gnss_sem_map.errors import DataError
from gnss_sem_map.mapping.fusion import map_scans

try:
    map_scans(street_drive(Path(sys.argv[2]), Path(sys.argv[3])), Path(sys.argv[4]), RunStats(), workers=2)
except DataError as error:
    print(error)
"""
GUARDED = UNGUARDED.replace("try:", "if __name__ == '__main__':").replace(
    "except DataError as error:\n    print(error)", ""
)


def start(script: str, street: Street, folder: Path) -> subprocess.Popen[str]:
    file = folder / "script.py"
    file.write_text(script)
    tests = Path(__file__).parents[1]
    words = [sys.executable, file, tests, street.drive, street.labels, folder / "work"]
    pipe = subprocess.PIPE
    return subprocess.Popen(words, stdout=pipe, stderr=pipe, text=True, start_new_session=True)


def group(leader: int) -> list[int]:
    """Processes of a group that are alive."""
    found = []
    for folder in Path("/proc").iterdir():
        if folder.name.isdecimal():
            try:
                fields = (folder / "stat").read_text().rpartition(")")[2].split()
            except OSError:
                continue
            if int(fields[2]) == leader and fields[0] not in "ZX":
                found.append(int(folder.name))
    return found


def wait_until(condition, within_s: float = 30.0) -> bool:
    end = time.monotonic() + within_s
    while time.monotonic() < end:
        if condition():
            return True
        time.sleep(0.05)
    return False


def test_a_script_without_a_guard_gets_an_error_and_does_not_hang(small_drive, trial, tmp_path: Path) -> None:
    process = start(UNGUARDED, small_drive, tmp_path)
    try:
        out, _ = process.communicate(timeout=100)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        trial("workers", ["hang"])
    faults = ["not explained"] * ("a worker process died" not in out or "__main__" not in out)
    trial("workers", [*faults, *["orphans"] * (not wait_until(lambda: not group(process.pid)))], out)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_workers_end_when_their_parent_is_killed(
    small_drive, number: signal.Signals, trial, tmp_path: Path
) -> None:
    with start(GUARDED, small_drive, tmp_path) as process:
        begun = wait_until(lambda: len(group(process.pid)) > 2)
        process.send_signal(number)
    faults = ["never began"] * (not begun) + ["orphans"] * (
        not wait_until(lambda: not group(process.pid), 10.0)
    )
    trial("workers", faults)


class Deadly:
    """A segmenter that kills the process that asks it."""

    class_names = ("road", "other")

    def __call__(self, image: object) -> object:
        os.kill(os.getpid(), signal.SIGKILL)
        return None


def test_a_worker_that_is_killed_is_an_error_and_what_is_mapped_stays(
    small_drive, trial, tmp_path: Path
) -> None:
    drive = street_drive(small_drive.drive, small_drive.labels)
    deadly = Drive(drive.log, drive.trajectory, Deadly(), drive.settings)
    with pytest.raises(DataError, match="a worker process died"):
        map_scans(deadly, tmp_path / "work", RunStats(), workers=2)
    trial("workers")
