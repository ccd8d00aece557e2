"""Points of one scan that wait on disk until it is decided which of them moved: they need half the memory of a run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.dynamics.moving_objects import NearPoints
from gnss_sem_map.mapping.labelled_scans import LabelledScan

WAITING = ".waiting"
"""Ending of the folders of such files."""
OF_POINTS: list[tuple[type[np.generic], int]] = [
    (np.int32, 1), (np.float32, 3), (np.bool_, 1), (np.int32, 1), (np.int64, 1), (np.uint8, 1), (np.int32, 1),
]  # fmt: skip
"""Type and columns of what a file holds of each point: bare arrays, as sixteen headers took 0.9 ms per scan."""


@dataclass(frozen=True, eq=False)
class WaitingPoints:
    """The points of a scan in or near a segment (h,), as they were fused."""

    near: NearPoints
    keys: NDArray[np.int64]
    """(h,) the voxel of each."""
    heights: NDArray[np.uint8]
    """(h,) how high each lies in its voxel."""
    pixels: NDArray[np.int32]
    """(h,) row of `classes` for each point, -1 if the image does not show it."""
    classes: NDArray[np.uint8]
    """(p, c + 1) class probabilities."""

    @classmethod
    def of(cls, seen: LabelledScan, near: NearPoints) -> WaitingPoints:
        """What a scan with labels says of its points in or near a segment."""
        here = near.indices
        pixels = seen.pixels[here]
        shown = pixels >= 0
        rows = np.full(len(here), -1, np.int32)
        rows[shown] = np.arange(np.count_nonzero(shown))
        return cls(near, seen.keys[here], seen.heights[here], rows, seen.classes[pixels[shown]])

    def write(self, path: Path) -> None:
        """Write them into a file of their own; raises OSError."""
        near = self.near
        arrays: list[NDArray[Any]] = [near.indices, near.p_near, near.is_body, near.voxel]
        arrays += [self.keys, self.heights, self.pixels]
        with path.open("wb") as file:
            file.write(np.array([len(self.keys), *self.classes.shape], np.int64).tobytes())
            for array, (dtype, _) in zip(arrays, OF_POINTS, strict=True):
                file.write(np.ascontiguousarray(array, dtype).data)
            file.write(np.ascontiguousarray(self.classes, np.uint8).data)

    @classmethod
    def take(cls, path: Path) -> WaitingPoints:
        """Read them and remove the file; raises OSError."""
        with path.open("rb") as file:
            count, *shape = np.fromfile(file, np.int64, 3)
            arrays = [
                np.fromfile(file, dtype, count * columns).reshape((count, columns) if columns > 1 else count)
                for dtype, columns in OF_POINTS
            ]
            classes = np.fromfile(file, np.uint8, shape[0] * shape[1]).reshape(shape)
        path.unlink()
        keys, heights, pixels = arrays[4:]
        return cls(NearPoints(*arrays[:4]), keys, heights, pixels, classes)
