"""A signal ends the program wherever it arrives: where Python drops exceptions too, and where a lock is being taken."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.integration

PROGRAM = """
import ctypes, io, os, signal, threading, time, zipfile
from functools import partial
from operator import methodcaller
from types import SimpleNamespace
import numpy
from gnss_sem_map.cli.signals import Stopped, stop_on_signals

interrupt = partial(os.kill, os.getpid(), signal.SIGTERM)

class InFinalizer:
    def __del__(self):
        interrupt()

def in_a_callback():
    ctypes.CFUNCTYPE(None)(interrupt)()

def while_a_lock_is_taken():
    given_back = lambda *_: print("given back")
    lock = SimpleNamespace(acquire=None, release=None, __enter__=interrupt, __exit__=given_back)
    with threading.Condition(lock):
        pass

def while_a_member_is_opened():
    class Opened(zipfile.ZipInfo):
        interrupt = staticmethod(interrupt)
        compress_level = _compresslevel = property(methodcaller("interrupt"), lambda *_: None)

    with zipfile.ZipFile(io.BytesIO(), "w") as archive:
        with archive.open(Opened("array.npy"), "w") as member:
            member.write(b"numbers")

def while_a_plot_is_drawn():
    from matplotlib.backends.backend_agg import RendererAgg
    from matplotlib.path import Path

    class Matrix:
        def __array__(self, *_, **__):
            interrupt()
            return numpy.eye(3)

    renderer = RendererAgg(8, 8, 72)
    renderer.draw_path(renderer.new_gc(), Path([[0.0, 0.0], [8.0, 8.0]]), Matrix())

def while_it_waits():
    threading.Timer(0.2, interrupt).start()
    threading.Event().wait(20.0)

stop_on_signals()
try:
    PLACE()
    time.sleep(20.0)
except Stopped as stopped:
    print(stopped.number)
"""


@pytest.mark.parametrize(
    ("place", "printed"),
    [
        ("interrupt", "15"),
        pytest.param("InFinalizer", "15", marks=pytest.mark.slow),
        ("in_a_callback", "15"),
        ("while_a_lock_is_taken", "given back 15"),
        pytest.param("while_a_member_is_opened", "15", marks=pytest.mark.slow),
        pytest.param("while_a_plot_is_drawn", "15", marks=pytest.mark.slow),
        ("while_it_waits", "15"),
    ],
)
def test_a_signal_is_never_lost_and_never_leaves_a_lock_behind(place: str, printed: str) -> None:
    program = PROGRAM.replace("PLACE", place)
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert ended.stdout.split() == printed.split()
    assert ended.stderr == ""


def test_an_import_is_finished_first(tmp_path: Path) -> None:
    """Compiled modules crash when an exception leaves their import."""
    (tmp_path / "halfway.py").write_text(
        "import os, signal\nos.kill(os.getpid(), signal.SIGTERM)\nnumbers = [n for n in range(100_000)]\n"
    )
    program = (
        "import sys, time\nfrom gnss_sem_map.cli.signals import Stopped, stop_on_signals\nstop_on_signals()\n"
        "try:\n    import halfway\n    time.sleep(20.0)\n"
        "except Stopped as stopped:\n    print(stopped.number, len(sys.modules['halfway'].numbers))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, check=True, timeout=600
    )
    assert done.stdout.split() == [str(int(signal.SIGTERM)), "100000"]


LOAD = """
import os, signal, time
import numpy as np
from llvmlite.binding.executionengine import ExecutionEngine
from gnss_sem_map.cli import signals
from gnss_sem_map.voxels.hash_unique import distinct

def find_and_interrupt(engine, module, find=ExecutionEngine._find_module_ptr):
    os.kill(os.getpid(), signal.SIGTERM)
    return find(engine, module)

ExecutionEngine._find_module_ptr = find_and_interrupt  # LLVM has it called for what is compiled or loaded
signals.TRY_AGAIN_S = 1.0  # the function is used before
signals.stop_on_signals()
try:
    distinct(np.arange(5))
    time.sleep(20.0)
except signals.Stopped as stopped:
    print(stopped.number)
"""


@pytest.mark.slow
def test_a_signal_while_a_function_is_compiled_or_loaded_crashes_nothing(tmp_path: Path) -> None:
    """LLVM goes on without a function whose loading raised an exception, and a call of it would crash."""
    for _ in ("compiled", "loaded from the cache"):
        ended = subprocess.run(
            [sys.executable, "-c", LOAD],
            env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)},
            capture_output=True,
            text=True,
            check=False,
            timeout=600,
        )
        assert (ended.returncode, ended.stdout.split(), ended.stderr) == (0, ["15"], "")


CLAIM = """
import os, signal, sys, time
from pathlib import Path
from gnss_sem_map.cli.signals import Stopped, stop_on_signals
from gnss_sem_map.files import output_folder

OURS = {output_folder.__file__, output_folder.work_folder.__file__}
out = Path(sys.argv[1]) / "out"

def claim(last):
    # and signal at some line of it; returns the number of its lines
    lines = 0

    def count(frame, event, argument):
        nonlocal lines
        if frame.f_code.co_filename not in OURS:
            return None
        lines += 1
        if lines == last:
            os.kill(os.getpid(), signal.SIGTERM)
        return count

    sys.settrace(count)
    try:
        with output_folder.new_folder(out) as folder:
            (folder / "result").touch()
            time.sleep(0.02)  # a signal that came while it was claimed is raised here
        time.sleep(0.02)
    finally:
        sys.settrace(None)
    return lines

claim(0)
lines = claim(0)  # it replaces an earlier result
stop_on_signals()
for line in range(1, lines + 1):
    try:
        claim(line)
    except Stopped:
        pass
    else:
        raise AssertionError(f"the signal at line {line} was lost")
    beside = {path.name for path in out.parent.iterdir()} - {"out"}
    assert not beside, (line, beside)
"""


@pytest.mark.slow
def test_a_signal_at_any_line_of_claiming_a_folder_leaves_no_lock_and_no_work_folder(tmp_path: Path) -> None:
    program = [sys.executable, "-c", CLAIM, str(tmp_path)]
    ended = subprocess.run(program, capture_output=True, text=True, check=False, timeout=600)
    assert ended.returncode == 0, ended.stderr
    assert (tmp_path / "out/result").is_file()


SWALLOWED = """
import os, signal, sys
from gnss_sem_map.cli import commands, main
from gnss_sem_map.errors import DataError

def compiled(**words):
    try:
        os.kill(os.getpid(), signal.SIGTERM)
        for _ in range(1_000_000):
            pass
    except BaseException:  # as compiled code does that knows no exceptions of Python
        error = DataError("tensors: cannot be read")
        error.add_note("what was done is kept")
        raise error from None

commands.app = compiled
sys.argv = ["gnss-sem-map"]
main()
"""


def test_an_error_that_a_signal_caused_is_that_signal() -> None:
    program = [sys.executable, "-c", SWALLOWED]
    ended = subprocess.run(program, capture_output=True, text=True, check=False, timeout=600)
    assert ended.returncode == 128 + signal.SIGTERM
    assert ended.stderr == "gnss-sem-map: stopped by SIGTERM; what was done is kept\n"
