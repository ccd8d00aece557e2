"""Compressed parts of bags, expanded with a limit on their size."""

from __future__ import annotations

from collections.abc import Callable

from gnss_sem_map.errors import DataError, one_line

MOST_BYTES = 1 << 30
"""Of a chunk or a message; recorders write chunks of 1 to 10 MB."""


def expand(data: bytes, codec: str, where: str, most: int = MOST_BYTES) -> bytes:
    """The content of compressed bytes, its first `most` bytes; raises DataError for an unknown codec, or damage."""
    if codec in ("", "none"):
        return data[:most]
    if codec not in _DECOMPRESSORS:
        raise DataError(
            f"{where}: is compressed with {codec[:40]!r}, which is not here; expected none, lz4, zstd or bz2; record"
            " or convert it with one of these"
        )
    try:
        return _DECOMPRESSORS[codec](data, most)
    except (OSError, RuntimeError, ValueError, EOFError) as error:
        raise DataError(f"{where}: damaged {codec} data ({one_line(error, 100)})") from None


def _bz2(data: bytes, most: int) -> bytes:
    from bz2 import BZ2Decompressor

    return BZ2Decompressor().decompress(data, most)


def _lz4(data: bytes, most: int) -> bytes:
    from lz4.frame import LZ4FrameDecompressor

    return bytes(LZ4FrameDecompressor().decompress(data, most))


def _zstd(data: bytes, most: int) -> bytes:
    import sys

    if sys.version_info >= (3, 14):
        from compression.zstd import ZstdDecompressor, ZstdError
    else:
        from backports.zstd import ZstdDecompressor, ZstdError
    try:
        return bytes(ZstdDecompressor().decompress(data, most))
    except ZstdError as error:
        raise ValueError(str(error)) from None


_DECOMPRESSORS: dict[str, Callable[[bytes, int], bytes]] = {"bz2": _bz2, "lz4": _lz4, "zstd": _zstd}
