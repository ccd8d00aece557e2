"""One tile of a map as a Parquet file: 512 x 512 columns of voxels.

A tile holds the voxels whose index lies in [512 x, 512 x + 512) and [512 y, 512 y + 512): a local key (x 9 bits,
y 9 bits, z 14 bits), the sums of log-likelihoods, the hits, the sum of the points' heights over the bottom of the voxel
where it is known, and the label, confidence and state of each voxel. A refined map counts all hits, and in
`hits_removed` those of moving objects; log-likelihoods are of static objects only. It says in `reason` why a voxel was
removed. Keys are sorted and delta-coded, so a voxel takes about 11 bytes. Any Parquet reader opens it.
"""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.errors import DataError, one_line
from gnss_sem_map.files.untrusted import read_bytes, shown
from gnss_sem_map.labels.label_set import LabelSet
from gnss_sem_map.voxels.kernels import AXIS_BITS
from gnss_sem_map.voxels.semantic_map import Reason, SemanticMap
from gnss_sem_map.voxels.voxel_map import VoxelMap, pack, unpack

TILE_BITS = 9
Z_BITS = 14
Z_OFFSET = 1 << (Z_BITS - 1)
HITS_REMOVED = "hits_removed"
"""Column of maps in which objects moved through static voxels."""
REASON = "reason"
"""Column of maps in which voxels were removed."""
HEIGHTS = "heights"
"""Column of maps that know how high the surface in a voxel lies."""
OF_IMAGES = ("observations", "other")
"""Columns of maps that know how many images show a voxel, and the sum of their probabilities of `other` in 1/255."""
BY_DIFFERENCE = ("key", "hits", HEIGHTS, "label", "state", HITS_REMOVED, REASON, *OF_IMAGES)
"""Columns that are stored as differences. Sums and confidences are the same in many voxels, and their bytes as they are
pack better: without this a tile takes 20 % more."""
Tile = tuple[int, int]


def encode(piece: SemanticMap) -> bytes:
    """The voxels of one tile and what is decided about them."""
    columns = _columns_of(piece.voxels)
    columns |= {"label": piece.labels.astype(np.int32), "state": piece.states.astype(np.int32)}
    columns |= {"confidence": piece.confidence}
    if piece.hits_removed is not None and (piece.hits_removed != piece.hits_of_removed).any():
        columns[HITS_REMOVED] = piece.hits_removed
    if piece.reasons is not None and piece.reasons.any():
        columns[REASON] = piece.reasons.astype(np.int32)
    return as_parquet(columns)


def describe(piece: SemanticMap, content: bytes) -> dict[str, Any]:
    """What `map.json` says of a tile, which has this content as a file."""
    return {
        "voxels": len(piece),
        "points": int(piece.voxels.hits.sum(dtype=np.int64)),
        "sha256": hashlib.sha256(content).hexdigest(),
    }


def read(
    path: Path,
    tile: Tile,
    about: dict[str, Any],
    voxel_size_m: float,
    label_set: LabelSet,
    with_sums: bool = True,
) -> SemanticMap:
    """The tile that `encode` wrote, of so many `voxels` and with this `sha256`; raises DataError, with its name.

    Without the sums of log-likelihoods, it takes half the time.
    """
    needed = *(_sums_of(label_set) if with_sums else ()), "label", "confidence", "state"
    columns = _read(
        path, about, label_set, needed, (HITS_REMOVED, HEIGHTS, REASON, *(OF_IMAGES if with_sums else ()))
    )
    removed, reasons = columns.get(HITS_REMOVED), columns.get(REASON)
    return SemanticMap(
        voxels=_voxels_of(columns, tile, voxel_size_m, label_set),
        labels=columns["label"].astype(np.int8),
        confidence=columns["confidence"].astype(np.float32),
        states=columns["state"].astype(np.uint8),
        hits_removed=None if removed is None else removed.astype(np.uint32),
        reasons=None if reasons is None else reasons.astype(np.uint8),
    )


def read_voxels(
    path: Path, tile: Tile, about: dict[str, Any], voxel_size_m: float, label_set: LabelSet
) -> VoxelMap:
    """As `read`, without what is decided about the voxels: two thirds of the time."""
    columns = _read(path, about, label_set, _sums_of(label_set), (HEIGHTS, *OF_IMAGES))
    return _voxels_of(columns, tile, voxel_size_m, label_set)


def _read(
    path: Path, about: dict[str, Any], label_set: LabelSet, needed: tuple[str, ...], known: tuple[str, ...]
) -> dict[str, NDArray[Any]]:
    """Keys and hits of a tile, the `needed` columns, and those of the `known` ones that it has; raises DataError."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    content = read_bytes(path)
    try:
        if hashlib.sha256(content).hexdigest() != about["sha256"]:
            raise ValueError("its checksum is not that of map.json")
        file = pq.ParquetFile(pa.BufferReader(content))
        if file.metadata.num_rows != about["voxels"]:
            raise ValueError(f"found {file.metadata.num_rows} voxels, expected {about['voxels']}")
        names = ["key", "hits", *needed]
        names += [name for name in known if name in file.schema_arrow.names]
        table = file.read(columns=names)
        columns = {name: numbers_of(table, name) for name in names}
        _check(columns, len(label_set.names))
        return columns
    except (pa.ArrowException, OSError, ValueError, KeyError) as error:
        reason = one_line(error)
        raise DataError(f"{shown(path)}: damaged tile ({reason}); make the map again") from None


def _check(columns: dict[str, NDArray[Any]], classes: int) -> None:
    """Raise ValueError for labels and confidences that cannot be."""
    if "label" in columns and not ((columns["label"] >= -1) & (columns["label"] <= classes)).all():
        raise ValueError("it has labels of no class")
    if "confidence" in columns and not ((columns["confidence"] >= 0) & (columns["confidence"] <= 1)).all():
        raise ValueError("it has confidences beyond 0..1")
    if REASON in columns and not ((columns[REASON] >= 0) & (columns[REASON] < len(Reason))).all():
        raise ValueError("it has reasons that are none")


def encode_voxels(voxels: VoxelMap) -> bytes:
    """The voxels of one tile, without decisions, as a Parquet file."""
    return as_parquet(_columns_of(voxels))


def decode_voxels(content: bytes, tile: Tile, voxel_size_m: float, label_set: LabelSet) -> VoxelMap:
    """What `encode_voxels` wrote; raises ValueError or pyarrow's ArrowException for anything else."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = pq.ParquetFile(pa.BufferReader(content)).read()
    columns = {name: numbers_of(table, name) for name in table.column_names}
    return _voxels_of(columns, tile, voxel_size_m, label_set)


def _columns_of(voxels: VoxelMap) -> dict[str, NDArray[Any]]:
    # Parquet's smallest integer is 32 bits; it packs small ones tightly
    columns: dict[str, NDArray[Any]] = {"key": local_keys(voxels.keys)}
    columns |= dict(zip(_sums_of(voxels.label_set), voxels.evidence.T, strict=True))
    columns |= {"hits": voxels.hits}
    if voxels.of_images is not None:
        columns |= dict(zip(OF_IMAGES, voxels.of_images.T, strict=True))
    return columns if voxels.heights is None else columns | {HEIGHTS: voxels.heights}


def _sums_of(label_set: LabelSet) -> tuple[str, ...]:
    """Columns of the sums of log-likelihoods."""
    return tuple(f"log_{name}" for name in label_set.names)


def as_parquet(
    columns: Mapping[str, NDArray[Any]],
    by_difference: Collection[str] = BY_DIFFERENCE,
    page_checksums: bool = False,
) -> bytes:
    """Columns of numbers (n,) as a Parquet file, some of them stored as differences."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = pa.table({name: _arrow_column(values) for name, values in columns.items()})
    sink = pa.BufferOutputStream()
    pq.write_table(
        table, sink, compression="zstd", compression_level=1, use_dictionary=False,
        write_statistics=False, store_schema=False, write_page_checksum=page_checksums,
        column_encoding={name: "DELTA_BINARY_PACKED" for name in columns if name in by_difference},
    )  # fmt: skip
    return bytes(sink.getvalue())


def _arrow_column(values: NDArray[Any]) -> Any:
    """Numbers as a column; `pa.array` imports pandas, which takes 0.2 s and 40 MB of every worker."""
    import pyarrow as pa

    values = np.ascontiguousarray(values)
    return pa.Array.from_buffers(pa.from_numpy_dtype(values.dtype), len(values), [None, pa.py_buffer(values)])


def numbers_of(table: Any, name: str) -> NDArray[Any]:
    """A column as numbers without gaps; raises ValueError for anything else."""
    import pyarrow as pa

    chunks = table[name].chunks
    column = chunks[0] if len(chunks) == 1 else table[name].combine_chunks()  # which copies
    is_number = pa.types.is_floating if name == "confidence" else pa.types.is_integer
    if column.null_count or not is_number(column.type):
        raise ValueError(f"column {name} is {column.type} with {column.null_count} gaps")
    return np.from_dlpack(column)  # `to_numpy` imports pandas, which takes half a second


def _voxels_of(
    columns: dict[str, NDArray[Any]], tile: Tile, voxel_size_m: float, label_set: LabelSet
) -> VoxelMap:
    heights = columns.get(HEIGHTS)
    sums = [columns[name] for name in _sums_of(label_set) if name in columns]
    of_images = [columns[name] for name in OF_IMAGES if name in columns]
    return VoxelMap(
        voxel_size_m,
        label_set,
        global_keys(tile, columns["key"]),
        np.stack(sums, axis=1, dtype=np.int32) if sums else np.empty((len(columns["key"]), 0), np.int32),
        columns["hits"].astype(np.uint32),
        None if heights is None else heights.astype(np.int64),
        np.stack(of_images, axis=1, dtype=np.int32) if len(of_images) == len(OF_IMAGES) else None,
    )


def local_keys(keys: NDArray[np.int64]) -> NDArray[np.uint32]:
    """Keys of voxels inside their tile."""
    x, y, height = unpack(keys).T.astype(np.int64)
    z = height + Z_OFFSET
    if len(z) and (z.min() < 0 or z.max() >= 1 << Z_BITS):
        raise DataError(
            f"voxel heights {height.min()} to {height.max()} do not fit a tile (-{Z_OFFSET} to"
            f" {Z_OFFSET - 1}); check the heights of the trajectory"
        )
    mask = (1 << TILE_BITS) - 1
    local = (x & mask) << (TILE_BITS + Z_BITS) | (y & mask) << Z_BITS | z
    return np.asarray(local, np.uint32)


def global_keys(tile: Tile, local: NDArray[np.uint32]) -> NDArray[np.int64]:
    """Keys of a tile's voxels."""
    wide, mask = local.astype(np.int64), (1 << TILE_BITS) - 1
    first = pack(np.array([[tile[0] << TILE_BITS, tile[1] << TILE_BITS, -Z_OFFSET]]))
    x, y, z = wide >> (TILE_BITS + Z_BITS), wide >> Z_BITS & mask, wide & ((1 << Z_BITS) - 1)
    return np.asarray(first + (x << 2 * AXIS_BITS | y << AXIS_BITS | z), np.int64)


def morton_codes(
    x: NDArray[np.integer], y: NDArray[np.integer], z: NDArray[np.integer]
) -> NDArray[np.uint64]:
    """Places in Morton order (Z-order) of voxels by their indices, each (v,) and from 0 to 2^21 - 1."""
    return np.asarray(_spread(x) | _spread(y) << np.uint64(1) | _spread(z) << np.uint64(2))


def _spread(values: NDArray[np.integer]) -> NDArray[np.uint64]:
    """Values with two zero bits before each bit: halves move apart, then quarters and so on."""
    spread = values.astype(np.uint64)
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        spread = (spread | spread << np.uint64(shift)) & np.uint64(mask)
    return spread
