"""Checkpoints of the mapping: one folder for every chunk of scans, with its voxels tile by tile.

A chunk is the unit of memory and of resuming, see `mapping.chunks`. The record of a chunk lists the checksum of every
file; an incomplete or damaged chunk is mapped again. Evidence is integer sums, so the sum of the chunks has the same
bytes for any number of processes and any interruptions.

NUMBER/record.json           counts, skips, moving objects, checksums
       static/x_y.parquet    the voxels of a tile (`voxels.tile_files`); removed/ likewise
       seen/x_y.parquet      the attributes of those of static/ (`voxels.attributes`); seen_removed/ likewise
       moving_points.npz     the points that moved (`mapping.evidence`)
       keyframes.npz         range images for free-space evidence, if they are of use
"""

from __future__ import annotations

import errno
import hashlib
import io
import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property, reduce
from operator import add
from pathlib import Path
from typing import Any

import numpy as np

from gnss_sem_map.dynamics.motion_state import LEAST_TRACKED_POINTS, Motion, TrackedObject
from gnss_sem_map.dynamics.object_track import ObjectTrack
from gnss_sem_map.errors import DataError
from gnss_sem_map.files import work_folder
from gnss_sem_map.files.atomic import unfinished, write_whole
from gnss_sem_map.labels.label_set import LabelSet
from gnss_sem_map.mapping import evidence
from gnss_sem_map.mapping.chunks import MappedChunk
from gnss_sem_map.mapping.waiting_points import WAITING
from gnss_sem_map.voxels.attributes import Attributes, combined, decode, encode
from gnss_sem_map.voxels.tile_files import Tile, decode_voxels, encode_voxels
from gnss_sem_map.voxels.tiles import by_tile, indices_by_tile, joined_voxels
from gnss_sem_map.voxels.voxel_map import VoxelMap

RECORD = "record.json"
STATIC, REMOVED = "static", "removed"
SEEN, SEEN_REMOVED = "seen", "seen_removed"
MOVING_POINTS, KEYFRAMES = "moving_points.npz", "keyframes.npz"


@dataclass(frozen=True, eq=False)
class ChunkStore:
    """The chunks of one run; `begun` prepares the folder."""

    folder: Path
    fingerprint: str
    """Of the run; chunks with another fingerprint are not used."""
    count: int
    """Number of chunks of the whole drive."""
    voxel_size_m: float
    label_set: LabelSet

    def begun(self, resume: bool) -> ChunkStore:
        """The store, with its folder: with `resume` it has the undamaged chunks of an interrupted run, else none.

        Raises DataError when the interrupted run had other files or settings, or the folder holds something else.
        """
        folder = self.folder
        work_folder.make(folder)
        about = folder / work_folder.CHUNKS
        known = _fingerprint(about) if resume else None
        if known not in (None, self.fingerprint):
            raise DataError(
                f"{folder}: the interrupted run had another drive, trajectory, labels, settings or version of this"
                " package, or a file was changed since; run it as it was begun, or without --resume"
            )
        try:
            if known is None:
                work_folder.remove_chunks(folder)
                write_whole(
                    about, json.dumps({"fingerprint": self.fingerprint, "chunks": self.count}).encode()
                )
            for path in (*folder.glob(".*.part"), *folder.glob(f".*{WAITING}")):
                _remove(path)
            for number in self.done():
                if number >= self.count or not self.is_whole(number):
                    _remove(folder / str(number))
        except OSError as error:
            raise DataError(f"{folder}: cannot be written ({error.strerror}); choose another place") from None
        return self

    def is_begun(self) -> bool:
        """Whether the folder is that of this run."""
        return _fingerprint(self.folder / work_folder.CHUNKS) == self.fingerprint

    def pending(self) -> list[int]:
        """Numbers of the chunks that are not saved."""
        return sorted(set(range(self.count)) - self.done())

    def done(self) -> set[int]:
        """Numbers of the saved chunks."""
        return {int(path.name) for path in self.folder.iterdir() if path.name.isdecimal()}

    def write(self, chunk: MappedChunk) -> None:
        """Save a chunk; raises DataError when the disk is full or the folder may not be written to.

        A chunk that is there already stays: a worker that was thought lost may have saved it. Unfinished files are
        removed.
        """
        beside = unfinished(self.folder / str(chunk.number))
        checksums: dict[str, str] = {}
        try:
            for name, content in _files(chunk):
                (beside / name).parent.mkdir(parents=True, exist_ok=True)
                write_whole(beside / name, content)
                checksums[name] = hashlib.sha256(content).hexdigest()
            body = {
                "fingerprint": self.fingerprint,
                "files": checksums,
                "counts": dict(chunk.stats.counts),
                "skips": [asdict(skip) for skip in chunk.stats.skips],
                "objects": [_about(one) for one in chunk.objects if one.points >= LEAST_TRACKED_POINTS],
                "untracked": sum(one.points < LEAST_TRACKED_POINTS for one in chunk.objects),
            }
            write_whole(beside / RECORD, json.dumps({"sha256": _checksum(body), "record": body}).encode())
            self._put(beside, chunk.number)
        except OSError as error:
            raise DataError(
                f"{self.folder}: cannot save voxels ({error.strerror}); free the disk, then run it again"
            ) from None
        finally:
            shutil.rmtree(beside, ignore_errors=True)

    def _put(self, beside: Path, number: int) -> None:
        """Give a finished folder its name, unless another process was quicker: both have the same bytes."""
        folder = self.folder / str(number)
        try:
            beside.rename(folder)
        except OSError as error:
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
                raise
            if self.is_whole(number):
                return
            if not self.is_begun():
                raise  # it is this run that has ended, and another one has begun
            shutil.rmtree(folder)
            beside.rename(folder)

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

    def objects(self) -> tuple[TrackedObject, ...]:
        """The tracked objects of all chunks."""
        return objects_from_json(self.objects_as_json())

    def objects_as_json(self) -> list[dict[str, Any]]:
        """The same for `objects_from_json`."""
        return [one for number in range(self.count) for one in self._record(number)["objects"]]

    def untracked(self) -> int:
        """How many objects had too few points to be tracked: most of them, so they are only counted."""
        return sum(record["untracked"] for record in self._records)

    def tiles(self) -> list[Tile]:
        """The tiles that any chunk has voxels in, in order."""
        return sorted({tile for parts in self._parts.values() for tile in parts})

    def tile(self, layer: str, tile: Tile) -> VoxelMap:
        """The voxels of a tile of a layer, summed over the chunks."""
        files = self._parts[layer].get(tile, [])
        nothing = joined_voxels([], self.voxel_size_m, self.label_set)
        return reduce(add, (self._read(path, tile, checksum) for path, checksum in files), nothing)

    def attributes(self, tile: Tile) -> Attributes:
        """Those of all voxels of a tile: of the points that moved only where no other is."""
        static, removed = (
            combined(
                [self._decoded(path, tile, checksum) for path, checksum in self._parts[layer].get(tile, [])]
            )
            for layer in (SEEN, SEEN_REMOVED)
        )
        alone = np.flatnonzero(~np.isin(removed.keys, static.keys, assume_unique=True))
        return combined([static, removed[alone]])

    def whole(self, layer: str) -> VoxelMap:
        """A whole layer in memory, sorted by key."""
        parts = [self.tile(layer, tile) for tile in self.tiles()]
        return joined_voxels(parts, self.voxel_size_m, self.label_set)

    def contents(self, name: str) -> Iterator[bytes]:
        """The content of the file of this name of every chunk that has it; raises DataError."""
        for number, record in enumerate(self._records):
            if name in record["files"]:
                yield _content(self.folder / str(number) / name, record["files"][name])

    @cached_property
    def _records(self) -> list[dict[str, Any]]:
        """Without the objects, whose paths would take more memory than all else."""
        return [self._record(number) | {"objects": ()} for number in range(self.count)]

    @cached_property
    def _parts(self) -> dict[str, dict[Tile, list[tuple[Path, str]]]]:
        """Layer -> tile -> files of the chunks, with their checksums."""
        parts: dict[str, dict[Tile, list[tuple[Path, str]]]] = {
            layer: {} for layer in (STATIC, REMOVED, SEEN, SEEN_REMOVED)
        }
        for number, record in enumerate(self._records):
            for name, checksum in record["files"].items():
                layer, slash, file = name.partition("/")
                if slash:
                    x, y = Path(file).stem.split("_")
                    place = self.folder / str(number) / name
                    parts[layer].setdefault((int(x), int(y)), []).append((place, checksum))
        return parts

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
            raise DataError(f"{path}: damaged chunk ({reason}); run it again") from None

    def _decoded(self, path: Path, tile: Tile, checksum: str) -> Attributes:
        return decode(_content(path, checksum), tile)

    def _read(self, path: Path, tile: Tile, checksum: str) -> VoxelMap:
        return decode_voxels(_content(path, checksum), tile, self.voxel_size_m, self.label_set)


def _files(chunk: MappedChunk) -> Iterator[tuple[str, bytes]]:
    """Name and content of every file of a chunk but its record."""
    for layer, voxels in ((STATIC, chunk.static), (REMOVED, chunk.removed)):
        for (x, y), part in by_tile(voxels):
            yield f"{layer}/{x}_{y}.parquet", encode_voxels(part)
    for layer, seen in ((SEEN, chunk.attributes), (SEEN_REMOVED, chunk.attributes_removed)):
        for (x, y), rows in indices_by_tile(seen.keys):
            yield f"{layer}/{x}_{y}.parquet", encode(seen[rows])
    file = io.BytesIO()
    evidence.write_moving_points(chunk.moving, file, chunk.lidar)
    yield MOVING_POINTS, file.getvalue()
    if chunk.keyframes is not None:
        file = io.BytesIO()
        evidence.write_keyframes(chunk.keyframes, file)
        yield KEYFRAMES, file.getvalue()


def _content(path: Path, checksum: str) -> bytes:
    """The content of a file of a chunk; raises DataError where it is not what was written."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise DataError(f"{path}: damaged ({error.strerror}); run it again") from None
    if hashlib.sha256(content).hexdigest() != checksum:
        raise DataError(f"{path}: damaged (its checksum differs); run it again")
    return content


def _about(one: TrackedObject) -> dict[str, Any]:
    """An object without its segments, whose numbers say nothing outside their chunk."""
    about = asdict(one) | {"path": one.path.tolist(), "segments": ()}
    return about if one.track is None else about | {"track": one.track.as_dict()}


def objects_from_json(content: Sequence[Mapping[str, Any]]) -> tuple[TrackedObject, ...]:
    """The objects that a store has as JSON."""
    return tuple(map(_object, content))


def _object(content: Mapping[str, Any]) -> TrackedObject:
    given = {
        "motion": Motion(content["motion"]),
        "segments": (),
        "path": np.array(content["path"], np.float64).reshape(-1, 2),
        "track": None if content["track"] is None else ObjectTrack.from_dict(content["track"]),
    }
    return TrackedObject(**{**content, **given})


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


def _checksum(record: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest()
