"""Range images of the scans before a chunk, which wait on disk until it is decided what moved in it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.dynamics.visibility import SCANS_PER_PART, KeyframeScans, RangeImage

NAME = "images.npy"


@dataclass(frozen=True, eq=False)
class WaitingImages:
    """Range images in a file, a part in memory at a time: those of a window of scans take 18 MB."""

    path: Path
    without_images: KeyframeScans
    """Poses and rows of all of them."""

    @classmethod
    def write(cls, scans: Sequence[RangeImage], folder: Path) -> WaitingImages | None:
        """Write the images of some scans in place of those before, None where there are none; raises OSError."""
        if not scans:
            return None
        path = folder / NAME
        with path.open("wb") as file:
            for start in range(0, len(scans), SCANS_PER_PART):
                images = np.stack([one.image for one in scans[start : start + SCANS_PER_PART]])
                np.save(file, images, allow_pickle=False)
        poses = np.stack([one.T_lidar_map for one in scans])
        return cls(path, KeyframeScans(np.empty((len(scans), 0, 0), np.uint16), poses, scans[0].rows))

    @property
    def T_lidar_map(self) -> NDArray[np.float64]:
        """(k, 4, 4): poses."""
        return self.without_images.T_lidar_map

    def parts(self) -> Iterator[KeyframeScans]:
        """The scans, some at a time; raises OSError."""
        with self.path.open("rb") as file:
            for part in self.without_images.parts():
                yield replace(part, images=np.load(file, allow_pickle=False))
