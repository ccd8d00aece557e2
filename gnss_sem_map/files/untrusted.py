"""Files and folders that may be anything: absent, unreadable, a pipe, a device, a loop of links, or far too large."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from gnss_sem_map.errors import DataError, SemMapError

MOST_BYTES = 1 << 30
"""Of any file that is read whole."""
MOST_TEXT_BYTES = 256 << 20
MOST_LINES = 5_000_000
LONGEST_LINE = 100_000

KINDS = {
    stat.S_IFREG: "a file",
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}


def shown(path: object) -> str:
    """A name as it can be printed and written: bytes that are no UTF-8 as `\\xff`."""
    return str(path).encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")


def status(path: Path, error: type[SemMapError] = DataError) -> os.stat_result | None:
    """What is at a path, links followed; None where nothing is. Raises `error` where that cannot be known."""
    try:
        return path.stat()
    except FileNotFoundError:
        _check_links(path, error)
        return None
    except (OSError, ValueError) as problem:
        raise error(f"{shown(path)}: cannot read it ({reason(problem)})") from None


def _check_links(path: Path, error: type[SemMapError]) -> None:
    """Raise `error` where nothing is there because a link, here or above, leads nowhere."""
    for place in (path, *path.parents):
        if os.path.islink(place) and not os.path.exists(place):
            raise error(f"{shown(place)}: a link to what is not there")
        if os.path.exists(place):
            return


def is_file(path: Path, error: type[SemMapError] = DataError) -> bool:
    """Whether there is a file; raises `error` where that cannot be known, or something else is there."""
    found = status(path, error)
    if found is not None:
        _check_ordinary(path, found, error)
    return found is not None


def is_folder(path: Path, error: type[SemMapError] = DataError) -> bool:
    """Whether there is a folder; raises `error` where that cannot be known, or something else is there."""
    found = status(path, error)
    if found is not None and not stat.S_ISDIR(found.st_mode):
        raise error(f"{shown(path)}: found {_kind(found)}, expected a folder")
    return found is not None


def inside(folder: Path, error: type[SemMapError] = DataError) -> list[Path]:
    """What is in a folder, by name; raises `error` where it cannot be listed."""
    try:
        return [folder / name for name in sorted(os.listdir(folder))]
    except (OSError, ValueError) as problem:
        raise error(f"{shown(folder)}: cannot be listed ({reason(problem)})") from None


def open_file(path: Path, error: type[SemMapError] = DataError) -> int:
    """A descriptor of an ordinary file; raises `error` for anything else, and never waits for a pipe."""
    try:
        _check_ordinary(path, os.stat(path), error)  # before opening: to open some devices is to use them
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except FileNotFoundError:
        raise error(f"{shown(path)}: cannot read it (No such file or directory)") from None
    except (OSError, ValueError) as problem:
        raise error(f"{shown(path)}: cannot read it ({reason(problem)})") from None
    try:
        _check_ordinary(path, os.fstat(descriptor), error)
    except SemMapError:
        os.close(descriptor)
        raise
    return descriptor


def read_bytes(path: Path, most: int = MOST_BYTES, error: type[SemMapError] = DataError) -> bytes:
    """The content of an ordinary file of at most `most` bytes; raises `error` for anything else."""
    with os.fdopen(open_file(path, error), "rb", buffering=0) as file:
        try:
            size = os.fstat(file.fileno()).st_size
            if size > most:
                raise error(
                    f"{shown(path)}: found {size} bytes, expected at most {most}; is it the right file?"
                )
            return file.readall()
        except OSError as problem:
            raise error(f"{shown(path)}: cannot read it ({reason(problem)})") from None


def read_text(path: Path, most: int = MOST_TEXT_BYTES, error: type[SemMapError] = DataError) -> str:
    """The text of a UTF-8 file; raises `error` for anything else."""
    try:
        return read_bytes(path, most, error).decode("utf-8")
    except UnicodeDecodeError as problem:
        raise error(f"{shown(path)}: byte {problem.start} is no UTF-8 text") from None


def read_lines(path: Path) -> list[str]:
    """The lines of a text file, of which there are not too many and none is too long; raises DataError."""
    lines = read_bytes(path, MOST_TEXT_BYTES).decode("utf-8", "replace").split("\n")
    if len(lines) > MOST_LINES or max(map(len, lines)) > LONGEST_LINE:
        raise DataError(
            f"{shown(path)}: found {len(lines)} lines of up to {max(map(len, lines))} characters, expected at most"
            f" {MOST_LINES} of {LONGEST_LINE}; is it the right file?"
        )
    return lines[:-1] if not lines[-1] else lines


def reason(problem: OSError | ValueError) -> str:
    """Why a file could not be had, in a few words."""
    text = (problem.strerror or str(problem)) if isinstance(problem, OSError) else str(problem)
    return " ".join(text.split())


def _check_ordinary(path: Path, found: os.stat_result, error: type[SemMapError]) -> None:
    if not stat.S_ISREG(found.st_mode):
        raise error(f"{shown(path)}: found {_kind(found)}, expected a file")


def _kind(found: os.stat_result) -> str:
    return KINDS.get(stat.S_IFMT(found.st_mode), "something else")
