"""The map on disk: Parquet tiles of 512 x 512 columns, and `map.json` that says what they mean.

A tile `x_y.parquet` holds the voxels whose index lies in [512 x, 512 x + 512) and [512 y, 512 y + 512): a local key
(x 9 bits, y 9 bits, z 14 bits), the sums of log-likelihoods, the hits, and the decision for each voxel. Keys are sorted
and delta-coded, so a voxel takes about 12 bytes. Any Parquet reader opens them.
"""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from factor_graphs.geodesy import LocalFrame
from gnss_sem_map.errors import DataError
from gnss_sem_map.labels import LabelSet
from gnss_sem_map.voxel_map import SemanticMap, VoxelMap, pack, unpack

TILE_BITS = 9
Z_BITS = 14
Z_OFFSET = 1 << (Z_BITS - 1)
FORMAT = 1


def write(semantic_map: SemanticMap, folder: Path, frame: LocalFrame | None) -> None:
    """Write a map into a new folder; raises DataError for voxels more than 2^13 above or below the origin."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    folder.mkdir(parents=True)
    voxels = semantic_map.voxels
    tiles, local = _split(voxels.keys)
    order = np.lexsort((local, tiles[:, 1], tiles[:, 0]))
    tiles, local = tiles[order], local[order]
    edges = [0, *(np.flatnonzero(np.diff(tiles, axis=0).any(axis=1)) + 1).tolist(), len(tiles)]
    ranges = [(start, end) for start, end in pairwise(edges) if start < end]
    columns = _columns(semantic_map)
    for start, end in ranges:
        rows = order[start:end]
        table = pa.table(
            {"key": local[start:end], **{name: values[rows] for name, values in columns.items()}}
        )
        whole = [name for name in table.column_names if name != "confidence"]
        pq.write_table(
            table, folder / f"{tiles[start, 0]}_{tiles[start, 1]}.parquet", compression="zstd", use_dictionary=False,
            column_encoding=dict.fromkeys(whole, "DELTA_BINARY_PACKED") | {"confidence": "BYTE_STREAM_SPLIT"},
        )  # fmt: skip
    (folder / "map.json").write_text(json.dumps(_about(voxels, frame, len(ranges)), indent=1) + "\n", "utf-8")


def read(folder: Path, label_set: LabelSet) -> SemanticMap:
    """Read a map that `write` wrote; raises DataError when it is damaged or of another class set."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    about = _read_about(folder / "map.json")
    if tuple(about["classes"]) != label_set.names:
        raise DataError(f"{folder}: found classes {about['classes']}, expected {list(label_set.names)}")
    names = ["key", *(f"log_{name}" for name in label_set.names), "hits", "label", "confidence", "state"]
    parts: list[dict[str, NDArray[Any]]] = []
    for path in sorted(folder.glob("*.parquet")):
        try:
            table = pq.read_table(path, columns=names)
            x, y = (int(part) for part in path.stem.split("_"))
        except (pa.ArrowException, OSError, ValueError) as error:
            raise DataError(
                f"{path}: damaged tile ({str(error).splitlines()[0]}); make the map again"
            ) from None
        parts.append({name: table[name].to_numpy() for name in names})
        parts[-1]["key"] = _join(x, y, parts[-1]["key"])
    if len(parts) != about["tiles"]:
        raise DataError(f"{folder}: found {len(parts)} tiles, expected {about['tiles']}; make the map again")
    all_of = {
        name: np.concatenate([part[name] for part in parts]) if parts else np.empty(0) for name in names
    }
    order = np.argsort(all_of["key"])
    evidence = np.stack([all_of[f"log_{name}"] for name in label_set.names], axis=1)[order]
    voxels = VoxelMap(
        voxel_size_m=float(about["voxel_size_m"]),
        label_set=label_set,
        keys=all_of["key"][order].astype(np.int64),
        evidence=evidence.astype(np.int32),
        hits=all_of["hits"][order].astype(np.uint32),
    )
    return SemanticMap(
        voxels=voxels,
        labels=all_of["label"][order].astype(np.int8),
        confidence=all_of["confidence"][order].astype(np.float32),
        states=all_of["state"][order].astype(np.uint8),
    )


def _columns(semantic_map: SemanticMap) -> dict[str, NDArray[Any]]:
    voxels = semantic_map.voxels
    sums = {f"log_{name}": voxels.evidence[:, i] for i, name in enumerate(voxels.label_set.names)}
    # Parquet's smallest integer is 32 bits; it packs small ones tightly
    return sums | {
        "hits": voxels.hits,
        "label": semantic_map.labels.astype(np.int32),
        "state": semantic_map.states.astype(np.int32),
        "confidence": semantic_map.confidence,
    }


def _split(keys: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.uint32]]:
    """Tile (v, 2) and local key (v,) of every voxel."""
    indices = unpack(keys).astype(np.int64)
    z = indices[:, 2] + Z_OFFSET
    if len(z) and (z.min() < 0 or z.max() >= 1 << Z_BITS):
        raise DataError(
            f"voxel heights {indices[:, 2].min()} to {indices[:, 2].max()} do not fit a tile (-{Z_OFFSET} to"
            f" {Z_OFFSET - 1}); check the heights of the trajectory"
        )
    inside = indices[:, :2] & ((1 << TILE_BITS) - 1)
    local = inside[:, 0] << (TILE_BITS + Z_BITS) | inside[:, 1] << Z_BITS | z
    return indices[:, :2] >> TILE_BITS, local.astype(np.uint32)


def _join(tile_x: int, tile_y: int, local: NDArray[np.uint32]) -> NDArray[np.int64]:
    """Keys of a tile's voxels."""
    wide = local.astype(np.int64)
    mask = (1 << TILE_BITS) - 1
    x = (wide >> (TILE_BITS + Z_BITS)) + (tile_x << TILE_BITS)
    y = (wide >> Z_BITS & mask) + (tile_y << TILE_BITS)
    return pack(np.stack([x, y, (wide & ((1 << Z_BITS) - 1)) - Z_OFFSET], axis=1))


def _about(voxels: VoxelMap, frame: LocalFrame | None, tiles: int) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "voxel_size_m": voxels.voxel_size_m,
        "classes": list(voxels.label_set.names),
        "class_set": voxels.label_set.name,
        "origin": None
        if frame is None
        else {"lat_deg": frame.lat_deg, "lon_deg": frame.lon_deg, "alt_m": frame.alt_m},
        "axes": "east, north, up at the origin, m"
        if frame is not None
        else "x, y, z of the drive's own poses, m",
        "utm_epsg": None if frame is None else frame.utm_epsg,
        "tiles": tiles,
        "voxels": len(voxels),
        "points": int(voxels.hits.sum()),
        "evidence_unit": "2^-10 nat",
        "key": "x 9 bits, y 9 bits (inside the tile), z 14 bits (+ 8192), in voxels",
    }


def _read_about(path: Path) -> dict[str, Any]:
    try:
        about = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: no map here ({error})") from None
    missing = {"format", "voxel_size_m", "classes", "tiles"} - set(about)
    if missing or about["format"] != FORMAT:
        raise DataError(
            f"{path}: found format {about.get('format')}, missing {sorted(missing)}; expected format {FORMAT}"
        )
    return dict(about)
