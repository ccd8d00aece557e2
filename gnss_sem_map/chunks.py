"""What a run has mapped so far, on disk: one folder for every chunk of scans, and in it the voxels tile by tile.

A chunk is the unit of memory, of work and of resuming: its scans are fused in a table of their own, which is then put
away. A chunk is there, whole, or not there. Evidence is integer sums, so adding up the chunks of a tile gives the same
bytes however the scans were divided, whoever fused them, and however often the run was interrupted.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import reduce
from operator import add
from pathlib import Path
from typing import Any

import numpy as np

from gnss_sem_map.errors import DataError
from gnss_sem_map.labels import LabelSet
from gnss_sem_map.tiles import Tile, by_tile
from gnss_sem_map.voxel_map import VoxelMap

ABOUT, RECORD = "chunks.json", "record.json"


@dataclass(frozen=True, eq=False)
class ChunkStore:
    """The chunks of one run; `open_store` makes or finds it."""

    folder: Path
    voxel_size_m: float
    label_set: LabelSet

    def done(self) -> set[int]:
        """Numbers of the chunks that are there."""
        return {int(path.name) for path in self.folder.iterdir() if path.name.isdecimal()}

    def write(self, number: int, layers: Mapping[str, VoxelMap], record: Mapping[str, Any]) -> None:
        """Put a chunk away: the voxels of each layer, and a record of how they came about.

        Raises DataError when the disk is full or the folder may not be written to; nothing half-written stays.
        """
        beside = self.folder / f".{number}.{os.getpid()}.part"
        try:
            for layer, voxels in layers.items():
                (beside / layer).mkdir(parents=True)
                for (x, y), part in by_tile(voxels):
                    with (beside / layer / f"{x}_{y}.npy").open("wb") as file:
                        np.save(file, part.to_rows(), allow_pickle=False)
                        file.flush()
                        os.fsync(file.fileno())
            (beside / RECORD).write_text(json.dumps(record), "utf-8")
            beside.rename(self.folder / str(number))
        except OSError as error:
            raise DataError(
                f"{self.folder}: cannot put voxels away ({error.strerror}); free the disk, then --resume"
            ) from None
        finally:
            shutil.rmtree(beside, ignore_errors=True)

    def records(self) -> list[dict[str, Any]]:
        """The record of every chunk, in order."""
        return [_json(self.folder / str(number) / RECORD) for number in sorted(self.done())]

    def tiles(self, layer: str) -> Iterator[tuple[Tile, VoxelMap]]:
        """Every tile of a layer in order, each the sum over the chunks; one tile at a time is in memory."""
        parts: dict[Tile, list[Path]] = {}
        for number in sorted(self.done()):
            for path in sorted((self.folder / str(number) / layer).glob("*.npy")):
                x, y = path.stem.split("_")
                parts.setdefault((int(x), int(y)), []).append(path)
        for tile, paths in sorted(parts.items()):
            yield tile, reduce(add, map(self._read, paths))

    def whole(self, layer: str) -> VoxelMap:
        """A layer in memory, sorted by key."""
        rows = [part.to_rows() for _, part in self.tiles(layer)]
        empty = np.empty((0, VoxelMap.words(self.label_set)), np.int64)
        return VoxelMap.of_rows(np.concatenate([empty, *rows]), self.voxel_size_m, self.label_set)

    def _read(self, path: Path) -> VoxelMap:
        try:
            rows = np.load(path, allow_pickle=False)
            if rows.dtype != np.int64 or rows.ndim != 2 or rows.shape[1] != VoxelMap.words(self.label_set):
                raise ValueError(f"found {rows.dtype} {rows.shape}")
            return VoxelMap.of_rows(rows, self.voxel_size_m, self.label_set)
        except (OSError, ValueError, EOFError) as error:
            raise DataError(
                f"{path}: damaged voxels ({str(error).splitlines()[0]}); remove {path.parents[1]}, then --resume"
            ) from None


def open_store(
    folder: Path, fingerprint: str, resume: bool, voxel_size_m: float, label_set: LabelSet
) -> ChunkStore:
    """A store for a run that `fingerprint` identifies: what an interrupted one left when resuming, else an empty one.

    Raises DataError when what is there came from another drive or other settings, or is no store at all.
    """
    about = folder / ABOUT
    if folder.exists() and not about.is_file() and any(folder.iterdir()):
        raise DataError(f"{folder}: exists and holds no interrupted run; remove it")
    if resume and about.is_file():
        if _json(about).get("fingerprint") != fingerprint:
            raise DataError(
                f"{folder}: the interrupted run had another drive, trajectory, labels or settings; run it as it was"
                " begun, or without --resume"
            )
        for left in folder.glob(".*.part"):
            shutil.rmtree(left, ignore_errors=True)
        return ChunkStore(folder, voxel_size_m, label_set)
    try:
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        beside = folder / f".{ABOUT}"
        beside.write_text(json.dumps({"fingerprint": fingerprint}) + "\n", "utf-8")
        beside.rename(about)
    except OSError as error:
        raise DataError(f"{folder}: cannot be written ({error.strerror}); choose another place") from None
    return ChunkStore(folder, voxel_size_m, label_set)


def _json(path: Path) -> dict[str, Any]:
    try:
        return dict(json.loads(path.read_text("utf-8")))
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: damaged ({error}); run again without --resume") from None
