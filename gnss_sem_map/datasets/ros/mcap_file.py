"""An MCAP file: where its messages are, by the indexes at the end of the file and of each chunk.

Record layouts: the MCAP specification, https://mcap.dev/spec. `mcap` reads the summary; messages are read by their
place, so that one of them costs the same in a file of any length. Each channel says how its messages are encoded, by
its schema or itself: what profile the file has is not asked.
"""

from __future__ import annotations

import struct
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.datasets.ros.open_file import MOST_BYTES, OpenFile, expand, kept
from gnss_sem_map.errors import one_line
from gnss_sem_map.files.untrusted import refused, shown

if TYPE_CHECKING:
    from mcap.records import Channel, McapRecord, Schema

Ints = NDArray[np.int64]

MESSAGE_INDEX, MESSAGE = 0x07, 0x05
RECORD = struct.Struct("<BQ")
MESSAGE_HEAD = struct.Struct("<BQHIQQ")
"""Op code and length of the record; channel, sequence, log time and publish time of the message."""
CHUNK_HEAD_BYTES = 9 + 40
"""Of a chunk record before its compression's name and its data."""
FIRST_READ = 4096
MAGIC = b"\x89MCAP0\r\n"
FOOTER = struct.Struct("<BQQQI8s")
MOST_SUMMARY_BYTES = 256 << 20
DAMAGED = (struct.error, TypeError, ValueError, KeyError, OverflowError)
"""What damaged bytes raise, beside McapError."""
OF_SCHEMA = {"ros1msg": "ros1", "ros2msg": "cdr", "ros2idl": "cdr", "omgidl": "cdr"}
"""How messages are encoded that have a schema of ROS."""


class McapFile:
    """Messages of the topics of one file; raises DataError when its index is missing or damaged."""

    def __init__(self, path: Path, codec: str = "") -> None:
        from mcap import records
        from mcap.exceptions import McapError

        self.path, self._codec = path, codec
        self._file = OpenFile(path)
        try:
            found = self._summary()
            chunks = [one for one in found if isinstance(one, records.ChunkIndex)]
            sizes = [(chunk.compressed_size, chunk.uncompressed_size) for chunk in chunks]
            spans = [(one.chunk_start_offset + one.chunk_length, one.message_index_length) for one in chunks]
            self._starts = np.array([chunk.chunk_start_offset for chunk in chunks], np.int64)
            self._sizes, self._spans = (np.array(rows, np.int64).reshape(-1, 2) for rows in (sizes, spans))
        except (McapError, *DAMAGED) as error:
            raise refused(
                path,
                f"truncated, damaged or not closed ({one_line(error, 120)}); repair it: mcap recover"
                f" {shown(path.name)} -o repaired.mcap, and move {shown(path.name)} to another folder",
            ) from None
        self._codecs = [chunk.compression for chunk in chunks]
        schemas = {one.id: one for one in found if isinstance(one, records.Schema)}
        channels = {one.id: one for one in found if isinstance(one, records.Channel)}
        self.topics = {one.topic: _kind_of(one, schemas.get(one.schema_id)) for one in channels.values()}
        self._chunk_of = kept(self._expanded)
        self._index = self._read_indexes({number: one.topic for number, one in channels.items()})
        indexed = sum(len(times) for times, _ in self._index.values())
        counts = [one.message_count for one in found if isinstance(one, records.Statistics)]
        expected = counts[0] if counts else 1
        if indexed < expected:
            raise refused(
                path,
                f"not indexed ({indexed} of {expected} messages have a place); write an index: mcap"
                f" recover {shown(path.name)} -o repaired.mcap, and move {shown(path.name)} to another folder",
            )

    def _summary(self) -> list[McapRecord]:
        """The records between the data and the footer; raises McapError or one of DAMAGED for a file without."""
        from mcap.stream_reader import StreamReader

        ends = self._file.size - FOOTER.size
        if self._file.read_up_to(0, len(MAGIC)) != MAGIC or ends < 0:
            raise ValueError("it does not begin as an MCAP file")
        *_, start, _, _, magic = FOOTER.unpack(self._file.read_up_to(ends, FOOTER.size))
        if magic != MAGIC:
            raise ValueError("it does not end as an MCAP file")
        if start and not 0 < ends - start <= MOST_SUMMARY_BYTES:
            raise ValueError(f"a summary from byte {start} on")
        start = start or ends
        content = self._file.read_up_to(start, self._file.size - start)
        return list(StreamReader(BytesIO(content), skip_magic=True).records)

    def index(self, topic: str) -> tuple[Ints, Ints]:
        """Arrival (n,), ns, and place (n, 2) of the messages of a topic, in the order of the file."""
        return self._index.get(topic, (np.empty(0, np.int64), np.empty((0, 2), np.int64)))

    def read(self, place: tuple[int, int], most: int | None = None) -> bytes:
        """The message at a place, or its first bytes."""
        chunk, offset = place
        if self._codecs[chunk] in ("", "none"):
            data = self._plain(chunk, offset, None if self._codec else most)
        else:
            data = self._within(self._chunk_of(chunk), offset)
        if self._codec:
            return expand(data, self._codec, shown(self.path), most or MOST_BYTES)
        return data if most is None else data[:most]

    def _read_indexes(self, channels: dict[int, str]) -> dict[str, tuple[Ints, Ints]]:
        found: dict[str, list[tuple[int, NDArray[np.uint64]]]] = {}
        for number, (start, length) in enumerate(self._spans.tolist()):
            records = self._file.read(start, length)
            at = 0
            while at + RECORD.size <= len(records):
                op, size = RECORD.unpack_from(records, at)
                at += RECORD.size
                if op == MESSAGE_INDEX and 6 <= size <= len(records) - at and (size - 6) % 16 == 0:
                    channel = int.from_bytes(records[at : at + 2], "little")
                    pairs = np.frombuffer(records, "<u8", (size - 6) // 8, at + 6).reshape(-1, 2)
                    if channel in channels:
                        found.setdefault(channels[channel], []).append((number, pairs))
                at += size
        return {topic: _joined(parts) for topic, parts in found.items()}

    def _plain(self, chunk: int, offset: int, most: int | None) -> bytes:
        """A message of a chunk that is not compressed: nothing else of it is read."""
        start = int(self._starts[chunk]) + CHUNK_HEAD_BYTES + len(self._codecs[chunk]) + offset
        first = self._file.read_up_to(start, FIRST_READ)
        size = self._size_of(first, int(self._sizes[chunk, 0]) - offset)
        wanted = size if most is None else min(most, size)
        if wanted <= len(first) - MESSAGE_HEAD.size:
            return first[MESSAGE_HEAD.size : MESSAGE_HEAD.size + wanted]
        return self._file.read(start + MESSAGE_HEAD.size, wanted)

    def _within(self, content: bytes, offset: int) -> bytes:
        size = self._size_of(content[offset : offset + MESSAGE_HEAD.size], len(content) - offset)
        return content[offset + MESSAGE_HEAD.size : offset + MESSAGE_HEAD.size + size]

    def _size_of(self, head: bytes, left: int) -> int:
        """Bytes of the message whose record begins so; `left` are those from there to the end of its chunk."""
        op, size = RECORD.unpack_from(head) if len(head) >= MESSAGE_HEAD.size else (0, 0)
        size -= MESSAGE_HEAD.size - RECORD.size
        if op != MESSAGE or not 0 <= size <= left - MESSAGE_HEAD.size:
            raise refused(self.path, "damaged; found no message where the index says; mcap recover")
        return int(size)

    def _expanded(self, chunk: int) -> bytes:
        compressed, plain = self._sizes[chunk].tolist()
        start = int(self._starts[chunk]) + CHUNK_HEAD_BYTES + len(self._codecs[chunk])
        where = f"{shown(self.path)}: chunk {chunk}"
        content = expand(self._file.read(start, compressed), self._codecs[chunk], where)
        if len(content) != plain:
            raise refused(where, f"damaged; found {len(content)} bytes, expected {plain}")
        return content


def _kind_of(channel: Channel, schema: Schema | None) -> tuple[str, str]:
    """The type of a channel's messages, as ROS 2 writes it, and their encoding."""
    if schema is None:
        return "", channel.message_encoding
    name = schema.name.replace("::", "/")
    if name.count("/") == 1:
        name = name.replace("/", "/msg/")
    return name, OF_SCHEMA.get(schema.encoding, channel.message_encoding)


def _joined(parts: list[tuple[int, NDArray[np.uint64]]]) -> tuple[Ints, Ints]:
    times = np.concatenate([pairs[:, 0] for _, pairs in parts]).astype(np.int64)
    places = [
        np.column_stack([np.full(len(pairs), number), pairs[:, 1].astype(np.int64)])
        for number, pairs in parts
    ]
    return times, np.concatenate(places)
