"""Kernels compiled ahead: on a new machine a short demo, in a process of its own, compiles what the long one will need.

Compiling takes a minute of one core, and the other cores are idle meanwhile; numba keeps the result on disk, where the
long demo finds it.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from gnss_sem_map.cli.demo import demonstrate
from gnss_sem_map.export import render
from gnss_sem_map.scans.prefetch import threads

SECONDS = 3.0
"""Of the short drive: long enough for moving objects to be followed."""
RENDER = Path(render.__file__)


@contextmanager
def compiled_ahead() -> Iterator[None]:
    """Within, kernels are compiled by another process, if there is a second core and none was compiled before.

    That process prints nothing, and ends with the context; what it did not come to is compiled when it is needed.
    """
    if threads() < 2 or _compiled_before():
        yield
        return
    with TemporaryDirectory(prefix="gnss-sem-map-") as folder:
        # spawned: a fork of a process with threads may hang
        process = multiprocessing.get_context("spawn").Process(
            target=_short_demo, args=(Path(folder),), daemon=True
        )
        process.start()
        try:
            yield
        finally:
            process.kill()
            process.join()


def _compiled_before() -> bool:
    """Whether numba has kept the kernels that draw the pictures, which are the last of a run."""
    kept = Path(os.environ.get("NUMBA_CACHE_DIR") or RENDER.parent)
    return any(kept.rglob(f"{RENDER.stem}.*.nbi"))


def _short_demo(folder: Path) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the main process, which ends this one
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), 1)
        os.dup2(nowhere.fileno(), 2)
    demonstrate(folder / "demo", SECONDS, source="corrupted")
