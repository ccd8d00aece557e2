"""Processes that tests start: whether they are alive, and waiting for them."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path


def is_alive(pid: int) -> bool:
    """Whether a process runs."""
    return _state_and_group(pid)[0] not in "ZX"


def group(leader: int) -> list[int]:
    """Processes of a group that are alive."""
    pids = [int(folder.name) for folder in Path("/proc").iterdir() if folder.name.isdecimal()]
    return [pid for pid in pids if _state_and_group(pid)[1] == leader and is_alive(pid)]


def _state_and_group(pid: int) -> tuple[str, int]:
    """The state of a process, X when it is gone, and its group."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return "X", 0
    return fields[0], int(fields[2])


def wait_until(condition: Callable[[], object], within_s: float = 600.0) -> bool:
    """Wait until something is true; whether it became true in a time in which it does on any machine."""
    end = time.monotonic() + within_s
    while time.monotonic() < end:
        if condition():
            return True
        time.sleep(0.05)
    return False
