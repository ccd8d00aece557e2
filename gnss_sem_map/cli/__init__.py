"""The command line. Large packages are imported inside the commands, so that --help is fast.

A new command is a function in one of the files here and a line in `commands.COMMANDS`.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

from gnss_sem_map.cli.signals import Stopped, ignore_signals, stop_on_signals

if TYPE_CHECKING:
    from gnss_sem_map.cli.commands import app

__all__ = ["app", "main"]


def main() -> None:
    """Entry point, see `commands.main`; a signal while it is being imported ends the program with one line too."""
    try:
        stop_on_signals()
        from gnss_sem_map.cli.commands import main as run_command

        run_command()
    except Stopped as stopped:
        ignore_signals()
        print(f"gnss-sem-map: {stopped}", file=sys.stderr)
        sys.exit(128 + stopped.number)


def __getattr__(name: str) -> Any:
    if name != "app":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from gnss_sem_map.cli.commands import app

    return app
