"""PNG files of a simulated camera."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from gnss_sem_map.errors import DataError


def write_photo(path: Path, rgb: npt.NDArray[np.uint8]) -> None:
    """Write what a camera sees, (h, w, 3).

    Noise leaves no repetitions to compress. Without a search for them a file takes half of the time, and is smaller.
    """
    huffman = (cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY)
    up = (cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_UP)
    _write(path, cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), *huffman, *up)


def write_ids(path: Path, ids: npt.NDArray[np.uint8]) -> None:
    """Write the class of every pixel, (h, w); unfiltered, these are read four times as fast."""
    _write(path, ids, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_NONE)


def _write(path: Path, pixels: npt.NDArray[Any], *options: int) -> None:
    ok, data = cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 1, *options])
    if not ok:
        raise DataError(f"{path}: the image could not be encoded")
    path.write_bytes(data.tobytes())
