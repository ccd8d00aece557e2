"""A sqlite3 file of a ROS 2 bag: one row per message."""

from __future__ import annotations

import sqlite3
import weakref
from pathlib import Path
from threading import Lock

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.datasets.ros.open_file import MOST_BYTES, expand
from gnss_sem_map.errors import DataError
from gnss_sem_map.files.untrusted import is_file, refused, shown, status

Ints = NDArray[np.int64]
DAMAGED = (sqlite3.Error, TypeError, ValueError, OverflowError)
"""What damaged rows raise: names that are no text, numbers that are none or too large."""


class SqliteFile:
    """Messages of the topics of one file; raises DataError for a file that is no such database, or damaged."""

    def __init__(self, path: Path, codec: str = "") -> None:
        self.path, self._codec, self._lock = path, codec, Lock()
        is_file(path)
        _refuse_log(path.resolve())
        try:
            # immutable: nothing is written beside it, not even a lock; a log of changes is not read
            self._database = sqlite3.connect(
                f"{path.absolute().as_uri()}?mode=ro&immutable=1", uri=True, check_same_thread=False
            )
            weakref.finalize(self, self._database.close)
            rows = self._database.execute("SELECT id, name, type FROM topics").fetchall()
            self.topics = {str(name): (str(kind), "cdr") for _, name, kind in rows}
            self._numbers = {str(name): int(number) for number, name, _ in rows}
        except DAMAGED as error:
            raise self._damaged(error) from None

    def index(self, topic: str) -> tuple[Ints, Ints]:
        """Arrival (n,), ns, and place (n, 2) of the messages of a topic, in the order of the file."""
        try:
            rows = self._database.execute(
                "SELECT timestamp, id FROM messages WHERE topic_id = ? ORDER BY id",
                (self._numbers.get(topic, -1),),
            )
            found = np.fromiter((value for row in rows for value in row), np.int64).reshape(-1, 2)
        except DAMAGED as error:
            raise self._damaged(error) from None
        return found[:, 0], np.column_stack([found[:, 1], np.zeros(len(found), np.int64)])

    def read(self, place: tuple[int, int], most: int | None = None) -> bytes:
        """The message at a place, or its first bytes."""
        try:
            with self._lock, self._database.blobopen("messages", "data", place[0], readonly=True) as blob:
                data = blob.read() if most is None or self._codec else blob.read(min(most, len(blob)))
        except sqlite3.Error as error:
            raise self._damaged(error) from None
        return expand(data, self._codec, shown(self.path), most or MOST_BYTES) if self._codec else data

    def _damaged(self, error: Exception) -> DataError:
        return refused(
            self.path,
            f"truncated, damaged or no bag ({error}); repair it: sqlite3 {shown(self.path.name)}"
            f" .recover | sqlite3 repaired.db3, and move {shown(self.path.name)} to another folder",
        )


def _refuse_log(path: Path) -> None:
    """Raise DataError where messages are still in the write-ahead log, which is read only by who may write it."""
    log = path.with_name(f"{path.name}-wal")
    found = status(log)
    if found is not None and found.st_size:
        name = shown(path.name)
        raise refused(
            log,
            f"found {found.st_size} bytes of messages that are not in {name} yet, expected a bag that was"
            f' closed; end the recorder, then run: sqlite3 {name} "PRAGMA wal_checkpoint(TRUNCATE)"',
        )
