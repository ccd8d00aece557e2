"""Errors of the map: what is wrong, where, what was found and expected, and what to do, in one line."""

import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


class SemMapError(Exception):
    """Base of every error that this package raises on purpose."""


class ConfigError(SemMapError, ValueError):
    """A setting that is unknown, out of range or contradicts another."""


class DataError(SemMapError, ValueError):
    """A drive, a map or a label file that is not what it must be."""


class WriteError(DataError):
    """A file that is needed later cannot be written: the run stops, where other errors skip one scan or image."""


class ImageSizeError(DataError):
    """An image is not of the size that the calibration says; `found` is its own (width, height)."""

    def __init__(self, message: str, found: tuple[int, int]) -> None:
        super().__init__(message)
        self.found = found


class PointTimesError(DataError):
    """The times of a scan's points are not of a sweep; `mistake` says what they probably are."""

    def __init__(self, found: str, mistake: str) -> None:
        super().__init__(found, mistake)
        self.found, self.mistake = found, mistake

    def __str__(self) -> str:
        return f"{self.found}; {self.mistake}"


def counted(number: int, one: str, many: str = "") -> str:
    """A number of things in words: `many` is the plural where it is not that of `one` with an s."""
    return f"{number:,} {one if number == 1 else many or f'{one}s'}"


def one_line(error: Exception, most: int = 200) -> str:
    """The message of another library's error, for a message of ours: at most so many characters, in one line."""
    return " ".join(str(error).split())[:most] or type(error).__name__


@contextmanager
def errors_of_others(before: str, after: str = "", named: bool = False) -> Iterator[None]:
    """Make a DataError of one line of whatever the code of others raises: a network may raise anything.

    Its message, with the name of its kind where `named`, stands between `before` and `after`. Errors of ours pass.
    """
    try:
        yield
    except SemMapError:
        raise
    except Exception as error:
        kind = f"{type(error).__name__} " if named else ""
        raise DataError(f"{before}{kind}{one_line(error)}{after}") from error


@contextmanager
def errors_of_measurements(before: str = "") -> Iterator[None]:
    """Make a DataError, with the same message behind `before`, of what `factor_graphs` says of measurements."""
    from factor_graphs.errors import MeasurementError

    try:
        yield
    except MeasurementError as error:
        raise DataError(f"{before}{error}") from None


def how_to_install(extra: str) -> str:
    """What to type in a clone for an extra: it reaches the environment that runs, whether or not it is active."""
    return f"in the clone: {sys.executable} -m pip install -c constraints.txt -e '.[{extra}]'"


def program(name: str) -> str:
    """How a program of this environment is called: by its name where the shell finds it, else by its path."""
    return name if shutil.which(name) else str(Path(sys.executable).with_name(name))
