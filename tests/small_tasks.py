"""Functions that tests call as tasks, in processes that end, die, grow or hang as the test wants."""

from __future__ import annotations

import errno
import os
import signal
import time
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_info

from gnss_sem_map.errors import DataError, WriteError
from gnss_sem_map.process.execution import attempt
from gnss_sem_map.process.machine import threads


def times(a: float, b: float) -> float:
    """A result."""
    return a * b


def echo(*values: object) -> list[object]:
    """What arrived."""
    return list(values)


def process_and_threads(folder: str) -> list[int]:
    """Who works, and with how many threads; the file in the folder says that it has begun."""
    (Path(folder) / f"{os.getpid()}").touch()
    time.sleep(0.05)
    return [os.getpid(), threads(), int(os.environ.get("NUMBA_NUM_THREADS", 0))]


def blas_threads() -> list[int]:
    """Threads of every BLAS that is loaded, that of numpy at least."""
    np.dot(1.0, 1.0)
    return [about["num_threads"] for about in threadpool_info() if about["user_api"] == "blas"]


def _attempt(folder: str) -> int:
    """The number of this attempt, from 1."""
    number = 1 + len(list(Path(folder).iterdir()))
    (Path(folder) / f"{number}").touch()
    return number


def dies(folder: str, number: int, attempts: int) -> str:
    """Dies by this signal in its first attempts."""
    if _attempt(folder) <= attempts:
        os.kill(os.getpid(), number)
        time.sleep(60)
    return "survived"


def exits(code: int) -> None:
    """Ends the process."""
    os._exit(code)


def grows(folder: str, attempts: int, step_bytes: int) -> str:
    """Takes ever more memory in its first attempts."""
    if _attempt(folder) <= attempts:
        held = []
        for _ in range(200):
            held.append(b"x" * step_bytes)
            time.sleep(0.02)
    return "modest"


def has_no_memory(folder: str, attempts: int) -> str:
    """Is refused memory in its first attempts."""
    if _attempt(folder) <= attempts:
        raise MemoryError
    return "modest"


def hangs(folder: str, attempts: int) -> str:
    """Never ends in its first attempts."""
    if _attempt(folder) <= attempts:
        time.sleep(600)
    return "ended"


def begins_and_waits(folder: str) -> None:
    """Says that it began, and hangs."""
    (Path(folder) / f"{os.getpid()}").touch()
    signal.pause()


def waits_for_go(folder: str) -> None:
    """Says that it began, and that it ended, which it does when the folder holds `go`."""
    own = Path(folder) / f"{os.getpid()}"
    own.touch()
    while not (Path(folder) / "go").exists():
        time.sleep(0.02)
    own.with_suffix(".ended").touch()


def is_wrong(kind: str) -> None:
    """Raises an error."""
    if kind == "os":
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "/full/disk")
    if kind == "defect":
        raise KeyError("no such thing")
    raise {"data": DataError, "write": WriteError}[kind](f"{kind}: wrong; change it")


def fails(how: str) -> str:
    """Says why it failed, as the mapping of a drive does."""
    return str(attempt("small_tasks:is_wrong", [how], "small_tasks.")["failed"])


def dies_once(folder: str) -> bool:
    """Kill the process of the first that makes the folder."""
    try:
        os.mkdir(folder)
    except FileExistsError:
        return True
    os.kill(os.getpid(), signal.SIGKILL)
    return False
