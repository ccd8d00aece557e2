"""The memo: what a task found, in a file that says from what it was made. What is there is not made again.

Every intermediate result but voxels is such a file, an `.npz`: some arrays, and JSON beside them. One that is damaged,
or was made from something else, is not there.
"""

from __future__ import annotations

import json
import os
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.errors import DataError
from gnss_sem_map.files.atomic import unfinished
from gnss_sem_map.files.untrusted import is_file, open_file
from gnss_sem_map.files.work_folder import writing_to

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

MADE_FROM, ABOUT = "made_from", "about"
DAMAGED = (
    DataError,
    LookupError,
    TypeError,
    ValueError,
    OSError,
    EOFError,
    MemoryError,
    zipfile.BadZipFile,
    zlib.error,
)


@dataclass(frozen=True, eq=False)
class Found:
    """What was made: arrays, and JSON `about` them."""

    about: dict[str, Any]
    arrays: dict[str, NDArray[Any]]

    def of(self, name: str) -> dict[str, NDArray[Any]]:
        """The arrays of one of several dataclasses, by the names of their fields, see `arrays_of`."""
        return {
            key.partition(".")[2]: array for key, array in self.arrays.items() if key.startswith(f"{name}.")
        }


def arrays_of(name: str, content: DataclassInstance | None) -> dict[str, NDArray[Any]]:
    """The arrays of a dataclass for `remember`, those that are None left out."""
    values = (
        {} if content is None else {field.name: getattr(content, field.name) for field in fields(content)}
    )
    return {f"{name}.{key}": value for key, value in values.items() if value is not None}


def remember(
    path: Path, made_from: str, about: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]
) -> None:
    """Save what was made from inputs with this digest; raises DataError when it cannot be written."""
    said = {MADE_FROM: np.array(made_from), ABOUT: np.frombuffer(json.dumps(about).encode(), np.uint8)}
    with writing_to(path.parent):
        path.parent.mkdir(parents=True, exist_ok=True)
        # no fsync: what a crash of the machine cuts short is found by its checksums, and made again
        beside = unfinished(path)
        with beside.open("wb") as file:
            np.savez(file, allow_pickle=False, **said, **arrays)
        beside.replace(path)


def recall(path: Path, made_from: str | None) -> Found | None:
    """What was made from the same, or from anything (None); None where it is not there, or damaged."""
    if not is_file(path):
        return None
    try:
        with os.fdopen(open_file(path), "rb") as file, np.load(file, allow_pickle=False) as archive:
            if made_from not in (None, str(archive[MADE_FROM])):
                return None
            arrays = {name: archive[name] for name in archive.files if name not in (MADE_FROM, ABOUT)}
            return Found(json.loads(archive[ABOUT].tobytes()), arrays)
    except DAMAGED:
        return None
