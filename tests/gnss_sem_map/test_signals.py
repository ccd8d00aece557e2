"""A signal ends the program wherever it arrives: where Python drops exceptions too, and where a lock is being taken."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.integration

PROGRAM = """
import ctypes, os, signal, threading, time
from functools import partial
from types import SimpleNamespace
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
        ("InFinalizer", "15"),
        ("in_a_callback", "15"),
        ("while_a_lock_is_taken", "given back 15"),
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
        [sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, check=True, timeout=60
    )
    assert done.stdout.split() == [str(int(signal.SIGTERM)), "100000"]
