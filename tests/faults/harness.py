"""A command in a process of its own, watched: its exit code, its output, its time, its memory, and what it left behind.

Processes are forked from a server that has imported the package already, so that a trial costs no start of Python.
"""

from __future__ import annotations

import multiprocessing
import os
import resource
import signal
import sys
import time
import traceback
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.synchronize import Event
from pathlib import Path

PRELOAD = [
    "gnss_sem_map.cli.commands",
    "gnss_sem_map.runs.pipeline",
    "gnss_sem_map.runs.run_folder",
    "gnss_sem_map.datasets.kitti_raw",
    "gnss_sem_map.datasets.kitti_odometry",
    "gnss_sem_map.datasets.csv_log",
    "gnss_sem_map.segmentation.cached",
    "laspy",
    "matplotlib.backends.backend_agg",
    "matplotlib.figure",
    "pyarrow.parquet",
    "rasterio",
]
TIMEOUT_S = 900.0
"""Only what hangs takes so long; the first run after an installation compiles everything."""
OUR_CODES = {0, 1, 2, 129, 130, 143}


@dataclass(frozen=True)
class Outcome:
    """How a command ended."""

    arguments: tuple[str, ...]
    code: int | None
    """None: it did not end in time, and was killed; negative: the signal that ended it."""
    out: str
    err: str
    seconds: float
    peak_mb: float
    left: tuple[str, ...]
    """What it left in its TMPDIR."""
    orphans: bool = False
    """Whether processes that it started live on."""

    @property
    def faults(self) -> list[str]:
        """What no command may ever do, whatever its input: empty for an honest end."""
        found = []
        if self.code is None:
            found.append(f"hang: not done after {self.seconds:.0f} s")
        elif self.code not in OUR_CODES:
            found.append(f"exit code {self.code}")
        if "Traceback" in self.err or "Traceback" in self.out:
            found.append("traceback")
        lines = [line for line in self.err.splitlines() if not line.startswith("warning: ")]
        if self.code in OUR_CODES - {0} and len(lines) != 1:
            found.append(f"{len(lines)} lines on stderr, expected 1")
        if self.left:
            found.append(f"left in TMPDIR: {self.left}")
        if self.orphans:
            found.append("processes left")
        return found

    def __str__(self) -> str:
        return (
            f"{' '.join(self.arguments)}\n  code {self.code} after {self.seconds:.1f} s\n  {self.err[-1500:]}"
        )


def gnss_sem_map(
    *arguments: str | Path,
    folder: Path,
    timeout_s: float = TIMEOUT_S,
    memory_mb: int | None = None,
    cwd: Path | None = None,
    interrupt: tuple[float, signal.Signals] | None = None,
    file_mb: float | None = None,
    user: int | None = None,
    stdout: Path | None = None,
) -> Outcome:
    """Run a command; `folder` is where its output and its TMPDIR go, a new one for each trial.

    `memory_mb` limits its address space, `file_mb` every file that it writes (as if the disk were full there); the
    seconds of `interrupt` after it begins, it and all that it started get that signal; `user` is whose rights it has.
    """
    folder.mkdir(parents=True, exist_ok=True)
    temporary = folder / "tmp"
    temporary.mkdir(exist_ok=True)
    words = tuple(map(str, arguments))
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(PRELOAD)
    ready = context.Event()
    start = time.perf_counter()
    process = context.Process(
        target=_child, args=(words, folder, temporary, memory_mb, cwd, file_mb, user, stdout, ready)
    )
    process.start()
    if interrupt is not None and ready.wait(
        timeout_s
    ):  # before, there is no group of processes, and nothing to stop
        process.join(interrupt[0])
        if process.exitcode is None:
            os.killpg(process.pid or 0, interrupt[1])
    process.join(timeout_s)
    code = process.exitcode
    if code is None:
        os.killpg(process.pid or 0, signal.SIGKILL)
        process.join()
    peak = folder / "peak"
    return Outcome(
        words,
        code,
        (folder / "out").read_text(errors="replace"),
        (folder / "err").read_text(errors="replace"),
        time.perf_counter() - start,
        float(peak.read_text() or 0.0) if peak.exists() else 0.0,
        tuple(sorted(path.name for path in temporary.iterdir())),
        _lives(process.pid or 0),
    )


def _lives(group: int, within_s: float = 3.0) -> bool:
    """Whether some process of a group is still there; one that is ending has a moment for it."""
    end = time.monotonic() + within_s
    while time.monotonic() < end:
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return False
        time.sleep(0.05)
    os.killpg(group, signal.SIGKILL)
    return True


def _child(
    arguments: tuple[str, ...],
    folder: Path,
    temporary: Path,
    memory_mb: int | None,
    cwd: Path | None,
    file_mb: float | None,
    user: int | None,
    stdout: Path | None,
    ready: Event,
) -> None:
    os.setsid()
    (folder / "out").touch()
    for number, path in ((1, stdout or folder / "out"), (2, folder / "err")):
        os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
    sys.stdout, sys.stderr = os.fdopen(1, "w"), os.fdopen(2, "w", buffering=1)
    os.environ["TMPDIR"] = str(temporary)
    if cwd is not None:
        os.chdir(cwd)
    if memory_mb is not None:
        resource.setrlimit(resource.RLIMIT_AS, (memory_mb << 20, memory_mb << 20))
    if file_mb is not None:
        limit = int(file_mb * (1 << 20))
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
    if user is not None:
        os.chown(temporary, user, user)
        os.setgroups([])
        os.setgid(user)
        os.setuid(user)
    sys.argv = ["gnss-sem-map", *arguments]
    code: int | str | None = 0
    try:
        from gnss_sem_map.cli import main
        from gnss_sem_map.cli.signals import SIGNALS, stop_on_signals

        for number in SIGNALS:  # where the tests run in the background, or under `nohup`, they are ignored
            signal.signal(number, signal.SIG_DFL)
        stop_on_signals()
        ready.set()
        main()
    except SystemExit as end:
        code = end.code
    except BaseException:  # noqa: BLE001 (whatever escapes is what is looked for)
        traceback.print_exc()
        code = 99
    finally:
        with suppress(OSError):
            sys.stdout.flush()
            (folder / "peak").write_text(str(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024))
    os._exit(code if isinstance(code, int) else 1 if code else 0)
