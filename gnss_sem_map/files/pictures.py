"""PNG and JPEG files: the size is read from the header before decoding, and damaged files are refused."""

from __future__ import annotations

import io
import struct
import warnings
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageFile

from gnss_sem_map.errors import DataError, ImageSizeError, one_line
from gnss_sem_map.files.untrusted import read_bytes, shown

MOST_PIXELS, LONGEST_SIDE = 64_000_000, 65_535
MOST_FILE_BYTES = 256 << 20
PNG, JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff"
DEPTH = len(PNG) + 16
"""Offset of the bit depth in a PNG."""
FAULTS = (
    OSError, SyntaxError, ValueError, TypeError, KeyError, IndexError, EOFError, OverflowError, ZeroDivisionError,
    struct.error, zlib.error,
)  # fmt: skip
"""Exceptions of Pillow for damaged files."""

Image.MAX_IMAGE_PIXELS = None  # our own limit is lower, and an error in place of a warning
warnings.filterwarnings("ignore", "Invalid APNG", UserWarning)  # an animation that is none is a plain picture


def read_picture(
    path: Path, size: tuple[int, int] | None = None, needs_colour: bool = False
) -> NDArray[np.uint8]:
    """RGB pixels (h, w, 3) of a PNG or JPEG.

    Raises DataError for a damaged one, one of more than 8 bits a channel, one of another (width, height), and where
    `needs_colour` one of other than three channels.
    """
    return decoded_picture(shown(path), read_bytes(path, MOST_FILE_BYTES), size, needs_colour)


def decoded_picture(
    where: str, content: bytes, size: tuple[int, int] | None = None, needs_colour: bool = False
) -> NDArray[np.uint8]:
    """RGB pixels (h, w, 3) of the content of a PNG or JPEG; `where` is its name in errors. See `read_picture`."""
    with _opened(where, content) as picture:
        _check_size(where, picture.size, size)
        if needs_colour and picture.mode not in ("RGB", "P"):
            raise DataError(f"{where}: found {_described(picture, content)}, expected 8-bit colour")
        if _depth(content) > 8:  # converted to RGB, whatever is above 255 would be white
            raise DataError(
                f"{where}: found {_described(picture, content)}, expected 8 bits a channel; convert the images first"
            )
        return np.array(picture.convert("RGB"))


@dataclass(frozen=True, eq=False)
class LabelPixels:
    """The values of a label image: grey ones are ids, colours are colours, by a palette or of equal parts either."""

    ids: NDArray[Any] | None
    """(h, w), uint8 or uint16."""
    colours: NDArray[Any] | None
    """(h, w), int32: 0xRRGGBB."""


def read_labels(path: Path) -> LabelPixels:
    """The values of a PNG: grey of up to 16 bits, by a palette, or colours of 8 bits; raises DataError for others."""
    content = read_bytes(path, MOST_FILE_BYTES)
    with _opened(shown(path), content) as picture:
        depth, grey = _depth(content), picture.mode in ("1", "L", "LA", "I", "I;16", "I;16B")
        if not content.startswith(PNG) or (depth > 8 and (not grey or picture.mode == "LA")):
            raise DataError(
                f"{shown(path)}: found {_described(picture, content)}, expected a PNG of class ids of 8 or 16 bits, or"
                " of colours of 8 bits"
            )
        if grey:
            whole = picture.getchannel(0) if picture.mode == "LA" else picture
            if depth > 8:
                return LabelPixels(np.array(whole, np.uint16), None)
            # Pillow spreads grey values of less than 8 bits over 0 to 255, but for those of one bit
            step = 255 // (2**depth - 1) if depth > 1 else 1
            return LabelPixels(np.array(whole, np.uint8) // np.uint8(step), None)
        red, green, blue, _ = np.array(picture.convert("RGBA"), np.int32).transpose(2, 0, 1)
        ids = np.array(picture) if picture.mode == "P" else None
        if ids is None and (red == green).all() and (red == blue).all():  # grey, saved as colours
            ids = red.astype(np.uint8)
        return LabelPixels(ids, red << 16 | green << 8 | blue)


@contextmanager
def _opened(where: str, content: bytes) -> Iterator[ImageFile.ImageFile]:
    """Open a picture with a valid header and valid checksums; raises DataError, also while it is decoded."""
    kind = "PNG" if content.startswith(PNG) else "JPEG" if content.startswith(JPEG) else None
    if kind is None:
        raise DataError(f"{where}: damaged image; expected PNG or JPEG")
    try:
        with Image.open(io.BytesIO(content), formats=(kind,)) as picture:
            width, height = picture.size
            if width * height > MOST_PIXELS or max(width, height) > LONGEST_SIDE:
                raise ValueError(f"{width} x {height} pixels, at most {MOST_PIXELS}")
            picture.verify()
        with Image.open(io.BytesIO(content), formats=(kind,)) as picture:
            yield picture
    except DataError:
        raise
    except FAULTS as error:
        reason = one_line(error, 100)
        raise DataError(f"{where}: damaged image ({reason}); expected PNG or JPEG") from None


def _depth(content: bytes) -> int:
    return content[DEPTH] if content.startswith(PNG) else 8


def _described(picture: ImageFile.ImageFile, content: bytes) -> str:
    """Description of a picture for messages."""
    shape = (picture.height, picture.width, len(picture.getbands()))
    return f"uint{_depth(content)} {shape}{' by a palette' if picture.mode == 'P' else ''}"


def _check_size(where: str, found: tuple[int, int], size: tuple[int, int] | None) -> None:
    if size is not None and found != size:
        raise ImageSizeError(
            f"{where}: found {found[0]} x {found[1]} pixels, expected {size[0]} x {size[1]} as in the"
            " calibration; is this the right camera, and the rectified image?",
            found,
        )
