"""Class probabilities of images: their types, and the checks that every source of them must pass."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.files.untrusted import refused
from gnss_sem_map.sensor_log import Image


@dataclass(frozen=True, eq=False)
class LabelImage:
    """A label image: an id for every pixel, and the class probabilities of each id."""

    ids: NDArray[np.uint8]
    """(h, w)."""
    table: NDArray[np.uint8]
    """(256, c) round(255 p), one row per id."""

    @property
    def probabilities(self) -> NDArray[np.uint8]:
        """Class probabilities of every pixel, (h, w, c)."""
        return np.take(self.table, self.ids, axis=0)


@runtime_checkable
class KeepsLabels(Protocol):
    """A segmenter that has label images. Most of their pixels are never used, so they are not expanded."""

    def kept(self, image: Image) -> NDArray[np.uint8] | NDArray[np.float32] | LabelImage:
        """The result of `Segmenter.__call__`, with a label image not expanded."""
        ...


HARD_LABEL_PROBABILITY = 0.9
"""Probability of the class of a pixel that comes without any; the rest is spread evenly over the other classes."""


def of_hard_labels(count: int) -> NDArray[np.float32]:
    """Class probabilities (count, count) of a pixel of each class, where only its class is told."""
    rest = (1 - HARD_LABEL_PROBABILITY) / max(count - 1, 1)
    return np.where(np.eye(count, dtype=bool), HARD_LABEL_PROBABILITY, rest).astype(np.float32)


LARGEST_SHRINK = 16
"""Probabilities may be this many times smaller than the image."""


def shrink_of(shape: tuple[int, ...], image_size: tuple[int, int], where: str) -> int:
    """Pixels of an image (width, height) along each axis per pixel of its labels (h, w, ...), 1 to LARGEST_SHRINK.

    Raises DataError unless (h, w) is the image's size divided by such a number and rounded down.
    """
    width, height = image_size
    for shrink in range(1, LARGEST_SHRINK + 1):
        if shape[:2] == (height // shrink, width // shrink):
            return shrink
    raise refused(
        where,
        f"found {shape[1]} x {shape[0]} pixels for an image of {width} x {height}; or that by 2 to {LARGEST_SHRINK}",
    )


def check_shape(shape: tuple[int, ...], dtype: np.dtype[Any], count: int, where: str) -> None:
    """Raise DataError unless this is the shape and type of the probabilities of `count` classes."""
    if len(shape) != 3 or shape[2] != count or 0 in shape:
        raise refused(where, f"found probabilities {shape}, expected (h, w, {count})")
    if dtype != np.uint8 and dtype.kind != "f":
        raise refused(where, f"found probabilities of {dtype}, expected uint8 round(255 p) or floating 0..1")


def checked_probabilities(
    probabilities: NDArray[Any], count: int, where: str
) -> NDArray[np.uint8] | NDArray[np.float32]:
    """The array (h, w, count) as uint8 or float32; raises DataError unless the sum of every pixel is one or zero."""
    check_shape(probabilities.shape, probabilities.dtype, count, where)
    one, slack = 1.0, 0.02
    if probabilities.dtype == np.uint8:
        one, slack = 255.0, 2.0 * count  # of rounding
    else:
        with np.errstate(over="ignore"):
            probabilities = probabilities.astype(np.float32)
        if not (np.isfinite(probabilities).all() and (probabilities >= 0).all()):
            raise refused(where, "found probabilities that are negative or not finite, expected 0..1")
    # Every 64th pixel is enough to tell probabilities from logits, percentages and 0/1 masks.
    largest = float(probabilities[::8, ::8].sum(2, dtype=np.float64).max(initial=0.0))
    if largest > one + slack or 0 < largest < one / 2:
        raise refused(where, f"probabilities sum to {largest:.4g}, expected {one:g}; normalise them")
    return probabilities


def resized_softmax(logits: NDArray[np.float32], size: tuple[int, int]) -> NDArray[np.float32]:
    """Class logits (c, h, w), enlarged bilinearly to (height, width), as probabilities (height, width, c)."""
    import cv2

    parts = [
        cv2.resize(np.ascontiguousarray(part.transpose(1, 2, 0)), size[::-1], interpolation=cv2.INTER_LINEAR)
        for part in (
            logits[i : i + 64] for i in range(0, len(logits), 64)
        )  # OpenCV takes 128 channels at most
    ]
    enlarged = np.concatenate([part.reshape(*size, -1) for part in parts], axis=2)
    exponentials = np.exp(enlarged - enlarged.max(2, keepdims=True))
    return np.asarray(exponentials / exponentials.sum(2, keepdims=True), np.float32)
