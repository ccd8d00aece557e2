"""What one process of the tests makes and all of them read: drives, and runs of these."""

from __future__ import annotations

import fcntl
import os
import pickle
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import pytest

T = TypeVar("T")


def made_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], T]) -> T:
    """What `make` gives for a folder of its own, read only; who asks first makes it, and others wait for it.

    What it gives is pickled; files stay in the folder.
    """
    base = factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:  # each has a folder in that of the session
        base = base.parent
    folder, given = base / name, base / f"{name}.pickle"
    with (base / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if given.exists():
            return pickle.loads(given.read_bytes())  # noqa: S301 (ours)
        shutil.rmtree(folder, ignore_errors=True)  # of one that failed
        folder.mkdir()
        made = make(folder)
        given.write_bytes(pickle.dumps(made))
        return made
