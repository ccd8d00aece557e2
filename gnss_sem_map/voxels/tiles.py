"""The map on disk: Parquet tiles of 512 x 512 columns of voxels, described by `map.json`.

A tile `x_y.parquet` holds the voxels whose index lies in [512 x, 512 x + 512) and [512 y, 512 y + 512): a local key
(x 9 bits, y 9 bits, z 14 bits), the sums of log-likelihoods, the hits, and the label, confidence and state of each
voxel. A refined map counts all hits, and in `hits_removed` those of moving objects; its sums are of static objects
only. Keys are sorted and delta-coded, so a voxel takes about 12 bytes. Any Parquet reader opens them. A map folder is
written completely or not at all; `map.json` holds the checksum of every tile.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from factor_graphs.geodesy import LocalFrame
from gnss_sem_map.errors import DataError
from gnss_sem_map.files.structured import read_json
from gnss_sem_map.files.untrusted import is_file, read_bytes, shown
from gnss_sem_map.labels.label_set import LabelSet, open_label_set
from gnss_sem_map.voxels.kernels import AXIS_BITS, AXIS_OFFSET
from gnss_sem_map.voxels.semantic_map import SemanticMap, State
from gnss_sem_map.voxels.voxel_map import VoxelMap, pack, unpack

TILE_BITS = 9
Z_BITS = 14
Z_OFFSET = 1 << (Z_BITS - 1)
FORMAT = 2
HITS_REMOVED = "hits_removed"
"""Column of maps in which objects moved through static voxels."""
Tile = tuple[int, int]
NAME = re.compile(r"(-?\d{1,6})_(-?\d{1,6})\.parquet", re.ASCII)


def write(semantic_map: SemanticMap, folder: Path, frame: LocalFrame | None) -> None:
    """Write a map into a new folder; raises DataError for voxels more than 2^13 above or below the origin."""
    voxels = semantic_map.voxels
    pieces = ((tile, _piece(semantic_map, indices)) for tile, indices in _indices_by_tile(voxels.keys))
    write_tiles(pieces, folder, frame, voxels.voxel_size_m, voxels.label_set)


def write_tiles(
    pieces: Iterable[tuple[Tile, SemanticMap]],
    folder: Path,
    frame: LocalFrame | None,
    voxel_size_m: float,
    label_set: LabelSet,
) -> None:
    """Write a map tile by tile, each tile once, into a new folder: one tile at a time is in memory.

    Raises DataError when the folder exists, the disk is full, or a voxel is more than 2^13 above or below the origin.
    """
    if folder.exists():
        raise DataError(f"{folder}: exists; remove it or choose another folder")
    beside = folder.with_name(f".{folder.name}.{os.getpid()}.part")
    files: dict[str, dict[str, Any]] = {}
    points = 0
    try:
        beside.mkdir(parents=True)
        for (x, y), piece in pieces:
            content = _encode(piece)
            (beside / f"{x}_{y}.parquet").write_bytes(content)
            checksum = hashlib.sha256(content).hexdigest()
            files[f"{x}_{y}.parquet"] = {"voxels": len(piece), "sha256": checksum}
            points += int(piece.voxels.hits.sum())
        about = _about(voxel_size_m, label_set, frame, files, points)
        (beside / "map.json").write_text(json.dumps(about, indent=1) + "\n", "utf-8")
        beside.rename(folder)
    except OSError as error:
        raise DataError(
            f"{folder}: cannot write the map ({error.strerror}); free the disk or choose another place"
        ) from None
    finally:
        shutil.rmtree(beside, ignore_errors=True)


def read(
    folder: Path, label_set: LabelSet | None = None, box: tuple[ArrayLike, ArrayLike] | None = None
) -> SemanticMap:
    """Read a map, or the voxels with centres in a box (low, high), each (3,) m; only the tiles of the box are opened.

    Without `label_set` the class set is the one that the map names. Raises DataError when the map is damaged,
    incomplete, or of another class set.
    """
    about = _read_about(folder / "map.json")
    label_set = label_set or open_label_set(str(about.get("class_set")))
    if tuple(about["classes"]) != label_set.names:
        raise DataError(
            f"{shown(folder)}: found classes {about['classes']}, expected {list(label_set.names)}"
        )
    voxel_size_m = float(about["voxel_size_m"])
    missing = [name for name in about["files"] if not is_file(folder / name)]
    if missing:
        raise DataError(
            f"{shown(folder)}: found {len(about['files']) - len(missing)} tiles, expected {len(about['files'])}, such"
            f" as {missing[0]}; make the map again"
        )
    names = [name for name in about["files"] if _touches(_tile_of(name), box, voxel_size_m)]
    parts = [_decode(folder / name, about["files"][name], label_set) for name in sorted(names)]
    return _join(parts, voxel_size_m, label_set, box)


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


def _piece(semantic_map: SemanticMap, indices: NDArray[np.int64]) -> SemanticMap:
    return SemanticMap(
        semantic_map.voxels[indices],
        semantic_map.labels[indices],
        semantic_map.confidence[indices],
        semantic_map.states[indices],
        hits_removed=None if semantic_map.hits_removed is None else semantic_map.hits_removed[indices],
    )


def _encode(piece: SemanticMap) -> bytes:
    """One tile as a Parquet file."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    voxels = piece.voxels
    # Parquet's smallest integer is 32 bits; it packs small ones tightly
    columns: dict[str, NDArray[Any]] = {"key": _local(voxels)}
    columns |= {f"log_{name}": voxels.evidence[:, i] for i, name in enumerate(voxels.label_set.names)}
    columns |= {"hits": voxels.hits, "label": piece.labels.astype(np.int32)}
    columns |= {"state": piece.states.astype(np.int32), "confidence": piece.confidence}
    if piece.hits_removed is not None:
        columns[HITS_REMOVED] = piece.hits_removed
    whole = [name for name in columns if name != "confidence"]
    sink = pa.BufferOutputStream()
    pq.write_table(
        pa.table(columns), sink, compression="zstd", use_dictionary=False, write_statistics=False,
        column_encoding=dict.fromkeys(whole, "DELTA_BINARY_PACKED") | {"confidence": "BYTE_STREAM_SPLIT"},
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
        names += [HITS_REMOVED] * (HITS_REMOVED in file.schema_arrow.names)
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


def _join(
    parts: list[dict[str, NDArray[Any]]],
    voxel_size_m: float,
    label_set: LabelSet,
    box: tuple[ArrayLike, ArrayLike] | None,
) -> SemanticMap:
    if box is not None:
        parts = [_inside(part, box, voxel_size_m) for part in parts]

    def column(name: str, dtype: type[np.generic]) -> NDArray[Any]:
        return np.concatenate([np.empty(0, dtype), *(part[name].astype(dtype, copy=False) for part in parts)])

    keys = column("key", np.int64)
    order = np.argsort(keys)
    evidence = np.empty((len(keys), len(label_set.names)), np.int32)
    for i, name in enumerate(label_set.names):
        evidence[:, i] = column(f"log_{name}", np.int32)[order]
    voxels = VoxelMap(voxel_size_m, label_set, keys[order], evidence, column("hits", np.uint32)[order])
    are_told = bool(parts) and all(HITS_REMOVED in part for part in parts)
    return SemanticMap(
        voxels=voxels,
        labels=column("label", np.int8)[order],
        confidence=column("confidence", np.float32)[order],
        states=column("state", np.uint8)[order],
        hits_removed=column(HITS_REMOVED, np.uint32)[order] if are_told else None,
    )


def _touches(tile: Tile, box: tuple[ArrayLike, ArrayLike] | None, voxel_size_m: float) -> bool:
    if box is None:
        return True
    low = np.array(tile) * voxel_size_m * (1 << TILE_BITS)
    high = low + voxel_size_m * (1 << TILE_BITS)
    return bool((low <= np.asarray(box[1])[:2]).all() and (high >= np.asarray(box[0])[:2]).all())


def _inside(
    part: dict[str, NDArray[Any]], box: tuple[ArrayLike, ArrayLike], voxel_size_m: float
) -> dict[str, NDArray[Any]]:
    centres = (unpack(part["key"]) + 0.5) * voxel_size_m
    inside = ((centres >= np.asarray(box[0])) & (centres <= np.asarray(box[1]))).all(axis=1)
    return {name: values[inside] for name, values in part.items()}


def _local(voxels: VoxelMap) -> NDArray[np.uint32]:
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
    points: int,
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
        "points": points,
        "evidence_unit": "2^-10 nat",
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
