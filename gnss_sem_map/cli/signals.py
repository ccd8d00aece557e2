"""Signals that end the program, as an exception."""

from __future__ import annotations

import signal
import sys
from types import FrameType
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # signals are taken before anything else is imported
    from gnss_sem_map.errors import SemMapError

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
TRY_AGAIN_S = 0.01
LOCKING = (
    "threading",
    "concurrent.futures",
    "queue",
    "importlib",
    "weakref",
    "_weakrefset",
    "contextlib",
    "zipfile",
)
"""Modules whose functions take locks, or enter and leave blocks that do: one that is left between taking a lock and
giving it back blocks all threads, and an archive of which a member is half opened cannot be closed."""
WHOLE = (
    "importlib._bootstrap",
    "_frozen_importlib",
    "llvmlite",
    "matplotlib.backends.backend_agg",
    "tempfile",
    "gnss_sem_map.files.output_folder",
    "gnss_sem_map.files.work_folder",
    "gnss_sem_map.files.atomic",
)
"""Modules whose functions are finished with all that they call: an import, compiling or loading a function, drawing a
plot, and what makes, replaces or removes results. A block in which such a folder is claimed is not below them."""
WAITING = ("wait", "_wait_for_tstate_lock")
"""Their functions that wait for other threads: they may be left while they do."""


class Stopped(BaseException):
    """The program was stopped: by Ctrl-C, `kill`, or because its terminal was closed."""

    def __init__(self, number: int) -> None:
        super().__init__(f"stopped by {signal.Signals(number).name}")
        self.number = number


_arrived: list[int] = []
"""Signals that arrived."""


def stop_on_signals() -> None:
    """Raise Stopped from now on when a signal arrives; one that is ignored, as by `nohup`, stays ignored.

    Python drops exceptions in finalizers and in callbacks of compiled code: there Stopped is raised again later.
    """
    sys.unraisablehook = _dropped
    for number in SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _stop)


def caused_by_signal(error: SemMapError) -> Stopped | None:
    """The signal that made a reader fail, if one arrived: compiled readers turn Stopped into an error of their own."""
    if not _arrived:
        return None
    stopped = Stopped(_arrived[0])
    for note in getattr(error, "__notes__", []):
        stopped.add_note(note)
    return stopped


def ignore_signals() -> None:
    """Ignore signals while the program ends."""
    signal.setitimer(signal.ITIMER_REAL, 0.0)
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)


def _stop(number: int, frame: FrameType | None) -> None:
    _arrived.append(number)
    if not _must_go_on(frame):
        raise Stopped(number)
    _stop_later(number, frame)


def _stop_later(number: int, seen: FrameType | None = None) -> None:
    """Look again soon; a function that waits is left when it still stands where it was seen."""
    place = None if seen is None else (seen.f_code, seen.f_lasti)

    def look_again(_: int, frame: FrameType | None) -> None:
        if frame and place == (frame.f_code, frame.f_lasti) and frame.f_code.co_name in WAITING:
            raise Stopped(number)
        _stop(number, frame)

    signal.signal(signal.SIGALRM, look_again)
    signal.setitimer(signal.ITIMER_REAL, TRY_AGAIN_S)


def _must_go_on(frame: FrameType | None) -> bool:
    """Whether a function that takes locks is on top, or one that must be finished is below.

    An import that is left may crash in compiled code, and some modules drop every exception of what they import. LLVM
    calls Python to load a function, drops what is raised there, and the function is missing when it is called.
    matplotlib calls it to read a matrix, and says ValueError in place of what is raised there. A folder that is claimed
    or given back is otherwise left with its lock, or half removed.
    """
    if frame is not None and _module_of(frame).startswith(LOCKING):
        return True
    while frame is not None:
        if _module_of(frame).startswith(WHOLE):
            return True
        frame = frame.f_back
    return False


def _module_of(frame: FrameType) -> str:
    return str(frame.f_globals.get("__name__"))


def _dropped(dropped: sys.UnraisableHookArgs) -> None:
    if isinstance(dropped.exc_value, Stopped):
        _stop_later(dropped.exc_value.number)
    else:
        sys.__unraisablehook__(dropped)
