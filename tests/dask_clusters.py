"""Dask clusters that tests start: a scheduler and workers in processes of their own, as users have them."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from processes import wait_until

TESTS = Path(__file__).parent
IN_TIME_S = 600.0
"""In which a worker is there on any machine."""


@contextmanager
def two_workers(folder: Path) -> Iterator[str]:
    """The address of a scheduler with two workers of one thread, which are there; their logs are in the folder."""
    from distributed import Client

    file = folder / "scheduler.json"
    with started("scheduler", file, "--port", "0", "--dashboard-address", ":0"):
        assert wait_until(file.exists)
        with started("worker", file, "--nthreads", "1", "--nworkers", "2", "--no-dashboard"):
            address = json.loads(file.read_text())["address"]
            with Client(address, timeout=IN_TIME_S) as client:
                client.wait_for_workers(2, IN_TIME_S)
            yield address


@contextmanager
def started(what: str, scheduler_file: Path, *words: str) -> Iterator[subprocess.Popen[bytes]]:
    """A `dask scheduler` or `dask worker`, killed with all its processes at the end."""
    command = [sys.executable, "-m", f"distributed.cli.dask_{what}", "--scheduler-file", str(scheduler_file)]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(TESTS), *sys.path])}
    with (scheduler_file.parent / f"{what}.log").open("wb") as log:
        process = subprocess.Popen(
            [*command, *words], env=environment, start_new_session=True, stdout=log, stderr=log
        )
        try:
            yield process
        finally:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
