"""The map on disk: Parquet tiles of 512 x 512 columns of voxels, described by `map.json`.

A tile `x_y.parquet` holds the voxels whose index lies in [512 x, 512 x + 512) and [512 y, 512 y + 512): a local key
(x 9 bits, y 9 bits, z 14 bits), the sums of log-likelihoods, the hits, the sum of the points' heights over the bottom
of the voxel where it is known, and the label, confidence and state of each voxel. A refined map counts all hits, and in
`hits_removed` those of moving objects; log-likelihoods are of static objects only. Keys are sorted and delta-coded, so
a voxel takes about 14 bytes. Any Parquet reader opens them. A map folder is written completely or not at all;
`map.json` holds the checksum of every tile.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from factor_graphs.geodesy import LocalFrame
from gnss_sem_map.errors import DataError
from gnss_sem_map.files.atomic import link_or_copy
from gnss_sem_map.files.structured import read_json
from gnss_sem_map.files.untrusted import is_file, read_bytes, shown
from gnss_sem_map.labels.label_set import LabelSet, open_label_set
from gnss_sem_map.voxels.kernels import AXIS_BITS, AXIS_OFFSET
from gnss_sem_map.voxels.semantic_map import SemanticMap, State
from gnss_sem_map.voxels.voxel_map import VoxelMap, pack

TILE_BITS = 9
Z_BITS = 14
Z_OFFSET = 1 << (Z_BITS - 1)
FORMAT = 2
HITS_REMOVED = "hits_removed"
"""Column of maps in which objects moved through static voxels."""
HEIGHTS = "heights"
"""Column of maps that know how high the surface in a voxel lies."""
Tile = tuple[int, int]
TILES_HELD = 16
"""Tiles of a map in memory at a time: each is read again with its neighbours."""
NAME = re.compile(r"(-?\d{1,6})_(-?\d{1,6})\.parquet", re.ASCII)


def write(semantic_map: SemanticMap, folder: Path, frame: LocalFrame | None) -> None:
    """Write a map into a new folder; raises DataError for voxels more than 2^13 above or below the origin."""
    voxels = semantic_map.voxels
    pieces = ((tile, semantic_map[indices]) for tile, indices in _indices_by_tile(voxels.keys))
    write_tiles(pieces, folder, frame, voxels.voxel_size_m, voxels.label_set)


def write_tiles(
    pieces: Iterable[tuple[Tile, SemanticMap]],
    folder: Path,
    frame: LocalFrame | None,
    voxel_size_m: float,
    label_set: LabelSet,
    reuse: Reuse | None = None,
) -> None:
    """Write a map tile by tile, each tile once, into a new folder: one tile at a time is in memory.

    Tiles of an earlier map that `reuse` says to stay are linked, and are not among the pieces. Raises DataError when
    the folder exists, the disk is full, or a voxel is more than 2^13 above or below the origin.
    """
    if folder.exists():
        raise DataError(f"{folder}: exists; remove it or choose another folder")
    beside = folder.with_name(f".{folder.name}.{os.getpid()}.part")
    files: dict[str, dict[str, Any]] = {}
    try:
        beside.mkdir(parents=True)
        if reuse is not None and reuse.earlier is not None:
            for tile, about in reuse.same.items():
                link_or_copy(reuse.earlier / name_of(tile), beside / name_of(tile))
                files[name_of(tile)] = about | reuse.about(tile)
        for tile, piece in pieces:
            content, name = _encode(piece), name_of(tile)
            (beside / name).write_bytes(content)
            files[name] = {
                "voxels": len(piece),
                "points": int(piece.voxels.hits.sum(dtype=np.int64)),
                "sha256": hashlib.sha256(content).hexdigest(),
                **({} if reuse is None else reuse.about(tile)),
            }
        about = _about(voxel_size_m, label_set, frame, dict(sorted(files.items())))
        (beside / "map.json").write_text(json.dumps(about, indent=1) + "\n", "utf-8")
        beside.rename(folder)
    except OSError as error:
        raise DataError(
            f"{folder}: cannot write the map ({error.strerror}); free the disk or choose another place"
        ) from None
    finally:
        shutil.rmtree(beside, ignore_errors=True)


def name_of(tile: Tile) -> str:
    """File of a tile."""
    return f"{tile[0]}_{tile[1]}.parquet"


@dataclass(frozen=True, eq=False)
class Reuse:
    """From what the tiles of a map are made; those that an earlier map made from the same need not be made again."""

    made_from: Mapping[Tile, str]
    """Digest of all that decides a tile."""
    earlier: Path | None = None
    """Folder of the earlier map."""
    said: dict[Tile, Any] = field(default_factory=dict)
    """What `map.json` is to keep of a tile beside it: JSON, there before the tile is written."""

    def about(self, tile: Tile) -> dict[str, Any]:
        """What `map.json` says of a tile that is made now."""
        known = {"made_from": self.made_from[tile]}
        return known | ({"said": self.said[tile]} if tile in self.said else {})

    @cached_property
    def same(self) -> dict[Tile, dict[str, Any]]:
        """What the earlier map says of the tiles that stay; none where there is no such map."""
        known = files_of(self.earlier)
        names = {tile: name_of(tile) for tile in self.made_from}
        return {
            tile: known[name]
            for tile, name in names.items()
            if name in known and known[name].get("made_from") == self.made_from[tile]
        }


def files_of(folder: Path | None) -> dict[str, dict[str, Any]]:
    """What `map.json` of a folder says of its files; nothing where there is no map, or a damaged one."""
    if folder is None:
        return {}
    try:
        files: dict[str, dict[str, Any]] = _read_about(folder / "map.json")["files"]
    except DataError:
        return {}
    return {name: about for name, about in files.items() if is_file(folder / name)}


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
    """The voxels of one of the tiles."""

    def __iter__(self) -> Iterator[SemanticMap]:
        return map(self.read_tile, self.tiles)

    def around(self, tile: Tile, margin_m: float) -> SemanticMap:
        """The voxels of a tile and those within a margin around it; empty where the map has none."""
        margin, edge = math.ceil(margin_m / self.voxel_size_m), 1 << TILE_BITS
        low = np.array(tile) * edge - margin
        high, tiles = low + edge + 2 * margin, -(-margin // edge)
        reach, parts = range(-tiles, tiles + 1), []
        for near in ((tile[0] + i, tile[1] + j) for i in reach for j in reach):
            if near in self._known:
                part = self.read_tile(near)
                xy = part.voxels.indices[:, :2]
                parts.append(part[np.flatnonzero(((xy >= low) & (xy < high)).all(axis=1))])
        return joined(parts, self.voxel_size_m, self.label_set)

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
    indices = dict(_indices_by_tile(voxels.keys))
    return TiledMap(
        voxels.voxel_size_m, voxels.label_set, frame, tuple(indices), lambda tile: semantic_map[indices[tile]]
    )


def open_map(folder: Path, label_set: LabelSet | None = None, held: int = TILES_HELD) -> TiledMap:
    """A map on disk, with so many tiles `held` in memory; without `label_set` the class set is the one that it names.

    Raises DataError when `map.json` is damaged, a tile is missing, or the classes differ; reading raises it for a
    damaged tile.
    """
    about = _read_about(folder / "map.json")
    label_set = label_set or open_label_set(str(about.get("class_set")))
    if tuple(about["classes"]) != label_set.names:
        raise DataError(
            f"{shown(folder)}: found classes {about['classes']}, expected {list(label_set.names)}"
        )
    files: dict[str, dict[str, Any]] = about["files"]
    missing = [name for name in files if not is_file(folder / name)]
    if missing:
        raise DataError(
            f"{shown(folder)}: found {len(files) - len(missing)} tiles, expected {len(files)}, such as {missing[0]};"
            " make the map again"
        )
    names = {_tile_of(name): name for name in files}
    voxel_size_m = float(about["voxel_size_m"])

    @lru_cache(held)
    def read_tile(tile: Tile) -> SemanticMap:
        columns = _decode(folder / names[tile], files[names[tile]], label_set)
        return _of_columns(columns, voxel_size_m, label_set)

    return TiledMap(voxel_size_m, label_set, read_frame(folder), tuple(sorted(names)), read_tile)


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
    for tile, indices in _indices_by_tile(voxels.keys):
        yield tile, voxels[indices]


def _indices_by_tile(keys: NDArray[np.int64]) -> Iterator[tuple[Tile, NDArray[np.int64]]]:
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


def _encode(piece: SemanticMap) -> bytes:
    """One tile as a Parquet file."""
    columns = _columns_of(piece.voxels)
    columns |= {"label": piece.labels.astype(np.int32), "state": piece.states.astype(np.int32)}
    columns |= {"confidence": piece.confidence}
    if piece.hits_removed is not None:
        columns[HITS_REMOVED] = piece.hits_removed
    return _as_parquet(columns)


def encode_voxels(voxels: VoxelMap) -> bytes:
    """The voxels of one tile, without decisions, as a Parquet file."""
    return _as_parquet(_columns_of(voxels))


def decode_voxels(content: bytes, tile: Tile, voxel_size_m: float, label_set: LabelSet) -> VoxelMap:
    """What `encode_voxels` wrote; raises ValueError or pyarrow's ArrowException for anything else."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = pq.ParquetFile(pa.BufferReader(content)).read()
    columns = {name: _column(table, name) for name in table.column_names}
    return _voxels_of(columns | {"key": _global(tile, columns["key"])}, voxel_size_m, label_set)


def _columns_of(voxels: VoxelMap) -> dict[str, NDArray[Any]]:
    # Parquet's smallest integer is 32 bits; it packs small ones tightly
    columns: dict[str, NDArray[Any]] = {"key": local_keys(voxels)}
    columns |= {f"log_{name}": voxels.evidence[:, i] for i, name in enumerate(voxels.label_set.names)}
    columns |= {"hits": voxels.hits}
    return columns if voxels.heights is None else columns | {HEIGHTS: voxels.heights}


def _as_parquet(columns: dict[str, NDArray[Any]]) -> bytes:
    import pyarrow as pa
    import pyarrow.parquet as pq

    whole = [name for name in columns if name != "confidence"]
    sink = pa.BufferOutputStream()
    pq.write_table(
        pa.table(columns), sink, compression="zstd", use_dictionary=False, write_statistics=False,
        column_encoding=dict.fromkeys(whole, "DELTA_BINARY_PACKED")
        | {name: "BYTE_STREAM_SPLIT" for name in columns if name == "confidence"},
    )  # fmt: skip
    return bytes(sink.getvalue())


def _decode(path: Path, about: dict[str, Any], label_set: LabelSet) -> dict[str, NDArray[Any]]:
    """The columns of one tile, with whole keys; raises DataError, with its name, when it is not what was written."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    names = ["key", *(f"log_{name}" for name in label_set.names), "hits", "label", "confidence", "state"]
    content = read_bytes(path)
    try:
        if hashlib.sha256(content).hexdigest() != about["sha256"]:
            raise ValueError("its checksum is not that of map.json")
        file = pq.ParquetFile(pa.BufferReader(content))
        if file.metadata.num_rows != about["voxels"]:
            raise ValueError(f"found {file.metadata.num_rows} voxels, expected {about['voxels']}")
        names += [name for name in (HITS_REMOVED, HEIGHTS) if name in file.schema_arrow.names]
        table = file.read(columns=names)
        columns = {name: _column(table, name) for name in names}
        if not ((columns["label"] >= -1) & (columns["label"] < len(label_set.names))).all():
            raise ValueError("it has labels of no class")
        if not ((columns["confidence"] >= 0) & (columns["confidence"] <= 1)).all():
            raise ValueError("it has confidences beyond 0..1")
    except (pa.ArrowException, OSError, ValueError, KeyError) as error:
        reason = " ".join(str(error).split())[:200]
        raise DataError(f"{shown(path)}: damaged tile ({reason}); make the map again") from None
    return columns | {"key": _global(_tile_of(path.name), columns["key"])}


def _column(table: Any, name: str) -> NDArray[Any]:
    """A column as numbers without gaps; raises ValueError for anything else."""
    import pyarrow as pa

    column = table[name].combine_chunks()
    is_number = pa.types.is_floating if name == "confidence" else pa.types.is_integer
    if column.null_count or not is_number(column.type):
        raise ValueError(f"column {name} is {column.type} with {column.null_count} gaps")
    return np.from_dlpack(column)  # `to_numpy` imports pandas, which takes half a second


def _of_columns(columns: dict[str, NDArray[Any]], voxel_size_m: float, label_set: LabelSet) -> SemanticMap:
    order, removed = np.argsort(columns["key"]), columns.get(HITS_REMOVED)
    return SemanticMap(
        voxels=_voxels_of(columns, voxel_size_m, label_set),
        labels=columns["label"].astype(np.int8)[order],
        confidence=columns["confidence"].astype(np.float32)[order],
        states=columns["state"].astype(np.uint8)[order],
        hits_removed=None if removed is None else removed.astype(np.uint32)[order],
    )


def _voxels_of(columns: dict[str, NDArray[Any]], voxel_size_m: float, label_set: LabelSet) -> VoxelMap:
    order, heights = np.argsort(columns["key"]), columns.get(HEIGHTS)
    evidence = np.stack([columns[f"log_{name}"][order] for name in label_set.names], axis=1, dtype=np.int32)
    return VoxelMap(
        voxel_size_m,
        label_set,
        columns["key"][order],
        evidence,
        columns["hits"].astype(np.uint32)[order],
        None if heights is None else heights.astype(np.int64)[order],
    )


def joined_voxels(parts: Sequence[VoxelMap], voxel_size_m: float, label_set: LabelSet) -> VoxelMap:
    """The voxels of parts that share none."""
    keys = np.concatenate([np.empty(0, np.int64), *(part.keys for part in parts)])
    order = np.argsort(keys)
    evidence = np.concatenate(
        [np.empty((0, len(label_set.names)), np.int32), *(part.evidence for part in parts)]
    )
    hits = np.concatenate([np.empty(0, np.uint32), *(part.hits for part in parts)])
    heights = [part.heights for part in parts if part.heights is not None]
    of_all = np.concatenate([np.empty(0, np.int64), *heights])[order] if len(heights) == len(parts) else None
    return VoxelMap(voxel_size_m, label_set, keys[order], evidence[order], hits[order], of_all)


def joined(parts: Sequence[SemanticMap], voxel_size_m: float, label_set: LabelSet) -> SemanticMap:
    """One map of parts that share no voxel; entropy is left out, as in a map that was read from disk."""
    keys = np.concatenate([np.empty(0, np.int64), *(part.voxels.keys for part in parts)])
    order = np.argsort(keys, kind="stable")  # quick: the keys of each part are sorted

    def column(of: Callable[[SemanticMap], NDArray[Any]], empty: NDArray[Any]) -> NDArray[Any]:
        return np.concatenate([empty, *map(of, parts)])[order]

    are_told = any(part.hits_removed is not None for part in parts)
    return SemanticMap(
        voxels=joined_voxels([part.voxels for part in parts], voxel_size_m, label_set),
        labels=column(lambda part: part.labels, np.empty(0, np.int8)),
        confidence=column(lambda part: part.confidence, np.empty(0, np.float32)),
        states=column(lambda part: part.states, np.empty(0, np.uint8)),
        hits_removed=column(lambda part: part.removed_hits, np.empty(0, np.uint32)) if are_told else None,
    )


def _touches(tile: Tile, box: tuple[ArrayLike, ArrayLike], voxel_size_m: float) -> bool:
    low = np.array(tile) * voxel_size_m * (1 << TILE_BITS)
    high = low + voxel_size_m * (1 << TILE_BITS)
    return bool((low <= np.asarray(box[1])[:2]).all() and (high >= np.asarray(box[0])[:2]).all())


def _inside(part: SemanticMap, box: tuple[ArrayLike, ArrayLike]) -> SemanticMap:
    centres = part.voxels.centres
    inside = (centres >= np.asarray(box[0])) & (centres <= np.asarray(box[1]))
    return part[np.flatnonzero(inside.all(axis=1))]


def local_keys(voxels: VoxelMap) -> NDArray[np.uint32]:
    """Keys of voxels inside their tile."""
    x, y, height = voxels.indices.T.astype(np.int64)
    z = height + Z_OFFSET
    if len(z) and (z.min() < 0 or z.max() >= 1 << Z_BITS):
        raise DataError(
            f"voxel heights {height.min()} to {height.max()} do not fit a tile (-{Z_OFFSET} to"
            f" {Z_OFFSET - 1}); check the heights of the trajectory"
        )
    mask = (1 << TILE_BITS) - 1
    local = (x & mask) << (TILE_BITS + Z_BITS) | (y & mask) << Z_BITS | z
    return np.asarray(local, np.uint32)


def _global(tile: Tile, local: NDArray[np.uint32]) -> NDArray[np.int64]:
    """Keys of a tile's voxels."""
    wide = local.astype(np.int64)
    mask = (1 << TILE_BITS) - 1
    x = (wide >> (TILE_BITS + Z_BITS)) + (tile[0] << TILE_BITS)
    y = (wide >> Z_BITS & mask) + (tile[1] << TILE_BITS)
    return pack(np.stack([x, y, (wide & ((1 << Z_BITS) - 1)) - Z_OFFSET], axis=1))


def _tile_of(name: str) -> Tile:
    match = NAME.fullmatch(name)
    if match is None:
        raise DataError(
            f"map.json: found tile {name!r}, expected a name like 3_-4.parquet; make the map again"
        )
    return int(match[1]), int(match[2])


def _about(
    voxel_size_m: float,
    label_set: LabelSet,
    frame: LocalFrame | None,
    files: dict[str, dict[str, Any]],
) -> dict[str, Any]:
    origin = None
    if frame is not None:
        origin = {"lat_deg": frame.lat_deg, "lon_deg": frame.lon_deg, "alt_m": frame.alt_m}
    return {
        "format": FORMAT,
        "voxel_size_m": voxel_size_m,
        "classes": list(label_set.names),
        "class_set": label_set.name,
        "states": {state.name.lower(): int(state) for state in State},
        "origin": origin,
        "axes": "east, north, up at the origin, m" if frame else "x, y, z of the drive's own poses, m",
        "utm_epsg": None if frame is None else frame.utm_epsg,
        "tiles": len(files),
        "voxels": sum(file["voxels"] for file in files.values()),
        "points": sum(file["points"] for file in files.values()),
        "evidence_unit": "2^-10 nat",
        "height_unit": "1/256 of a voxel's edge",
        "key": "x 9 bits, y 9 bits (inside the tile), z 14 bits (+ 8192), in voxels",
        "files": files,
    }


def read_frame(folder: Path) -> LocalFrame | None:
    """The local frame of a map; None for one in its drive's own poses. Raises DataError."""
    origin = _read_about(folder / "map.json").get("origin")
    try:
        return (
            None if origin is None else LocalFrame(**{name: float(value) for name, value in origin.items()})
        )
    except (TypeError, ValueError, AttributeError) as error:
        raise DataError(
            f"{shown(folder / 'map.json')}: found origin {origin}, expected lat_deg, lon_deg, alt_m ({error})"
        ) from None


def _read_about(path: Path) -> dict[str, Any]:
    if not is_file(path):
        raise DataError(f"{shown(path)}: no map here; expected the folder of a map")
    about = read_json(path)
    if about.get("format") != FORMAT:
        raise DataError(
            f"{shown(path)}: found format {about.get('format')!r}, expected {FORMAT}; make the map again"
        )
    damaged = [name for name, is_right in (
        ("voxel_size_m", _is_size(about.get("voxel_size_m"))),
        ("classes", _is_list_of_words(about.get("classes"))),
        ("files", _is_table_of_files(about.get("files"))),
    ) if not is_right]  # fmt: skip
    if damaged:
        raise DataError(f"{shown(path)}: damaged, missing {damaged}; make the map again")
    for name in about["files"]:
        _tile_of(name)
    return about


def _is_size(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and 1e-3 <= value <= 1e3


def _is_list_of_words(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(word, str) for word in value)


def _is_table_of_files(value: Any) -> bool:
    return isinstance(value, dict) and all(
        isinstance(about, dict) and type(about.get("voxels")) is int and isinstance(about.get("sha256"), str)
        for about in value.values()
    )
