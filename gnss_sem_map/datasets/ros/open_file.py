"""A large file that several threads read at places of their own."""

from __future__ import annotations

import os
import weakref
from pathlib import Path

from gnss_sem_map.errors import DataError
from gnss_sem_map.files.untrusted import open_file, reason, shown


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
            raise DataError(
                f"{shown(self.path)}: truncated or damaged; expected {size} bytes at {start}, and it has {self.size}"
            )
        return data

    def read_up_to(self, start: int, size: int) -> bytes:
        """At most `size` bytes, fewer at the end of the file; raises DataError when it cannot be read."""
        parts: list[bytes] = []
        try:
            while size > 0 and start < self.size and (part := os.pread(self._descriptor, size, start)):
                parts.append(part)
                start, size = start + len(part), size - len(part)
        except OSError as error:
            raise DataError(f"{shown(self.path)}: cannot read it ({reason(error)})") from None
        return parts[0] if len(parts) == 1 else b"".join(parts)
