"""Points of one scan that wait on disk until it is decided which of them moved: they need half the memory of a run."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.dynamics.observation import NearPoints
from gnss_sem_map.mapping.labelled_scans import LabelledScan

WAITING = ".waiting"
"""Ending of the folders of such files."""
COLUMNS = ("keys", "heights", "levels", "moments_us", "pixels", "classes")
"""Beside those of `NearPoints`."""


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
        sizes = (len(self.keys), *self.classes.shape)
        columns = {name: getattr(self, name) for name in COLUMNS} | vars(self.near) | {"sizes": sizes}
        record = np.empty(1, _record_of(*sizes))
        for name, column in columns.items():
            record[name] = column
        path.write_bytes(record.view(np.uint8).data)

    @classmethod
    def take(cls, path: Path) -> WaitingPoints:
        """Read them and remove the file; raises OSError."""
        content = np.fromfile(path, np.uint8)
        path.unlink()
        sizes = content[: 3 * np.dtype(np.int64).itemsize].view(np.int64)
        record = np.ndarray((), _record_of(*sizes.tolist()), content)
        near = NearPoints(**{field.name: record[field.name] for field in fields(NearPoints)})
        return cls(near, **{name: record[name] for name in COLUMNS})


def _record_of(points: int, shown: int, classes: int) -> np.dtype[np.void]:
    """A file: its sizes, and then column by column, the widest first, so that each is aligned.

    One record, as the headers of an array each took 0.9 ms per scan.
    """
    return np.dtype([
        ("sizes", np.int64, (3,)), ("keys", np.int64, (points,)), ("moments_us", np.int64, (points,)),
        ("indices", np.int32, (points,)), ("p_near", np.float32, (points, 3)), ("voxel", np.int32, (points,)),
        ("pixels", np.int32, (points,)), ("levels", np.int16, (points,)), ("heights", np.uint8, (points,)),
        ("is_body", np.bool_, (points,)), ("classes", np.uint8, (shown, classes)),
    ])  # fmt: skip
