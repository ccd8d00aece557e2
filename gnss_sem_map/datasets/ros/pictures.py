"""Image and CompressedImage messages as RGB pixels."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.datasets.ros.bag import Bag, Messages
from gnss_sem_map.datasets.ros.decoding import decode
from gnss_sem_map.errors import DataError, ImageSizeError
from gnss_sem_map.files.pictures import MOST_PIXELS, decoded_picture

RAW, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
CHANNELS = {"rgb8": (0, 1, 2), "bgr8": (2, 1, 0), "mono8": (0, 0, 0), "8UC1": (0, 0, 0), "8UC3": (2, 1, 0)}
"""Which channel is red, green, blue; 8UC3 is OpenCV's order."""


def read_image(bag: Bag, messages: Messages, k: int, size: tuple[int, int] | None) -> NDArray[np.uint8]:
    """RGB pixels (h, w, 3); raises DataError for a damaged image, another encoding, or another (width, height)."""
    message, where = decode(bag, messages, k), f"{messages.topic}: message {k}"
    if messages.kind == COMPRESSED:
        return decoded_picture(where, bytes(np.asarray(message.data, np.uint8)), size)
    return _raw(message, where, size)


def _raw(message: Any, where: str, size: tuple[int, int] | None) -> NDArray[np.uint8]:
    width, height, step = int(message.width), int(message.height), int(message.step)
    order = CHANNELS.get(message.encoding)
    if order is None:
        raise DataError(
            f"{where}: found encoding {message.encoding[:40]!r}, expected rgb8, bgr8 or mono8; debayer or convert the"
            " images when they are recorded"
        )
    if size is not None and (width, height) != size:
        raise ImageSizeError(
            f"{where}: found {width} x {height} pixels, expected {size[0]} x {size[1]} as in the calibration",
            (width, height),
        )
    depth, data = max(order) + 1, np.asarray(message.data, np.uint8)
    if not 0 < width * height <= MOST_PIXELS or step < width * depth or data.size < step * height:
        raise DataError(
            f"{where}: damaged image; found {data.size} bytes for {width} x {height} pixels in rows of {step} bytes"
        )
    rows = data[: step * height].reshape(height, step)[:, : width * depth].reshape(height, width, depth)
    return np.ascontiguousarray(rows[:, :, order])
