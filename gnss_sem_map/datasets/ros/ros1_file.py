"""A bag file of ROS 1 (format 2.0): where its messages are, by the index that `rosbags` reads.

Record layouts: http://wiki.ros.org/Bags/Format/2.0.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.datasets.ros.open_file import OpenFile, expand, kept
from gnss_sem_map.errors import one_line
from gnss_sem_map.files.untrusted import refused, shown

Ints = NDArray[np.int64]

SIZE = struct.Struct("<I")
FIRST_READ = 4096
MOST_HEADER_BYTES = 1024
MESSAGE_FIELD = b"op=\x02"


class Ros1File:
    """Messages of the topics of one file; raises DataError when its index is missing or damaged."""

    def __init__(self, path: Path) -> None:
        from rosbags.rosbag1 import Reader, ReaderError
        from rosbags.rosbag1.reader import decompressors

        self.path = path
        self._file = OpenFile(path)
        reader = Reader(path)
        try:
            reader.open()
        except (ReaderError, struct.error, AssertionError, IndexError, ValueError, OSError) as error:
            raise refused(
                path,
                f"truncated, damaged or not indexed ({one_line(error, 120)}); repair it: rosbag reindex"
                f" {shown(path.name)}, and move the copy that it leaves (.orig.bag) to another folder",
            ) from None
        try:
            self.topics = {one.topic: (one.msgtype, "ros1") for one in reader.connections}
            names = {function: name for name, function in decompressors.items()}
            starts = sorted(reader.chunks)
            self._chunk = np.array(
                [(reader.chunks[start].datapos, reader.chunks[start].datasize) for start in starts], np.int64
            ).reshape(-1, 2)
            self._codecs = [names.get(reader.chunks[start].decompressor, "unknown") for start in starts]
            number = {start: k for k, start in enumerate(starts)}
            parts: dict[str, list[Ints]] = {}
            for one in reader.connections:
                rows = [
                    (entry.time, number[entry.chunk_pos], entry.offset) for entry in reader.indexes[one.id]
                ]
                parts.setdefault(one.topic, []).append(np.array(rows, np.int64).reshape(-1, 3))
        finally:
            reader.close()
        self._index = {topic: np.concatenate(rows) for topic, rows in parts.items()}
        self._chunk_of = kept(self._expanded)

    def index(self, topic: str) -> tuple[Ints, Ints]:
        """Arrival (n,), ns, and place (n, 2) of the messages of a topic, in the order of the file."""
        rows = self._index.get(topic, np.empty((0, 3), np.int64))
        return rows[:, 0], rows[:, 1:]

    def read(self, place: tuple[int, int], most: int | None = None) -> bytes:
        """The message at a place, or its first bytes."""
        chunk, offset = place
        if self._codecs[chunk] != "none":
            content = self._chunk_of(chunk)
            start, size = self._extent(content[offset : offset + MOST_HEADER_BYTES], len(content) - offset)
            return content[offset + start : offset + start + (size if most is None else min(most, size))]
        at, left = int(self._chunk[chunk, 0]) + offset, int(self._chunk[chunk, 1]) - offset
        first = self._file.read_up_to(at, FIRST_READ)
        start, size = self._extent(first, left)
        wanted = size if most is None else min(most, size)
        return (
            first[start : start + wanted]
            if start + wanted <= len(first)
            else self._file.read(at + start, wanted)
        )

    def _extent(self, head: bytes, left: int) -> tuple[int, int]:
        """Where the data of the record begin, that itself begins with `head`, and their size."""
        fields = SIZE.unpack_from(head)[0] if len(head) >= SIZE.size else MOST_HEADER_BYTES
        start = 2 * SIZE.size + fields
        size = SIZE.unpack_from(head, SIZE.size + fields)[0] if start <= len(head) else left
        if MESSAGE_FIELD not in head[: SIZE.size + fields] or start + size > left:
            raise refused(self.path, "damaged; found no message where the index says; rosbag reindex")
        return start, size

    def _expanded(self, chunk: int) -> bytes:
        start, size = self._chunk[chunk].tolist()
        return expand(self._file.read(start, size), self._codecs[chunk], f"{shown(self.path)}: chunk {chunk}")
