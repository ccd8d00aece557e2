"""Access to untrusted files and folders: they may be missing, unreadable, pipes, devices, link loops, or too large."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from gnss_sem_map.errors import DataError, SemMapError

MOST_BYTES = 1 << 30
"""Size limit of files that are read as a whole."""
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
    """A file name for messages: bytes that are not UTF-8 become `\\xff`."""
    return str(path).encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")


def refused(where: object, why: str) -> DataError:
    """The error of a file, or of what it holds: where, then what was found and expected, and what to do."""
    return DataError(f"{shown(where)}: {why}")


def status(path: Path, error: type[SemMapError] = DataError) -> os.stat_result | None:
    """Status of a path, with links resolved; None if nothing exists there. Raises `error` if it cannot be read."""
    try:
        return path.stat()
    except FileNotFoundError:
        _check_links(path, error)
        return None
    except (OSError, ValueError) as problem:
        raise error(f"{shown(path)}: cannot read it ({reason(problem)})") from None


def _check_links(path: Path, error: type[SemMapError]) -> None:
    """Raise `error` if the path does not exist because of a broken link in it."""
    for place in (path, *path.parents):
        if os.path.islink(place) and not os.path.exists(place):
            raise error(f"{shown(place)}: a link to what is not there")
        if os.path.exists(place):
            return


def is_file(path: Path, error: type[SemMapError] = DataError) -> bool:
    """Whether the path is a file; raises `error` if that cannot be read, or if it is something else."""
    found = status(path, error)
    if found is not None:
        _check_ordinary(path, found, error)
    return found is not None


def expect_file(path: Path, expected: str) -> None:
    """Raise DataError, with what is expected there, unless the path is a file."""
    if not is_file(path):
        raise refused(path, f"missing; expected {expected}")


def is_folder(path: Path, error: type[SemMapError] = DataError) -> bool:
    """Whether the path is a folder; raises `error` if that cannot be read, or if it is something else."""
    found = status(path, error)
    if found is not None and not stat.S_ISDIR(found.st_mode):
        raise error(f"{shown(path)}: found {_kind(found)}, expected a folder")
    return found is not None


def inside(folder: Path, error: type[SemMapError] = DataError) -> list[Path]:
    """Paths in a folder, sorted by name; raises `error` if it cannot be listed."""
    try:
        return [folder / name for name in sorted(os.listdir(folder))]
    except (OSError, ValueError) as problem:
        raise error(f"{shown(folder)}: cannot be listed ({reason(problem)})") from None


def open_file(path: Path, error: type[SemMapError] = DataError) -> int:
    """Descriptor of a regular file; raises `error` for anything else, and never blocks on a pipe."""
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
    """Content of a regular file of at most `most` bytes; raises `error` for anything else."""
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
    """Lines of a text file, with limits on their number and length; raises DataError."""
    content = read_bytes(path, MOST_TEXT_BYTES)
    is_wide = content.startswith((b"\xff\xfe", b"\xfe\xff"))
    lines = content.decode("utf-16" if is_wide else "utf-8-sig", "replace").split("\n")
    if len(lines) > MOST_LINES or max(map(len, lines)) > LONGEST_LINE:
        raise DataError(
            f"{shown(path)}: found {len(lines)} lines of up to {max(map(len, lines))} characters, expected at most"
            f" {MOST_LINES} of {LONGEST_LINE}; is it the right file?"
        )
    return lines[:-1] if not lines[-1] else lines


def reason(problem: OSError | ValueError) -> str:
    """Reason why a file could not be read, in a few words."""
    text = (problem.strerror or str(problem)) if isinstance(problem, OSError) else str(problem)
    return " ".join(text.split())


def _check_ordinary(path: Path, found: os.stat_result, error: type[SemMapError]) -> None:
    if not stat.S_ISREG(found.st_mode):
        raise error(f"{shown(path)}: found {_kind(found)}, expected a file")


def _kind(found: os.stat_result) -> str:
    return KINDS.get(stat.S_IFMT(found.st_mode), "something else")
