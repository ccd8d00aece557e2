"""What this process may use of the machine, and what it uses: cores and memory."""

from __future__ import annotations

import os
import resource
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from threadpoolctl import threadpool_limits

if TYPE_CHECKING:
    import psutil

THREADS_VARIABLE = "GNSS_SEM_MAP_THREADS"
"""Environment variable: threads of one process. Several processes of one machine share its cores by it."""
BLAS_THREADS_VARIABLE = "OPENBLAS_NUM_THREADS"
"""Environment variable: threads of matrix products in a process that starts with it."""
CONTAINER_MEMORY = Path("/sys/fs/cgroup/memory.max")
"""Bytes that this container may use, or "max"."""


def cores() -> int:
    """Cores that this process may use: a batch system or `taskset` may give it fewer than the machine has."""
    if hasattr(os, "sched_getaffinity"):  # not on macOS
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def threads() -> int:
    """Threads that this process should use at a time: what the variable says, else one per core that it may use."""
    said = os.environ.get(THREADS_VARIABLE, "")
    return int(said) if said.isdecimal() and int(said) else cores()


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """While it lasts, BLAS uses one thread: with more, the last bits of a product depend on the number of cores.

    Found where six drives were bound: the last bits of their covariances differed on one core and on two. Our matrices
    are small, and threads wait for each other by spinning: to bind four drives took several times as long with two.
    """
    with threadpool_limits(1, "blas"):
        yield


def memory_bytes() -> int:
    """Memory of this machine, or of the container that this is."""
    memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    try:
        return min(memory, int(CONTAINER_MEMORY.read_text()))
    except (OSError, ValueError):  # no container, or one without a limit
        return memory


def held_bytes(pid: int | None = None) -> int:
    """Physical memory of a process, by default of this one; 0 of one that has ended."""
    import psutil

    try:
        return int(_process(os.getpid() if pid is None else pid).memory_info().rss)
    except psutil.NoSuchProcess:
        return 0


@lru_cache(64)
def _process(pid: int) -> psutil.Process:
    """A process, made once: memory is asked for after every scan, and a new one would read when it was started, too."""
    import psutil

    return psutil.Process(pid)


def most_held_bytes() -> int:
    """The most physical memory that this process has had."""
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
