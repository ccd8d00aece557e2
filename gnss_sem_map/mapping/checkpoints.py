"""Checkpoints of the mapping: one folder for every chunk of scans, with its voxels tile by tile.

A chunk is the unit of memory, of work and of resuming: its scans are fused in their own table, which is then saved. The
record of a chunk lists the checksum of every file; an incomplete or damaged chunk is mapped again. Evidence is integer
sums, so the sum of the chunks has the same bytes for any division of the scans, any number of processes, and any
interruptions.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property, reduce
from operator import add
from pathlib import Path
from typing import Any

import numpy as np

from gnss_sem_map.errors import DataError
from gnss_sem_map.files import work_folder
from gnss_sem_map.files.ownership import write_whole
from gnss_sem_map.labels.label_set import LabelSet
from gnss_sem_map.voxels.tiles import Tile, by_tile
from gnss_sem_map.voxels.voxel_map import VoxelMap

RECORD = "record.json"


@dataclass(frozen=True, eq=False)
class ChunkStore:
    """The chunks of one run; `open_store` makes it."""

    folder: Path
    fingerprint: str
    """Of the run; chunks with another fingerprint are not used."""
    count: int
    """Number of chunks of the whole drive."""
    voxel_size_m: float
    label_set: LabelSet

    def done(self) -> set[int]:
        """Numbers of the saved chunks."""
        return {int(path.name) for path in self.folder.iterdir() if path.name.isdecimal()}

    def write(self, number: int, layers: Mapping[str, VoxelMap], record: Mapping[str, Any]) -> None:
        """Save a chunk: the voxels of each layer, and a record with counts and skips.

        Raises DataError when the disk is full or the folder may not be written to; unfinished files are removed.
        """
        beside = self.folder / f".{number}.{os.getpid()}.part"
        checksums: dict[str, str] = {}
        try:
            for layer, voxels in layers.items():
                (beside / layer).mkdir(parents=True)
                for (x, y), part in by_tile(voxels):
                    content = _encoded(part)
                    write_whole(beside / layer / f"{x}_{y}.npy", content)
                    checksums[f"{layer}/{x}_{y}.npy"] = hashlib.sha256(content).hexdigest()
            body = {"fingerprint": self.fingerprint, "files": checksums, **record}
            write_whole(beside / RECORD, json.dumps({"sha256": _checksum(body), "record": body}).encode())
            beside.rename(self.folder / str(number))
        except OSError as error:
            raise DataError(
                f"{self.folder}: cannot save voxels ({error.strerror}); free the disk, then --resume"
            ) from None
        finally:
            shutil.rmtree(beside, ignore_errors=True)

    def is_whole(self, number: int) -> bool:
        """Whether a chunk is of this run, complete and undamaged."""
        folder = self.folder / str(number)
        try:
            files: dict[str, str] = self._record(number)["files"]
            names = {p.relative_to(folder).as_posix() for p in folder.rglob("*") if not p.is_dir()} - {RECORD}
            return names == set(files) and all(
                hashlib.sha256((folder / name).read_bytes()).hexdigest() == checksum
                for name, checksum in files.items()
            )
        except (DataError, OSError):
            return False

    def records(self) -> list[dict[str, Any]]:
        """The record of every chunk, in order; raises DataError when one is missing or damaged."""
        return list(self._records)

    def tiles(self, layer: str) -> Iterator[tuple[Tile, VoxelMap]]:
        """The tiles of a layer in order, each summed over the chunks; one tile at a time is in memory."""
        parts: dict[Tile, list[tuple[Path, str]]] = {}
        for number, record in enumerate(self._records):
            for name, checksum in record["files"].items():
                path = self.folder / str(number) / name
                if path.parent.name == layer:
                    x, y = path.stem.split("_")
                    parts.setdefault((int(x), int(y)), []).append((path, checksum))
        for tile, files in sorted(parts.items()):
            yield tile, reduce(add, (self._read(path, checksum) for path, checksum in files))

    def whole(self, layer: str) -> VoxelMap:
        """A whole layer in memory, sorted by key."""
        rows = [part.to_rows() for _, part in self.tiles(layer)]
        empty = np.empty((0, VoxelMap.words(self.label_set)), np.int64)
        return VoxelMap.of_rows(np.concatenate([empty, *rows]), self.voxel_size_m, self.label_set)

    @cached_property
    def _records(self) -> list[dict[str, Any]]:
        return [self._record(number) for number in range(self.count)]

    def _record(self, number: int) -> dict[str, Any]:
        path = self.folder / str(number) / RECORD
        try:
            content = json.loads(path.read_text("utf-8"))
            record = dict(content["record"])
            if content["sha256"] != _checksum(record) or record["fingerprint"] != self.fingerprint:
                raise ValueError("its checksum differs")
            return record
        except (OSError, ValueError, KeyError, TypeError) as error:
            reason = error.strerror if isinstance(error, OSError) else "its checksum differs"
            raise DataError(f"{path}: damaged chunk ({reason}); --resume maps it again") from None

    def _read(self, path: Path, checksum: str) -> VoxelMap:
        try:
            content = path.read_bytes()
        except OSError as error:
            raise DataError(f"{path}: damaged voxels ({error.strerror}); --resume maps them again") from None
        if hashlib.sha256(content).hexdigest() != checksum:
            raise DataError(f"{path}: damaged voxels (their checksum differs); --resume maps them again")
        rows = np.load(io.BytesIO(content), allow_pickle=False)
        return VoxelMap.of_rows(rows, self.voxel_size_m, self.label_set)


def open_store(
    folder: Path, fingerprint: str, count: int, resume: bool, voxel_size_m: float, label_set: LabelSet
) -> ChunkStore:
    """A store for a run of `count` chunks that `fingerprint` identifies.

    With `resume` it holds the undamaged chunks of an interrupted run, else none. Raises DataError when the interrupted
    run had other files or other settings, or the folder holds something else.
    """
    work_folder.make(folder)
    about = folder / work_folder.CHUNKS
    store = ChunkStore(folder, fingerprint, count, voxel_size_m, label_set)
    known = _fingerprint(about) if resume else None
    if known not in (None, fingerprint):
        raise DataError(
            f"{folder}: the interrupted run had another drive, trajectory, labels or settings, or a file was changed"
            " since; run it as it was begun, or without --resume"
        )
    try:
        if known is None:
            work_folder.remove_chunks(folder)
            write_whole(about, json.dumps({"fingerprint": fingerprint, "chunks": count}).encode())
        for path in folder.glob(".*.part"):
            _remove(path)
        for number in store.done():
            if number >= count or not store.is_whole(number):
                _remove(folder / str(number))
    except OSError as error:
        raise DataError(f"{folder}: cannot be written ({error.strerror}); choose another place") from None
    return store


def _fingerprint(about: Path) -> str | None:
    """The fingerprint of an interrupted run; None if it cannot be read."""
    try:
        return str(json.loads(about.read_text("utf-8"))["fingerprint"])
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink()


def _encoded(voxels: VoxelMap) -> bytes:
    file = io.BytesIO()
    np.save(file, voxels.to_rows(), allow_pickle=False)
    return file.getvalue()


def _checksum(record: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest()
