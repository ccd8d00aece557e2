"""The list of all commands, their exit codes, and one line for every error."""

from __future__ import annotations

import atexit
import io
import os
import sys
import warnings
from contextlib import suppress
from pathlib import Path
from typing import Annotated, NoReturn, cast

import typer

from gnss_sem_map.cli import (
    evaluation,
    finished,
    inspection,
    logs,
    mapping,
    noise,
    segmentation,
    settings,
    simulation,
)
from gnss_sem_map.cli.signals import Stopped, caused_by_signal, ignore_signals
from gnss_sem_map.errors import SemMapError
from gnss_sem_map.files.ownership import MARKER
from gnss_sem_map.process.machine import BLAS_THREADS_VARIABLE
from gnss_sem_map.process.memory import collect_seldom, share_one_heap, use_huge_pages

COMMANDS = (
    mapping.run,
    mapping.add,
    mapping.remove,
    mapping.trajectory,
    finished.refine,
    finished.relabel,
    finished.export,
    finished.view,
    segmentation.segment,
    segmentation.train,
    evaluation.evaluate,
    evaluation.calibrate,
    evaluation.fit_classifier,
    evaluation.check,
    inspection.inspect,
    noise.imu_noise,
    simulation.simulate,
    simulation.demo,
    settings.config,
)
"""In the order of `--help`. The name of the function is the name of the command, its docstring the help."""

app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="From a drive log (GNSS, IMU, LiDAR, camera) to a clean, georeferenced, semantic 3D map.",
    epilog="Example: gnss-sem-map run 2011_09_26/2011_09_26_drive_0005_sync --segmenter labels:probabilities -o out",
)


def _print_version(asked: bool) -> None:
    if asked:
        from importlib.metadata import version

        typer.echo(f"gnss-sem-map {version('gnss-sem-map')}")
        raise typer.Exit


@app.callback()
def _all_commands(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
    verbose: Annotated[
        bool, typer.Option("-v", "--verbose", help="A line on stderr when a stage begins and ends; no bars.")
    ] = False,
    quiet: Annotated[
        bool, typer.Option("-q", "--quiet", help="Neither progress nor warnings on the terminal.")
    ] = False,
    log_file: Annotated[
        Path | None,
        typer.Option(
            help="File to which stages, warnings and the error are appended; not in a folder of results."
        ),
    ] = None,
) -> None:
    if verbose and quiet:
        raise typer.BadParameter("--verbose and --quiet exclude each other", param_hint="-v, -q")
    for folder in log_file.absolute().parents if log_file is not None else ():
        if (folder / MARKER).exists():
            raise typer.BadParameter(
                f"{log_file} lies in {folder}, a folder of results; choose another place",
                param_hint="--log-file",
            )
    logs.set_up(
        logs.Terminal.VERBOSE if verbose else logs.Terminal.QUIET if quiet else logs.Terminal.NORMAL, log_file
    )


for _command in COMMANDS:
    app.command()(_command)


def main() -> None:
    """Entry point: one line on stderr for every error; exit code 2 for wrong usage, 1 for any other error.

    A signal ends it with one line too, and with 128 plus its number; they are caught from `cli.main` on.
    """
    from factor_graphs.errors import FactorGraphError

    os.environ[BLAS_THREADS_VARIABLE] = "1"  # before numpy is imported; see `machine.one_blas_thread`
    share_one_heap()
    use_huge_pages()
    collect_seldom()
    if not sys.warnoptions:
        warnings.simplefilter("ignore")  # of other packages; ours are printed by the commands
    stopped_by = 0
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # names that are no UTF-8
    try:
        code = _called()
        sys.stdout.flush()
    except Stopped as stopped:
        stopped_by = stopped.number
        code = _say(_with_notes(stopped), 128 + stopped_by)
    except typer.TyperException as error:
        code = _wrong_usage(error)
    except (SemMapError, FactorGraphError) as error:
        code = _say(_with_notes(error), 1)
    except MemoryError as error:
        code = _say(
            f"not enough memory ({error}); take fewer --workers, larger voxels or a part of the drive", 1
        )
    except OSError as error:  # an error of the system that was not explained earlier
        code = _say(f"{error.filename or 'output'}: {error.strerror or error}", 1)
        _close_stdout()
    except (UnicodeError, RecursionError) as error:
        code = _say(f"{type(error).__name__} {error}", 1)
    logs.PROGRAM.info("exit code %s", code or 0)
    if stopped_by:
        _end_now(128 + stopped_by)
    sys.exit(code)


def _called() -> int | None:
    try:
        return cast("int | None", app(prog_name="gnss-sem-map", standalone_mode=False))
    except SemMapError as error:
        if stopped := caused_by_signal(error):
            raise stopped from error
        raise


def _end_now(code: int) -> NoReturn:
    """End the process without waiting for its threads: what a network computes there is not needed."""
    atexit._run_exitfuncs()
    with suppress(OSError):
        sys.stdout.flush()
    os._exit(code)


def _with_notes(error: BaseException) -> str:
    """The message of an error, and what became of the work that was done."""
    return "; ".join([str(error), *getattr(error, "__notes__", [])])


def _say(message: str, code: int) -> int:
    """One line on stderr; returns the exit code."""
    ignore_signals()  # the program is ending already
    line = " ".join(message.split())
    logs.PROGRAM.error("%s", line)
    typer.echo(f"gnss-sem-map: {line}", err=True)
    return code


def _close_stdout() -> None:
    """Close stdout, so that output that could not be printed is not tried again at exit."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _wrong_usage(error: typer.TyperException) -> int:
    """Print the wrong usage, and the command for help, in one line; returns the exit code."""
    message = " ".join(error.format_message().split())
    context: typer.Context | None = getattr(error, "ctx", None)
    command = "gnss-sem-map" if context is None else context.command_path
    if message:  # without a command, the help has been shown
        typer.echo(f"gnss-sem-map: {message.rstrip('.')}; see {command} --help", err=True)
    return error.exit_code
