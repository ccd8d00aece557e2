"""Atomic files: written under another name beside the target, then renamed."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from gnss_sem_map.errors import DataError

NO_ROOM = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}


@contextmanager
def replacing(path: Path | str) -> Iterator[BinaryIO]:
    """Open a new file for writing; it is renamed to `path` when the block succeeds, and removed when it fails.

    Raises DataError when the folder does not exist or may not be written to, and when the disk is full.
    """
    path = Path(path)
    beside = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with beside.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())  # a full disk must be noticed before the rename
        beside.replace(path)
    except OSError as error:
        raise DataError(_explained(path, error)) from error
    finally:
        beside.unlink(missing_ok=True)


def _explained(path: Path, error: OSError) -> str:
    if error.errno in NO_ROOM:
        return f"{path}: no room to write it ({os.strerror(error.errno)}); free space there and export again"
    if error.errno == errno.ENOENT:
        return f"{path}: the folder {path.parent} does not exist; create it first"
    return f"{path}: cannot be written ({error.strerror or error}); check the folder and its permissions"
