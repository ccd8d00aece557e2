"""The command line. Large packages are imported inside the commands, so that --help is fast.

A new command is a function in one of the files here and a line in `app.COMMANDS`.
"""

from gnss_sem_map.cli.app import app, main

__all__ = ["app", "main"]
