"""PNG and JPEG: the size is read from the header, and a damaged PNG is known before a decoder sees it.

The decoders would otherwise ask for as much memory as a header claims, print lines of their own, or make a grey half
of a picture that was cut short.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.errors import DataError, ImageSizeError
from gnss_sem_map.untrusted.files import read_bytes, shown

MOST_PIXELS, LONGEST_SIDE = 64_000_000, 65_535
MOST_FILE_BYTES = 256 << 20
PNG, JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff"
KEPT_CHUNKS = (b"IHDR", b"PLTE", b"IDAT", b"IEND")
CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}
DEPTHS = {0: (1, 2, 4, 8, 16), 2: (8, 16), 3: (1, 2, 4, 8), 4: (8, 16), 6: (8, 16)}
GREY, COLOUR, PALETTE = 0, 2, 3
INTERLACED = (
    (0, 0, 8, 8),
    (4, 0, 8, 8),
    (0, 4, 4, 8),
    (2, 0, 4, 4),
    (0, 2, 2, 4),
    (1, 0, 2, 2),
    (0, 1, 1, 2),
)
"""Of the seven passes of Adam7: first column and line, and steps between them."""


@dataclass(frozen=True)
class PngHeader:
    """What a PNG says it is."""

    width: int
    height: int
    depth: int
    colour: int
    is_interlaced: bool

    def __str__(self) -> str:
        """What it is, in words."""
        palette = " by a palette" if self.colour == PALETTE else ""
        return f"uint{self.depth} ({self.height}, {self.width}, {CHANNELS[self.colour]}){palette}"

    @property
    def passes(self) -> list[tuple[int, int]]:
        """Lines, and bytes of each, of every pass."""
        steps = INTERLACED if self.is_interlaced else ((0, 0, 1, 1),)
        bits = CHANNELS[self.colour] * self.depth
        sizes = [(-(-(self.width - x) // dx), -(-(self.height - y) // dy)) for x, y, dx, dy in steps]
        return [(lines, 1 + -(-columns * bits // 8)) for columns, lines in sizes if columns > 0 and lines > 0]


def read_picture(
    path: Path, size: tuple[int, int] | None = None, needs_colour: bool = False
) -> NDArray[np.uint8]:
    """RGB pixels (h, w, 3) of a PNG or JPEG.

    Raises DataError for a damaged one, one of another (width, height), and where `needs_colour` one of other than three
    channels of 8 bits.
    """
    content = read_bytes(path, MOST_FILE_BYTES)
    if content.startswith(PNG):
        header, plain = _checked_png(path, content)
        _check_size(path, (header.width, header.height), size)
        if needs_colour and (header.colour not in (COLOUR, PALETTE) or header.depth > 8):
            raise DataError(f"{shown(path)}: found {header}, expected 8-bit colour")
        return np.ascontiguousarray(_decoded(path, plain, "IMREAD_COLOR")[:, :, ::-1])
    if content.startswith(JPEG):
        return _read_jpeg(path, content, size, needs_colour)
    raise DataError(f"{shown(path)}: damaged image; expected PNG or JPEG")


def read_ids(path: Path) -> NDArray[np.uint8]:
    """The values (h, w) of an 8-bit grey PNG; raises DataError for anything else."""
    content = read_bytes(path, MOST_FILE_BYTES)
    if not content.startswith(PNG):
        raise DataError(f"{shown(path)}: damaged label image; expected an 8-bit grey PNG of class ids")
    header, plain = _checked_png(path, content)
    if header.colour != GREY or header.depth != 8:
        raise DataError(
            f"{shown(path)}: found {header}, expected an 8-bit grey PNG of class ids, not colours"
        )
    _check_size(path, (header.width, header.height), None)
    return _decoded(path, plain, "IMREAD_GRAYSCALE")


def _decoded(path: Path, plain: bytes, mode: str) -> NDArray[np.uint8]:
    import cv2

    pixels: NDArray[Any] | None = cv2.imdecode(np.frombuffer(plain, np.uint8), getattr(cv2, mode))
    if pixels is None:
        raise DataError(f"{shown(path)}: damaged image; expected PNG or JPEG")
    return np.asarray(pixels, np.uint8)


def _checked_png(path: Path, content: bytes) -> tuple[PngHeader, bytes]:
    """The header of a PNG that is whole, and the file without what a decoder does not need."""
    try:
        chunks = list(_chunks(content))
        headers, palettes, lines, ends = ([c for c in chunks if c[0] == kind] for kind in KEPT_CHUNKS)
        if len(headers) != 1 or chunks[0] != headers[0] or not lines:
            raise ValueError("no header, or no pixels")
        header = _png_header(headers[0][1])
        if header.colour != PALETTE:
            palettes = []
        elif len(palettes) != 1 or len(palettes[0][1]) not in range(3, 769, 3):
            raise ValueError("no palette")
        _check_pixels(header, b"".join(data for _, data, _ in lines))
    except (ValueError, struct.error, zlib.error) as error:
        raise DataError(f"{shown(path)}: damaged image ({error}); expected PNG or JPEG") from None
    return header, PNG + b"".join(whole for _, _, whole in (*headers, *palettes, *lines, *ends))


def _chunks(content: bytes) -> Iterator[tuple[bytes, bytes, bytes]]:
    """Kind, data and all bytes of every chunk of a PNG."""
    place = len(PNG)
    while True:
        length, kind = struct.unpack_from(">I4s", content, place)
        end = place + 12 + length
        if end > len(content):
            raise ValueError("cut short")
        data = content[place + 8 : end - 4]
        if zlib.crc32(kind + data) != int.from_bytes(content[end - 4 : end], "big"):
            raise ValueError("a checksum is wrong")
        yield kind, data, content[place:end]
        if kind == b"IEND":
            if data:
                raise ValueError("an end that goes on")
            return
        place = end


def _png_header(data: bytes) -> PngHeader:
    width, height, depth, colour, compression, filters, interlace = struct.unpack(">IIBBBBB", data)
    if depth not in DEPTHS.get(colour, ()) or compression or filters or interlace > 1 or 0 in (width, height):
        raise ValueError("a header that says nothing")
    _check_count(width, height)
    return PngHeader(width, height, depth, colour, bool(interlace))


def _check_pixels(header: PngHeader, compressed: bytes) -> None:
    """Raise ValueError unless the compressed lines are all there, and no more, each with a filter that exists."""
    expected = sum(lines * size for lines, size in header.passes)
    unpacker = zlib.decompressobj()
    raw = np.frombuffer(unpacker.decompress(compressed, expected + 1), np.uint8)
    if len(raw) != expected or not unpacker.eof or unpacker.unused_data:
        raise ValueError("not as many pixels as its header says")
    place = 0
    for lines, size in header.passes:
        if raw[place : place + lines * size : size].max() > 4:
            raise ValueError("lines of an unknown filter")
        place += lines * size


def _read_jpeg(
    path: Path, content: bytes, size: tuple[int, int] | None, needs_colour: bool
) -> NDArray[np.uint8]:
    from PIL import Image

    try:
        with Image.open(io.BytesIO(content), formats=("JPEG",)) as picture:
            _check_count(*picture.size)
            _check_size(path, picture.size, size)
            if needs_colour and picture.mode != "RGB":
                raise DataError(f"{shown(path)}: found {picture.mode}, expected 8-bit colour")
            return np.array(picture.convert("RGB"))
    except DataError:
        raise
    except (
        OSError,
        SyntaxError,
        ValueError,
        TypeError,
        IndexError,
        KeyError,
        struct.error,
        ZeroDivisionError,
    ) as error:
        raise DataError(
            f"{shown(path)}: damaged image ({' '.join(str(error).split())[:100]}); expected PNG or JPEG"
        ) from None


def _check_count(width: int, height: int) -> None:
    if width * height > MOST_PIXELS or max(width, height) > LONGEST_SIDE:
        raise ValueError(f"{width} x {height} pixels, at most {MOST_PIXELS}")


def _check_size(path: Path, found: tuple[int, int], size: tuple[int, int] | None) -> None:
    if size is not None and found != size:
        raise ImageSizeError(
            f"{shown(path)}: found {found[0]} x {found[1]} pixels, expected {size[0]} x {size[1]} as in the"
            " calibration; is this the right camera, and the rectified image?",
            found,
        )
