"""The map on disk: a folder of tiles, described by `map.json`; it is written completely or not at all."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence, Sized
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from reprlib import repr as brief
from threading import Lock
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from factor_graphs.geodesy import LocalFrame
from gnss_sem_map.errors import DataError
from gnss_sem_map.files.atomic import link_or_copy, unfinished
from gnss_sem_map.files.untrusted import is_file, shown
from gnss_sem_map.labels.label_set import LabelSet, open_label_set
from gnss_sem_map.process.memory import release_memory
from gnss_sem_map.voxels import tile_files
from gnss_sem_map.voxels.blocks import Block, bounds_of, tiles_around
from gnss_sem_map.voxels.kernels import AXIS_BITS, AXIS_MASK, AXIS_OFFSET, OF_IMAGES
from gnss_sem_map.voxels.map_json import MAP_JSON, describe, name_of, read_description, read_frame, tile_of
from gnss_sem_map.voxels.reuse import Made
from gnss_sem_map.voxels.semantic_map import SemanticMap
from gnss_sem_map.voxels.tile_files import TILE_BITS, Tile
from gnss_sem_map.voxels.voxel_map import VoxelMap

Piece = TypeVar("Piece", bound=Sized)
Z_ORDER_BITS = AXIS_BITS - TILE_BITS
VOXELS_HELD = 1_000_000
"""Voxels in memory at a time, 40 to 60 MB: a tile is read again with its neighbours and by every export, and a small
map is read once. Those of a large tile at work are among them, see `Recent.leave_room`."""


def write(semantic_map: SemanticMap, folder: Path, frame: LocalFrame | None) -> None:
    """Write a map into a new folder; raises DataError for voxels more than 2^13 above or below the origin."""
    voxels = semantic_map.voxels
    pieces = ((tile, semantic_map[indices]) for tile, indices in indices_by_tile(voxels.keys))
    write_tiles(pieces, folder, frame, voxels.voxel_size_m, voxels.label_set)


def write_tiles(
    pieces: Iterable[tuple[Tile, SemanticMap | Made]],
    folder: Path,
    frame: LocalFrame | None,
    voxel_size_m: float,
    label_set: LabelSet,
) -> None:
    """Write a map tile by tile, each tile once, into a new folder: one tile at a time is in memory.

    Tiles that are made already are linked. Raises DataError when the folder exists, the disk is full, or a voxel is
    more than 2^13 above or below the origin.
    """
    if folder.exists():
        raise DataError(f"{folder}: exists; remove it or choose another folder")
    beside = unfinished(folder)
    files: dict[str, dict[str, Any]] = {}
    try:
        beside.mkdir(parents=True)
        for tile, piece in pieces:
            name = name_of(tile)
            if isinstance(piece, Made):
                link_or_copy(piece.file, beside / name)
                files[name] = piece.about
            else:
                content = tile_files.encode(piece)
                (beside / name).write_bytes(content)
                files[name] = tile_files.describe(piece, content)
                del content
            del piece  # before the next one is made
        about = describe(voxel_size_m, label_set, frame, dict(sorted(files.items())))
        (beside / MAP_JSON).write_text(json.dumps(about, indent=1) + "\n", "utf-8")
        beside.rename(folder)
    except OSError as error:
        raise DataError(
            f"{folder}: cannot write the map ({error.strerror}); free the disk or choose another place"
        ) from None
    finally:
        shutil.rmtree(beside, ignore_errors=True)


@dataclass(frozen=True, eq=False)
class TiledMap:
    """A map that is read tile by tile, in order of the tiles; `open_map` and `in_memory` make it."""

    voxel_size_m: float
    label_set: LabelSet
    frame: LocalFrame | None
    """None for a map in its drive's own poses."""
    tiles: tuple[Tile, ...]
    """Sorted."""
    read_tile: Callable[[Tile], SemanticMap]
    """The voxels of one of the tiles, and what is decided about them."""
    read_voxels: Callable[[Tile], VoxelMap]
    """The voxels alone."""

    def __iter__(self) -> Iterator[SemanticMap]:
        return map(self.read_tile, self.tiles)

    def around(self, block: Block, margin_m: float) -> VoxelMap:
        """The voxels of a block and those within a margin around it; empty where the map has none."""
        tiles, parts = math.ceil(margin_m / (self.voxel_size_m * (1 << TILE_BITS))), []
        for tile in tiles_around(block, tiles):
            if tile in self._known:
                part = self.read_voxels(tile)
                parts.append(part if tile in block else part[places_around(part, block, margin_m)])
        return parts[0] if len(parts) == 1 else joined_voxels(parts, self.voxel_size_m, self.label_set)

    @cached_property
    def _known(self) -> frozenset[Tile]:
        return frozenset(self.tiles)

    def inside(self, box: tuple[ArrayLike, ArrayLike]) -> SemanticMap:
        """The voxels with centres in a box (low, high), each (3,) m; only the tiles of the box are read."""
        tiles = [tile for tile in self.tiles if _touches(tile, box, self.voxel_size_m)]
        parts = [_inside(self.read_tile(tile), box) for tile in tiles]
        return joined(parts, self.voxel_size_m, self.label_set)

    def whole(self) -> SemanticMap:
        """All voxels at once."""
        return joined(list(self), self.voxel_size_m, self.label_set)


def in_memory(semantic_map: SemanticMap, frame: LocalFrame | None = None) -> TiledMap:
    """The tiles of a map that is in memory."""
    voxels = semantic_map.voxels
    indices = dict(indices_by_tile(voxels.keys))
    return TiledMap(
        voxels.voxel_size_m, voxels.label_set, frame, tuple(indices),
        lambda tile: semantic_map[indices[tile]], lambda tile: voxels[indices[tile]],
    )  # fmt: skip


def open_map(
    folder: Path,
    label_set: LabelSet | None = None,
    voxels_held: int = VOXELS_HELD,
    with_sums: bool = True,
) -> TiledMap:
    """A map on disk; of its tiles those read last are held. Without `label_set` the class set is the one that it names.

    Without sums of log-likelihoods, `read_tile` takes half the time: for what only shows or counts what is decided.
    Raises DataError when `map.json` is damaged, a tile is missing, or the classes differ; reading raises it for a
    damaged tile.
    """
    about = read_description(folder / MAP_JSON)
    label_set = label_set or open_label_set(about.get("class_set", "urban"))
    if tuple(about["classes"]) != label_set.names:
        raise DataError(
            f"{shown(folder)}: found classes {brief(about['classes'])}, expected {list(label_set.names)}"
        )
    files: dict[str, dict[str, Any]] = about["files"]
    missing = [name for name in files if not is_file(folder / name)]
    if missing:
        raise DataError(
            f"{shown(folder)}: found {len(files) - len(missing)} tiles, expected {len(files)}, such as {missing[0]};"
            " make the map again"
        )
    names = {tile_of(name): name for name in files}
    voxel_size_m = float(about["voxel_size_m"])

    def of(tile: Tile) -> tuple[Path, Tile, dict[str, Any], float, LabelSet]:
        return folder / names[tile], tile, files[names[tile]], voxel_size_m, label_set

    def read_tile(tile: Tile) -> SemanticMap:
        release_memory()  # of the tiles before: exports of a large map would leave 200 MB in pieces
        return tile_files.read(*of(tile), with_sums=with_sums)

    return TiledMap(
        voxel_size_m,
        label_set,
        read_frame(folder),
        tuple(sorted(names)),
        Recent(read_tile, voxels_held),
        Recent(lambda tile: tile_files.read_voxels(*of(tile)), voxels_held),
    )


class Recent(Generic[Piece]):
    """Reads tiles, and holds those read last, up to so many voxels; threads may read at the same time."""

    def __init__(self, read: Callable[[Tile], Piece], most: int = VOXELS_HELD) -> None:
        self._read, self._most, self._held, self._lock = read, most, dict[Tile, Piece](), Lock()

    def __call__(self, tile: Tile) -> Piece:
        with self._lock:
            piece = self._held.get(tile)
        if piece is None:
            piece = self._read(tile)
        with self._lock:
            self._held.pop(tile, None)
            self._held[tile] = piece  # the last one
        self.leave_room(0)
        return piece

    def leave_room(self, voxels: int) -> None:
        """Hold fewer by so many."""
        with self._lock:
            while self._held and sum(map(len, self._held.values())) > self._most - voxels:
                del self._held[next(iter(self._held))]


def read(
    folder: Path, label_set: LabelSet | None = None, box: tuple[ArrayLike, ArrayLike] | None = None
) -> SemanticMap:
    """Read a map, or the voxels with centres in a box (low, high), each (3,) m; only the tiles of the box are opened.

    Without `label_set` the class set is the one that the map names. Raises DataError when the map is damaged,
    incomplete, or of another class set.
    """
    opened = open_map(folder, label_set)
    return opened.whole() if box is None else opened.inside(box)


def by_tile(voxels: VoxelMap) -> Iterator[tuple[Tile, VoxelMap]]:
    """The voxels of each tile, tile by tile in order."""
    for tile, indices in indices_by_tile(voxels.keys):
        yield tile, voxels[indices]


def indices_by_tile(keys: NDArray[np.int64]) -> Iterator[tuple[Tile, NDArray[np.int64]]]:
    """For each tile the indices of its voxels in the sorted keys, in ascending order."""
    x = keys >> (2 * AXIS_BITS + TILE_BITS)
    y = (keys >> (AXIS_BITS + TILE_BITS)) & ((1 << (AXIS_BITS - TILE_BITS)) - 1)
    found, numbers = np.unique(x << AXIS_BITS | y, return_inverse=True)
    order = np.argsort(numbers.astype(np.uint16 if len(found) < 1 << 16 else np.int64), kind="stable")
    edges = np.searchsorted(numbers[order], np.arange(len(found) + 1))
    first = AXIS_OFFSET >> TILE_BITS
    for i, tile in enumerate(found.tolist()):
        xy = (tile >> AXIS_BITS) - first, (tile & ((1 << AXIS_BITS) - 1)) - first
        yield xy, order[edges[i] : edges[i + 1]]


def joined_voxels(parts: Sequence[VoxelMap], voxel_size_m: float, label_set: LabelSet) -> VoxelMap:
    """The voxels of parts that share none."""
    keys = np.concatenate([np.empty(0, np.int64), *(part.keys for part in parts)])
    order = np.argsort(keys, kind="stable")  # quick: the keys of each part are sorted
    sums = len(label_set.names) if not parts else parts[0].evidence.shape[1]  # none, where they were not read
    evidence = np.empty((len(keys), sums), np.int32)
    rows = np.empty(len(keys), np.int64)
    rows[order] = np.arange(len(keys))
    for part, of_part in zip(parts, np.split(rows, np.cumsum([len(part) for part in parts])), strict=False):
        evidence[of_part] = part.evidence  # 26 MB less than all of them in a row
    hits = np.concatenate([np.empty(0, np.uint32), *(part.hits for part in parts)])
    heights = [part.heights for part in parts if part.heights is not None]
    of_all = np.concatenate([np.empty(0, np.int64), *heights])[order] if len(heights) == len(parts) else None
    of_images = [part.of_images for part in parts if part.of_images is not None]
    are_known = len(of_images) == len(parts)
    observations = np.concatenate([np.empty((0, OF_IMAGES), np.int32), *of_images])
    return VoxelMap(
        voxel_size_m, label_set, keys[order], evidence, hits[order], of_all,
        observations.take(order, axis=0) if are_known else None,
    )  # fmt: skip


def joined(parts: Sequence[SemanticMap], voxel_size_m: float, label_set: LabelSet) -> SemanticMap:
    """One map of parts that share no voxel; entropy is left out, as in a map that was read from disk."""
    keys = np.concatenate([np.empty(0, np.int64), *(part.voxels.keys for part in parts)])
    order = np.argsort(keys, kind="stable")  # quick: the keys of each part are sorted

    def column(of: Callable[[SemanticMap], NDArray[Any]], empty: NDArray[Any]) -> NDArray[Any]:
        return np.concatenate([empty, *map(of, parts)])[order]

    are_told = any(part.hits_removed is not None for part in parts)
    have_reasons = any(part.reasons is not None for part in parts)
    return SemanticMap(
        voxels=joined_voxels([part.voxels for part in parts], voxel_size_m, label_set),
        labels=column(lambda part: part.labels, np.empty(0, np.int8)),
        confidence=column(lambda part: part.confidence, np.empty(0, np.float32)),
        states=column(lambda part: part.states, np.empty(0, np.uint8)),
        hits_removed=column(lambda part: part.removed_hits, np.empty(0, np.uint32)) if are_told else None,
        reasons=column(lambda part: part.told_reasons, np.empty(0, np.uint8)) if have_reasons else None,
    )


def places_around(voxels: VoxelMap, block: Block, margin_m: float) -> NDArray[np.int64]:
    """The places of the voxels of the rectangle that holds a block, and of a margin around it."""
    margin, (first, last) = math.ceil(margin_m / voxels.voxel_size_m), bounds_of(block)
    low_x, low_y = (AXIS_OFFSET + (axis << TILE_BITS) - margin for axis in first)
    high_x, high_y = (AXIS_OFFSET + (axis + 1 << TILE_BITS) + margin for axis in last)
    start, end = np.searchsorted(voxels.keys, [low_x << 2 * AXIS_BITS, high_x << 2 * AXIS_BITS])
    y = voxels.keys[start:end] >> AXIS_BITS & AXIS_MASK
    return np.asarray(np.flatnonzero((y >= low_y) & (y < high_y)) + start, np.int64)


def z_order(tiles: Iterable[Tile]) -> list[Tile]:
    """Tiles in Morton order, in which neighbours are near each other: what one has read the next finds in memory."""

    def interleaved(tile: Tile) -> int:
        x, y = (axis + (1 << Z_ORDER_BITS - 1) for axis in tile)
        return sum((x >> bit & 1) << 2 * bit + 1 | (y >> bit & 1) << 2 * bit for bit in range(Z_ORDER_BITS))

    return sorted(tiles, key=interleaved)


def _touches(tile: Tile, box: tuple[ArrayLike, ArrayLike], voxel_size_m: float) -> bool:
    low = np.array(tile) * voxel_size_m * (1 << TILE_BITS)
    high = low + voxel_size_m * (1 << TILE_BITS)
    return bool((low <= np.asarray(box[1])[:2]).all() and (high >= np.asarray(box[0])[:2]).all())


def _inside(part: SemanticMap, box: tuple[ArrayLike, ArrayLike]) -> SemanticMap:
    centres = part.voxels.centres
    inside = (centres >= np.asarray(box[0])) & (centres <= np.asarray(box[1]))
    return part[np.flatnonzero(inside.all(axis=1))]
