"""What the program says while it works: how much of it on the terminal, and all of it in a file.

Imported before `--help` is answered: it imports nothing large.
"""

from __future__ import annotations

import logging
import sys
import time
from enum import Enum
from pathlib import Path

PROGRAM = logging.getLogger("gnss-sem-map")
"""The command, its warnings, its error and its exit code: for the file alone, for the terminal has them already."""
STAGES = PROGRAM.getChild("stages")
"""Begin and end of every stage: for the file, and with --verbose for the terminal."""
PROGRAM.propagate = False
PROGRAM.addHandler(logging.NullHandler())  # without a handler, errors would be printed twice
PROGRAM.setLevel(logging.INFO)
LINE = logging.Formatter("%(asctime)s %(levelname)s %(message)s")


class Terminal(Enum):
    """How much is printed on stderr beside errors."""

    QUIET = "nothing"
    NORMAL = "bars"
    VERBOSE = "lines"


class Chosen:
    """What the command line has chosen, for the whole process."""

    terminal = Terminal.NORMAL


def set_up(terminal: Terminal, log_file: Path | None) -> None:
    """Prepare one command; a log file is appended to. Raises OSError."""
    Chosen.terminal = terminal
    if terminal is Terminal.VERBOSE:
        _write_to(STAGES, logging.StreamHandler())
    if log_file is not None:
        _write_to(PROGRAM, logging.FileHandler(log_file, encoding="utf-8", errors="backslashreplace"))
        PROGRAM.info("gnss-sem-map %s", " ".join(sys.argv[1:]))


def _write_to(logger: logging.Logger, handler: logging.Handler) -> None:
    handler.setFormatter(LINE)
    logger.addHandler(handler)


class StageLog:
    """A `Progress` that logs when a stage begins and when it is done, of several drives for each."""

    def __init__(self) -> None:
        self._begun: dict[str, float] = {}
        self._done: set[str] = set()

    def __call__(self, stage: str, done: int, total: int) -> None:
        if stage not in self._begun:
            if done >= total and stage in self._done:
                return  # the end of a stage may be told twice
            self._begun[stage] = time.monotonic()
            STAGES.info("%s: begins, %d steps", stage, total)
        if done >= total:
            STAGES.info("%s: done after %.1f s", stage, time.monotonic() - self._begun.pop(stage))
            self._done.add(stage)
