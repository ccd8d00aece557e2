"""The command line in this process: a process of its own imports and loads compiled code for ten seconds.

What a user's process adds, its signals and its death, is tested with real ones in `test_command_line.py`,
`test_signals.py` and `test_run_again.py`.
"""

from __future__ import annotations

import io
import signal
import subprocess
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path

import pytest

from gnss_sem_map.cli import commands, logs, signals

OF_THE_PROCESS = ("share_one_heap", "use_huge_pages", "collect_seldom", "_close_stdout")
"""What `main` does to its process for good."""


def command(*words: str | Path) -> list[str]:
    """The command as a process of its own."""
    return [sys.executable, "-m", "gnss_sem_map.cli", *map(str, words)]


def in_a_process(*words: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command(*words), capture_output=True, text=True, check=False)


def gnss_sem_map(*words: str | Path) -> subprocess.CompletedProcess[str]:
    """Exit code and output of a command, by its entry point; the process is as it was afterwards."""
    out, err, code = io.StringIO(), io.StringIO(), 0
    with (
        _process_kept(),
        pytest.MonkeyPatch.context() as patch,
        redirect_stdout(out),
        redirect_stderr(err),
    ):
        patch.setattr(sys, "argv", ["gnss-sem-map", *map(str, words)])
        for name in OF_THE_PROCESS:
            patch.setattr(commands, name, lambda: None)
        try:
            commands.main()
        except SystemExit as ended:
            code = ended.code
    return subprocess.CompletedProcess(words, code or 0, out.getvalue(), err.getvalue())


@contextmanager
def _process_kept() -> Iterator[None]:
    """Signals, warnings, log files and the terminal's level as they were."""
    handlers = {number: signal.getsignal(number) for number in signals.SIGNALS}
    of_loggers = {logger: list(logger.handlers) for logger in (logs.PROGRAM, logs.STAGES)}
    terminal = logs.Chosen.terminal
    try:
        with warnings.catch_warnings():
            yield
    finally:
        logs.Chosen.terminal = terminal
        for number, handler in handlers.items():
            signal.signal(number, handler)
        for logger, known in of_loggers.items():
            for added in set(logger.handlers) - set(known):
                logger.removeHandler(added)
                added.close()
