"""Atomic files and folders: written under another name beside the target, then renamed."""

from __future__ import annotations

import errno
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from gnss_sem_map.errors import DataError

NO_ROOM = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}


def unfinished(path: Path) -> Path:
    """A hidden name beside a file or folder, for it while it is written.

    Another one for every call, not that of the process: those of two containers may have one number, and a worker that
    is thought lost may still write what another one writes.
    """
    return path.with_name(f".{path.name}.{secrets.randbelow(1 << 60)}.part")


@contextmanager
def replacing(path: Path | str) -> Iterator[BinaryIO]:
    """Open a new file for writing; it is renamed to `path` when the block succeeds, and removed when it fails.

    Raises DataError when the folder does not exist or may not be written to, and when the disk is full.
    """
    path = Path(path)
    try:
        with _beside(path) as file:
            yield file
    except OSError as error:
        raise DataError(_explained(path, error)) from error


def write_whole(path: Path, content: bytes) -> None:
    """Write a file as `replacing` does; raises OSError."""
    with _beside(path) as file:
        file.write(content)


@contextmanager
def _beside(path: Path) -> Iterator[BinaryIO]:
    beside = unfinished(path)
    try:
        with beside.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())  # a full disk must be noticed before the rename
        beside.replace(path)
    finally:
        beside.unlink(missing_ok=True)


@contextmanager
def adding_folder(path: Path) -> Iterator[Path]:
    """Make a new folder for files; it is renamed to `path` when the block succeeds, and removed when it fails or when
    it is empty.

    Raises DataError when `path` exists, when its parent does not or may not be written to, and when the disk is full.
    """
    if path.exists():
        raise DataError(f"{path}: exists; move it away or choose another folder")
    beside = unfinished(path)
    try:
        beside.mkdir()
        yield beside
        if any(beside.iterdir()):
            beside.rename(path)
    except OSError as error:
        raise DataError(_explained(path, error)) from error
    finally:
        shutil.rmtree(beside, ignore_errors=True)


def sync(folder: Path) -> None:
    """Let the disk have all files of a folder: after a power failure they are still whole. Raises OSError."""
    for place, _, files in os.walk(folder):
        for path in (*(os.path.join(place, name) for name in files), place):
            number = os.open(path, os.O_RDONLY)
            try:
                os.fsync(number)
            finally:
                os.close(number)


def link_or_copy(source: Path | str, target: Path | str) -> None:
    """A second name for a file, or a copy where the file system has no links; raises OSError."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)


def _explained(path: Path, error: OSError) -> str:
    if error.errno in NO_ROOM:
        return f"{path}: no room to write it ({os.strerror(error.errno)}); free space there and try again"
    if error.errno == errno.ENOENT:
        return f"{path}: the folder {path.parent} does not exist; create it first"
    return f"{path}: cannot be written ({error.strerror or error}); check the folder and its permissions"
