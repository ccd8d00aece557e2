"""Points of one scan that wait on disk until it is decided which of them moved: they need half the memory of a run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.dynamics.moving_objects import NearPoints
from gnss_sem_map.mapping.labelled_scans import LabelledScan

WAITING = ".waiting"
"""Ending of the folders of such files."""
ROW = np.dtype([
    ("index", np.int32), ("p_near", np.float32, 3), ("is_body", np.bool_), ("voxel", np.int32),
    ("key", np.int64), ("height", np.uint8), ("level", np.int16), ("moment_us", np.int64), ("pixel", np.int32),
])  # fmt: skip
"""A point in the file: one table, as the headers of so many arrays took 0.9 ms per scan."""


@dataclass(frozen=True, eq=False)
class WaitingPoints:
    """The points of a scan in or near a segment (h,), as they were fused."""

    near: NearPoints
    keys: NDArray[np.int64]
    """(h,) the voxel of each."""
    heights: NDArray[np.uint8]
    """(h,) how high each lies in its voxel."""
    levels: NDArray[np.int16]
    """(h,) intensity of each, see `voxels.attribute_table`."""
    moments_us: NDArray[np.int64]
    """(h,) when each was measured."""
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
        return cls(
            near, seen.keys[here], seen.heights[here], seen.levels[here], seen.moments_us[here],
            rows, seen.classes[pixels[shown]],
        )  # fmt: skip

    def write(self, path: Path) -> None:
        """Write them into a file of their own; raises OSError."""
        near = self.near
        columns = (
            near.indices, near.p_near, near.is_body, near.voxel,
            self.keys, self.heights, self.levels, self.moments_us, self.pixels,
        )  # fmt: skip
        rows = np.empty(len(self.keys), ROW)
        for name, column in zip(ROW.names or (), columns, strict=True):
            rows[name] = column
        with path.open("wb") as file:
            np.save(file, rows, allow_pickle=False)
            np.save(file, self.classes, allow_pickle=False)

    @classmethod
    def take(cls, path: Path) -> WaitingPoints:
        """Read them and remove the file; raises OSError."""
        with path.open("rb") as file:
            rows, classes = (np.load(file, allow_pickle=False) for _ in range(2))
        path.unlink()
        *near, keys, heights, levels, moments_us, pixels = (
            np.ascontiguousarray(rows[name]) for name in ROW.names or ()
        )
        return cls(NearPoints(*near), keys, heights, levels, moments_us, pixels, classes)
