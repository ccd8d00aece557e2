"""Arrays in an `.npz` file: when they are read, type and size of each are checked before it is decompressed."""

from __future__ import annotations

import io
import math
import os
import re
import struct
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.errors import DataError, one_line
from gnss_sem_map.files.untrusted import MOST_BYTES, open_file, shown

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

MOST_MEMBERS = 100
MOST_HEADER_BYTES = 10_000
MOST_DIMENSIONS = 32
CHUNK_BYTES = 1 << 18
KINDS_OF_COMPRESSION = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
HEADER = re.compile(
    r"\{'descr': '([<>|=]?[biufcUS]\d{1,6})', 'fortran_order': (True|False),"
    r" 'shape': \(((?:\d{1,18}, ?)*\d{0,18})\),? ?\}\s*"
)
"""Format of the header that numpy writes; nothing in it is evaluated."""

_ERRORS = (
    zipfile.BadZipFile,
    zlib.error,
    struct.error,
    OSError,
    EOFError,
    ValueError,
    LookupError,
    RuntimeError,
)
"""Exceptions of `zipfile` for a damaged archive, or one that needs a password or another method."""


class Archive:
    """An open `.npz` file; `open_archive` makes it."""

    def __init__(self, path: Path, members: zipfile.ZipFile) -> None:
        self._path, self._members = path, members

    def __contains__(self, name: str) -> bool:
        return any(entry.filename == f"{name}.npy" for entry in self._members.infolist()[:MOST_MEMBERS])

    def array(self, name: str, most_bytes: int = MOST_BYTES) -> Member:
        """Type and shape of an array; raises DataError if it does not exist or is not in numpy's format."""
        entries = {entry.filename: entry for entry in self._members.infolist()[:MOST_MEMBERS]}
        entry = entries.get(f"{name}.npy")
        if entry is None:
            raise DataError(f"{shown(self._path)}: no {name} in it; found {sorted(entries)[:8]}")
        if entry.flag_bits & 1:
            raise DataError(f"{shown(self._path)}: {name} is encrypted; expected a plain .npz")
        if entry.compress_type not in KINDS_OF_COMPRESSION:
            raise DataError(
                f"{shown(self._path)}: {name} is compressed by method {entry.compress_type}, expected none or deflate"
                " (np.savez, np.savez_compressed)"
            )
        with self._damage(), self._members.open(entry) as file:
            dtype, is_fortran, shape, start = _header(file)
        size = math.prod(shape) * dtype.itemsize
        # numpy limits empty arrays by their other sides
        largest = math.prod(side or 1 for side in shape) * dtype.itemsize
        if dtype.itemsize == 0 or largest > most_bytes or start + size != entry.file_size:
            raise DataError(
                f"{shown(self._path)}: {name} is {dtype} {shape} in {entry.file_size} bytes, expected as many as that"
                f" needs and at most {most_bytes}"
            )
        return Member(self, entry, dtype, is_fortran, shape, start)

    def unpack(self, member: Member) -> NDArray[Any]:
        """The values of an array."""
        with self._damage(), self._members.open(member.entry) as file:
            values = np.empty(member.shape[::-1] if member.is_fortran else member.shape, member.dtype)
            room = values.reshape(-1).view(np.uint8)
            file.read(member.start)
            done = 0
            while done < len(room):
                chunk = file.read(min(CHUNK_BYTES, len(room) - done))
                if not chunk:
                    raise EOFError("it ends too early")
                room[done : done + len(chunk)] = np.frombuffer(chunk, np.uint8)
                done += len(chunk)
            file.read(1)  # the checksum is compared at the end
        return values.T if member.is_fortran else values

    @contextmanager
    def _damage(self) -> Iterator[None]:
        try:
            yield
        except DataError:
            raise
        except _ERRORS as error:
            raise _damaged(self._path, error) from None


class Member:
    """One array of an archive, not yet unpacked."""

    def __init__(
        self, archive: Archive, entry: zipfile.ZipInfo, dtype: np.dtype[Any], is_fortran: bool,
        shape: tuple[int, ...], start: int,
    ) -> None:  # fmt: skip
        self._archive, self.entry, self.dtype, self.shape = archive, entry, dtype, shape
        self.is_fortran, self.start = is_fortran, start

    def read(self) -> NDArray[Any]:
        """The values; raises DataError when they are damaged."""
        return self._archive.unpack(self)


@contextmanager
def open_archive(path: Path, most_bytes: int = MOST_BYTES) -> Iterator[Archive]:
    """Open an `.npz` file; raises DataError when it is not an archive, or too large."""
    with os.fdopen(open_file(path), "rb") as file:
        size = os.fstat(file.fileno()).st_size
        if size > most_bytes:
            raise DataError(f"{shown(path)}: found {size} bytes, expected at most {most_bytes}")
        try:
            members = zipfile.ZipFile(file)
        except _ERRORS as error:
            raise _damaged(path, error) from None
        with members:
            yield Archive(path, members)


def npz_of(arrays: DataclassInstance) -> bytes:
    """The arrays of a dataclass as the content of an `.npz` file, nothing rounded; those that are None are left out."""
    named = {field.name: getattr(arrays, field.name) for field in fields(arrays)}
    file = io.BytesIO()
    np.savez(file, **{name: array for name, array in named.items() if array is not None})
    return file.getvalue()


def _header(file: IO[bytes]) -> tuple[np.dtype[Any], bool, tuple[int, ...], int]:
    """Type, order and shape of an array, and the offset of its values."""
    magic = file.read(8)
    if magic[:6] != b"\x93NUMPY" or len(magic) < 8 or magic[6] not in (1, 2, 3):
        raise ValueError("no array of numpy")
    words = 2 if magic[6] == 1 else 4
    length = int.from_bytes(file.read(words), "little")
    if length > MOST_HEADER_BYTES:
        raise ValueError(f"a header of {length} bytes")
    header = file.read(length).decode("latin1")
    found = HEADER.fullmatch(header)
    if found is None and "'|O'" in header:
        raise ValueError("Python objects, which are not read: save names as numpy.array(names, str)")
    if found is None:
        raise ValueError("no plain array")
    shape = tuple(int(side) for side in found[3].replace(" ", "").split(",") if side)
    if len(shape) > MOST_DIMENSIONS:
        raise ValueError(f"{len(shape)} dimensions, at most {MOST_DIMENSIONS}")
    try:
        dtype = np.dtype(found[1])
    except TypeError:
        raise ValueError(f"numbers of type {found[1]}") from None
    return dtype, found[2] == "True", shape, 8 + words + length


def _damaged(path: Path, error: Exception) -> DataError:
    why = one_line(error)
    return DataError(f"{shown(path)}: damaged file, or no .npz of plain arrays ({why})")
