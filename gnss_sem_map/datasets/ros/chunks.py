"""The chunks of a bag file that were expanded last: neighbouring messages are in the same one."""

from __future__ import annotations

from collections.abc import Callable
from threading import Lock

MOST_KEPT = 2


class Chunks:
    """A few chunks by their number; threads may read at the same time."""

    def __init__(self, read: Callable[[int], bytes]) -> None:
        self._read = read
        self._kept: dict[int, bytes] = {}
        self._lock = Lock()

    def get(self, number: int) -> bytes:
        """The content of a chunk."""
        with self._lock:
            found = self._kept.pop(number, None)
            if found is None:
                found = self._read(number)
                while len(self._kept) >= MOST_KEPT:
                    self._kept.pop(next(iter(self._kept)))
            self._kept[number] = found  # the last one
            return found
