"""Sizes that a LAS or LAZ tells of its parts, compared with that of the file before its reader takes memory for them.

Offsets are those of the LAS 1.4 specification (ASPRS) and of LASzip's chunks.
"""

from __future__ import annotations

import os
import struct
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

from gnss_sem_map.files.untrusted import refused

if TYPE_CHECKING:
    from laspy import LasHeader

HEADER_BYTES, VLR_BYTES, EVLR_BYTES = 375, 54, 60
MOST_CHUNK_BYTES = 256 << 20
"""Of points, expanded: a chunk is expanded as a whole."""
LAYERS, MORE_LAYERS = 9, {7: 1, 8: 2, 9: 1, 10: 3}
"""Of compressed points of format 6, and further ones of other formats; each extra byte has one of its own."""


def checked(file: BinaryIO, path: Path) -> BinaryIO:
    """The file, at its start; raises DataError where its header counts more than the file can hold."""
    size, head = os.fstat(file.fileno()).st_size, file.read(HEADER_BYTES).ljust(HEADER_BYTES, b"\0")
    if head.startswith(b"LASF"):
        header, points_at, vlrs, kind, record, points = struct.unpack_from("<HIIBHI", head, 94)
        evlrs_at = evlrs = 0
        if head[25] >= 4:  # LAS 1.4
            evlrs_at, evlrs, points = struct.unpack_from("<QIQ", head, 235)
        _refuse("header records", header + vlrs * VLR_BYTES, size, path)
        _refuse("bytes before the points", points_at, size, path)
        if kind & 0xC0:  # of a LAZ, points are as short as they are alike, but each chunk has one
            _refuse("chunks of points", _chunks(file, points_at, size) * record, size, path)
        else:
            _refuse("points", points_at + points * record, size, path)
        for _ in range(evlrs):
            _refuse("extended header records", evlrs_at + EVLR_BYTES, size, path)
            file.seek(evlrs_at + 20)
            evlrs_at += EVLR_BYTES + int.from_bytes(file.read(8), "little")
            _refuse("extended header records", evlrs_at, size, path)
    file.seek(0)
    return file


def check_chunks(file: BinaryIO, header: LasHeader, path: Path) -> None:
    """Raise DataError where chunks of a LAZ are larger than it, or the layers of one, from LAS 1.4 on, than the chunk.

    Raises LazrsError for a table of chunks that is damaged.
    """
    import lazrs

    if not header.are_points_compressed:
        return
    [about] = header.vlrs.get("LasZipVlr")[:1] or [None]
    if about is None:
        raise refused(path, "is compressed and has no LASzip record; is it damaged?")
    vlr, record, before = lazrs.LazVlr(about.record_data), header.point_format.size, file.tell()
    layers = LAYERS + MORE_LAYERS.get(header.point_format.id, 0) + header.point_format.num_extra_bytes
    file.seek(header.offset_to_point_data)
    table, at = lazrs.read_chunk_table(file, vlr), header.offset_to_point_data + 8
    size = os.fstat(file.fileno()).st_size
    for points, there in [(0 if vlr.uses_variable_size_chunks() else vlr.chunk_size(), 0), *table]:
        _refuse("points of a chunk", points * record, MOST_CHUNK_BYTES, path)
        _refuse("chunks", at + there, size, path)
        if there and header.point_format.id >= 6:
            file.seek(at + record + 4)
            sizes = struct.unpack(f"<{layers}I", file.read(4 * layers))
            _refuse("layers of points", sum(sizes), there, path)
        at += there
    file.seek(before)


def _chunks(file: BinaryIO, points_at: int, size: int) -> int:
    """Number of chunks that the table of a LAZ begins with."""
    file.seek(points_at)
    table_at = int.from_bytes(file.read(8), "little", signed=True)
    if table_at == -1:  # it was written to a stream
        file.seek(max(size - 8, 0))
        table_at = int.from_bytes(file.read(8), "little", signed=True)
    file.seek(min(max(table_at + 4, 0), size))
    return int.from_bytes(file.read(4), "little")


def _refuse(what: str, least: int, most: int, path: Path) -> None:
    if least > most:
        raise refused(path, f"its {what} need {least} bytes, and there are {most}; is it truncated?")
