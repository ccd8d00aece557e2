"""Image and CompressedImage messages as RGB pixels; OpenCV converts what is not."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.datasets.ros.bag import Bag, Messages
from gnss_sem_map.datasets.ros.kinds import COMPRESSED_IMAGE, decode
from gnss_sem_map.errors import ImageSizeError
from gnss_sem_map.files.pictures import JPEG, MOST_PIXELS, PNG, decoded_picture
from gnss_sem_map.files.untrusted import refused

ENCODINGS: dict[str, tuple[int, int, str]] = {
    **{
        f"{name}{8 * size}": (size, depth, code)
        for size in (1, 2)
        for name, depth, code in (
            ("rgb", 3, ""), ("bgr", 3, "BGR2RGB"), ("rgba", 4, "RGBA2RGB"), ("bgra", 4, "BGRA2RGB"),
            ("mono", 1, "GRAY2RGB"),
            *((f"bayer_{pattern.lower()}", 1, f"Bayer{pattern}2RGB") for pattern in ("RGGB", "BGGR", "GBRG", "GRBG")),
        )
    },
    "8uc1": (1, 1, "GRAY2RGB"), "8uc3": (1, 3, "BGR2RGB"), "8uc4": (1, 4, "BGRA2RGB"),
    "nv12": (1, 1, "YUV2RGB_NV12"), "nv21": (1, 1, "YUV2RGB_NV21"),
    **dict.fromkeys(("yuv422", "uyvy"), (1, 2, "YUV2RGB_UYVY")),
    **dict.fromkeys(("yuv422_yuy2", "yuyv"), (1, 2, "YUV2RGB_YUY2")),
}  # fmt: skip
"""Bytes of a number, numbers of a pixel, and OpenCV's conversion (none of RGB); of Image.encoding, in small letters.

Of NV12 and NV21, rows of colours stand below those of the grey picture, half as many.
"""


def read_image(
    _file: Path, bag: Bag, messages: Messages, k: int, size: tuple[int, int] | None
) -> NDArray[np.uint8]:
    """RGB pixels (h, w, 3) of a message; raises DataError for a damaged one, another encoding or (width, height)."""
    message, where = decode(bag, messages, k), f"{messages.topic}: message {k}"
    if why := unread_encoding(message):
        raise refused(
            where,
            f"found encoding {why!r}, expected PNG, JPEG, or one of {', '.join(ENCODINGS)}; convert it",
        )
    if messages.kind == COMPRESSED_IMAGE:
        picture = decoded_picture(where, bytes(np.asarray(message.data, np.uint8)), size)
        recorded = message.format.partition(";")[0].strip().lower()
        if recorded.startswith("bayer") and recorded in ENCODINGS and (picture == picture[..., :1]).all():
            return _as_rgb(
                np.ascontiguousarray(picture[..., :1]), ENCODINGS[recorded][2], where
            )  # a mosaic, as it was
        return picture
    return _raw(message, where, size)


def unread_encoding(message: Any) -> str:
    """The encoding of an image that is not read; empty where it is."""
    if hasattr(message, "encoding"):
        return "" if message.encoding.lower() in ENCODINGS else str(message.encoding)[:40] or "none"
    said = str(message.format).lower()
    is_said = any(name in said for name in ("png", "jpeg", "jpg")) and "compresseddepth" not in said
    is_seen = bytes(np.asarray(message.data[: len(PNG)], np.uint8)).startswith((PNG, JPEG))
    return "" if is_said or is_seen else str(message.format)[:40] or "none"


def _raw(message: Any, where: str, size: tuple[int, int] | None) -> NDArray[np.uint8]:
    width, height, step = int(message.width), int(message.height), int(message.step)
    if size is not None and (width, height) != size:
        raise ImageSizeError(
            f"{where}: found {width} x {height} pixels, expected {size[0]} x {size[1]} as in the calibration",
            (width, height),
        )
    of_number, depth, code = ENCODINGS[message.encoding.lower()]
    height += height // 2 if "NV" in code else 0
    row, data = width * depth * of_number, np.asarray(message.data, np.uint8)
    if not 0 < width * height <= MOST_PIXELS or step < row or data.size < step * height:
        raise refused(
            where,
            f"damaged; {data.size} bytes for {width} x {height} pixels in rows of {step}",
        )
    rows = data[: step * height].reshape(height, step)[:, :row]
    if of_number == 2:
        wide = np.ascontiguousarray(rows).view(">u2" if message.is_bigendian else "<u2")
        is_of_12_bits = wide.max() < 1 << 12  # all of it would be black
        rows = (wide >> (4 if is_of_12_bits else 8)).astype(np.uint8)
    return _as_rgb(np.ascontiguousarray(rows).reshape(height, width, depth), code, where)


def _as_rgb(pixels: NDArray[np.uint8], code: str, where: str) -> NDArray[np.uint8]:
    import cv2

    if not code:
        return pixels
    try:
        return np.asarray(cv2.cvtColor(pixels, getattr(cv2, f"COLOR_{code}")), np.uint8)
    except cv2.error:
        height, width = pixels.shape[:2]
        raise refused(where, f"{width} x {height} pixels are too few or odd for {code}") from None
