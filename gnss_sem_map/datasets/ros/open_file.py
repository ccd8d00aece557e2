"""A large file that several threads read at places of their own, and what is compressed in it, with a limit."""

from __future__ import annotations

import os
import sys
import weakref
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from threading import Lock
from typing import Any

from gnss_sem_map.errors import one_line
from gnss_sem_map.files.untrusted import open_file, reason, refused

MOST_BYTES = 1 << 30
"""Of a chunk or a message, expanded; recorders write chunks of 1 to 10 MB."""
MOST_KEPT = 2
"""Chunks that were expanded last: neighbouring messages are in the same one."""


class OpenFile:
    """Reads of so many bytes from so far in the file; closed when nobody needs it any more."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._descriptor = open_file(path)
        weakref.finalize(self, os.close, self._descriptor)
        self.size = os.fstat(self._descriptor).st_size

    def read(self, start: int, size: int) -> bytes:
        """Exactly `size` bytes; raises DataError where the file ends before them."""
        data = self.read_up_to(start, size) if start >= 0 and 0 <= size <= self.size - start else b""
        if len(data) != size:
            raise refused(self.path, f"truncated or damaged; expected {size} bytes at {start}")
        return data

    def read_up_to(self, start: int, size: int) -> bytes:
        """At most `size` bytes, fewer at the end of the file; raises DataError when it cannot be read."""
        parts: list[bytes] = []
        try:
            while size > 0 and start < self.size and (part := os.pread(self._descriptor, size, start)):
                parts.append(part)
                start, size = start + len(part), size - len(part)
        except OSError as error:
            raise refused(self.path, f"cannot read it ({reason(error)})") from None
        return parts[0] if len(parts) == 1 else b"".join(parts)


def kept(read: Callable[[int], bytes]) -> Callable[[int], bytes]:
    """The same reader of chunks, which remembers the last ones; of several threads, one expands a chunk."""
    remembered, lock = lru_cache(MOST_KEPT)(read), Lock()

    def get(number: int) -> bytes:
        with lock:
            return remembered(number)

    return get


def expand(data: bytes, codec: str, where: str, most: int = MOST_BYTES) -> bytes:
    """The content of compressed bytes, its first `most` bytes; raises DataError for an unknown codec, or damage."""
    if codec in ("", "none"):
        return data[:most]
    if codec not in ("bz2", "lz4", "zstd"):
        raise refused(where, f"is compressed with {codec[:40]!r}; convert it to none, lz4, zstd or bz2")
    expander, damage = _decompressor(codec)
    damage += (OSError, RuntimeError, ValueError, EOFError)
    try:
        return bytes(expander.decompress(data, most))
    except damage as error:
        raise refused(where, f"damaged {codec} data ({one_line(error, 100)})") from None


def _decompressor(codec: str) -> tuple[Any, tuple[type[Exception], ...]]:
    """What expands data of a codec, and the errors of its own."""
    if codec == "bz2":
        from bz2 import BZ2Decompressor

        return BZ2Decompressor(), ()
    if codec == "lz4":
        from lz4.frame import LZ4FrameDecompressor

        return LZ4FrameDecompressor(), ()
    if sys.version_info >= (3, 14):
        from compression.zstd import ZstdDecompressor, ZstdError
    else:
        from backports.zstd import ZstdDecompressor, ZstdError
    return ZstdDecompressor(), (ZstdError,)
