"""Compile the kernels of a run before they are called: `python -m gnss_sem_map.cli.compile_ahead`.

A kernel is compiled when it is first called with arguments of new types, and kept on disk. For a run, that takes half a
minute of one core, once per installation. `kernels.txt` lists them; `benchmarks/kernels.py` writes it.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from gnss_sem_map.cli.logs import STAGES
from gnss_sem_map.process.machine import cores

if TYPE_CHECKING:
    from numba.core.dispatcher import Dispatcher
    from numba.core.types import Type

LIST = Path(__file__).with_name("kernels.txt")
"""Of every kernel a line: module, name, and the types of its arguments as numba's signatures have them."""
LATE = (
    "gnss_sem_map.runs.finished_run",
    "jinja2",
    "laspy",
    "matplotlib.backends.backend_agg",
    "matplotlib.patheffects",
    "pandas",
    "rasterio.features",
    "shapely",
)
"""What a run imports when it needs it, and Python compiles at the first import."""


def listed_kernels() -> Iterator[tuple[Dispatcher, tuple[Type, ...]]]:
    """The kernels of `LIST`, each with the types of its arguments."""
    from numba.core.sigutils import normalize_signature

    for line in LIST.read_text("utf-8").splitlines():
        module, name, types = line.split(" ", 2)
        yield getattr(import_module(module), name), normalize_signature(f"({types},)")[0]


def compile_kernels() -> None:
    """Compile the kernels of `LIST`; those that are on disk are loaded, which takes a second for all."""
    for kernel, types in listed_kernels():
        kernel.compile(types)


def compile_modules() -> None:
    """Import what is imported late."""
    for module in LATE:
        import_module(module)


@contextmanager
def compiling_ahead() -> Iterator[subprocess.Popen[str] | None]:
    """Compile the kernels in a second process meanwhile, which is stopped at the end; on one core there is none.

    In one process numba compiles one kernel at a time, and the other cores wait. A demo with nothing compiled takes
    148 s in place of 182 s on 2 cores.
    """
    if cores() == 1:
        yield None
        return
    command = [sys.executable, "-m", __name__]
    with subprocess.Popen(command, stdin=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as compiler:
        try:
            yield compiler
        finally:
            if compiler.poll() is None:
                compiler.terminate()
            elif compiler.returncode > 0 and compiler.stderr is not None:
                reason = compiler.stderr.read().strip().rpartition("\n")[2]
                STAGES.warning("kernels are compiled when called, not ahead: %s", reason)


if __name__ == "__main__":
    compile_kernels()
    compile_modules()
