"""Points of one scan that wait on disk until it is decided which of them moved: they need half the memory of a run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.dynamics.observation import NearPoints
from gnss_sem_map.mapping.labelled_scans import LabelledScan

WAITING = ".waiting"
"""Ending of the folders of such files."""
AS_THEY_ARE = ("keys", "heights", "levels", "is_shown", "classes")
"""Columns that are written so, beside those of `NearPoints`."""


@dataclass(frozen=True, eq=False)
class WaitingPoints:
    """The points of a scan in or near a segment (h,), as they were fused."""

    near: NearPoints
    """Its indices increase."""
    keys: NDArray[np.int64]
    """(h,) the voxel of each."""
    heights: NDArray[np.uint8]
    """(h,) how high each lies in its voxel."""
    levels: NDArray[np.int16]
    """(h,) intensity of each, see `voxels.attribute_table`."""
    moments_us: NDArray[np.int64]
    """(h,) when each was measured, within the time of a sweep."""
    is_shown: NDArray[np.bool_]
    """(h,) whether an image shows it."""
    classes: NDArray[np.uint8]
    """(p, c + 1) class probabilities of those."""

    @classmethod
    def of(cls, seen: LabelledScan, near: NearPoints) -> WaitingPoints:
        """What a scan with labels says of its points in or near a segment."""
        here = near.indices.astype(np.intp)
        pixels = seen.pixels.take(here)
        is_shown = pixels >= 0
        return cls(
            near, seen.keys.take(here), seen.heights.take(here), seen.levels.take(here), seen.moments_us.take(here),
            is_shown, seen.classes.take(pixels[is_shown], axis=0),
        )  # fmt: skip

    @property
    def pixels(self) -> NDArray[np.int32]:
        """(h,) row of `classes` for each point, -1 if no image shows it."""
        return np.where(self.is_shown, np.cumsum(self.is_shown, dtype=np.int32) - np.int32(1), np.int32(-1))

    def write(self, path: Path) -> None:
        """Write them into a file of their own; raises OSError."""
        near, first_us = self.near, self.moments_us.min(initial=2**62)
        end = near.indices.max(initial=-1) + 1
        is_near = np.zeros(end, np.bool_)
        is_near[near.indices] = True
        sizes = (len(self.keys), end, *self.classes.shape)
        columns = {name: getattr(self, name) for name in AS_THEY_ARE} | vars(near)
        columns |= {"sizes": sizes, "first_us": first_us, "after_us": self.moments_us - first_us}
        columns["indices"] = np.packbits(is_near)
        record = _record_of(*sizes)
        with path.open("wb") as file:
            for name in record.names or ():
                file.write(np.ascontiguousarray(columns[name], record[name].base).data)

    @classmethod
    def take(cls, path: Path) -> WaitingPoints:
        """Read them and remove the file; raises OSError."""
        content = np.fromfile(path, np.uint8)
        path.unlink()
        sizes = content[: 4 * np.dtype(np.int64).itemsize].view(np.int64).tolist()
        record = np.ndarray((), _record_of(*sizes), content)
        indices = np.flatnonzero(np.unpackbits(record["indices"], count=sizes[1])).astype(np.int32)
        near = NearPoints(indices, record["p_near"], record["is_body"], record["voxel"])
        moments_us = record["first_us"] + record["after_us"]
        return cls(near, moments_us=moments_us, **{name: record[name] for name in AS_THEY_ARE})


def _record_of(points: int, end: int, shown: int, classes: int) -> np.dtype[np.void]:
    """A file: its sizes, and then column by column, the widest first, so that each is aligned.

    One record, as the headers of an array each took 0.9 ms per scan. Every byte of a point costs 0.1 ms per scan: its
    index is a bit of a mask (end,), and its moment is told from the first one of the sweep.
    """
    return np.dtype([
        ("sizes", np.int64, (4,)), ("first_us", np.int64), ("keys", np.int64, (points,)),
        ("after_us", np.int32, (points,)), ("p_near", np.float32, (points, 3)), ("voxel", np.int32, (points,)),
        ("levels", np.int16, (points,)), ("heights", np.uint8, (points,)), ("is_body", np.bool_, (points,)),
        ("is_shown", np.bool_, (points,)), ("classes", np.uint8, (shown, classes)),
        ("indices", np.uint8, (-(-end // 8),)),
    ])  # fmt: skip
