"""Preparation of camera pixels for a network."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.errors import ConfigError, DataError
from gnss_sem_map.sensor_log import Image

STRIDE = 32
"""Of the coarsest features of most networks; images are stretched to whole multiples of it."""


def whole_strides(side: int) -> int:
    """The multiple of STRIDE nearest to a side, in pixels."""
    return max(STRIDE, STRIDE * round(side / STRIDE))


def checked_pixels(image: Image) -> NDArray[np.uint8]:
    """The RGB pixels (h, w, 3) of an image; raises DataError when they are grey, of 16 bits, or none."""
    pixels = image.read()
    if pixels.dtype != np.uint8 or pixels.ndim != 3 or pixels.shape[2] != 3 or pixels.size == 0:
        raise DataError(
            f"image {image.number}: found {pixels.dtype} {pixels.shape}, expected RGB (h, w, 3) uint8"
        )
    return pixels


def named(images: Sequence[Image], pixels: NDArray[np.uint8]) -> str:
    """The images of one size and that size, for messages: a network's errors depend on it."""
    numbers = ", ".join(str(image.number) for image in images)
    return f"image {numbers} of {pixels.shape[1]} x {pixels.shape[0]} pixels"


def scaled(
    pixels: NDArray[np.uint8],
    shrink: int,
    scale: float,
    to_whole: Callable[[int, int], tuple[int, int]] | None = None,
) -> NDArray[np.uint8]:
    """The pixels cut to sides that `shrink` divides, then resized to `scale` times that, rounded up.

    Takes and gives (h, w, 3); `to_whole` makes of (height, width) a size that the network takes. Raises DataError for
    an image smaller than `shrink`.
    """
    import cv2

    height, width = (side - side % shrink for side in pixels.shape[:2])
    if min(height, width) == 0:
        raise DataError(f"found {pixels.shape[1]} x {pixels.shape[0]} pixels, expected {shrink} or more")
    cut = np.ascontiguousarray(pixels[:height, :width])
    wanted = int(np.ceil(height * scale)), int(np.ceil(width * scale))
    wanted = wanted if to_whole is None else to_whole(*wanted)
    if wanted == (height, width):
        return cut
    method = cv2.INTER_AREA if wanted[0] < height else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(cut, wanted[::-1], interpolation=method), np.uint8)


def scale_and_shrink(
    scale: str | None, shrink: str | None, where: str, usual_scale: float = 1.0
) -> tuple[float, int]:
    """The options of the same names as numbers; raises ConfigError unless 0.1 <= scale <= 4 and 1 <= shrink <= 16."""
    try:
        as_scale = usual_scale if scale is None else float(scale)
        as_shrink = 2 if shrink is None else int(shrink)
        if not (0.1 <= as_scale <= 4 and 1 <= as_shrink <= 16):
            raise ValueError
    except ValueError:
        raise ConfigError(f"{where}: found {scale=}, {shrink=}; expected 0.1 to 4, and 1 to 16") from None
    return as_scale, as_shrink
