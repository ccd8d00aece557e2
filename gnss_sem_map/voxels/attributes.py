"""Attributes of voxels: last moment and median intensity, in a Parquet file beside the map for each of its tiles.

Neither is a sum, so neither is in the tiles of a map, from which drives and moving objects are subtracted. Chunks of
scans have such files as well, and are `combined`, as are the drives of a map.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.errors import DataError, one_line
from gnss_sem_map.files.untrusted import is_folder, read_bytes, shown
from gnss_sem_map.files.work_folder import DRIVES
from gnss_sem_map.voxels.map_json import files_of, name_of, tile_of
from gnss_sem_map.voxels.tile_files import Tile, as_parquet, global_keys, local_keys, numbers_of

ATTRIBUTES = "attributes"
"""Folder beside a map."""
COLUMNS = ("key", "points", "last_us", "intensity")


@dataclass(frozen=True, eq=False)
class Attributes:
    """What points say of their voxels beside their classes."""

    keys: NDArray[np.int64]
    """(v,) of the voxels, sorted, unique."""
    points: NDArray[np.int64]
    """(v,) that tell it."""
    last_us: NDArray[np.int64]
    """(v,) when the last of them was measured, Unix time in us; 0 where none is known."""
    intensity: NDArray[np.uint8]
    """(v,) their median, 255 for an intensity of 1; of two in the middle the lower one."""

    def __len__(self) -> int:
        return len(self.keys)

    def __getitem__(self, chosen: NDArray[np.int64]) -> Attributes:
        return Attributes(*(column[chosen] for column in self.columns))

    @property
    def columns(self) -> tuple[NDArray[Any], ...]:
        return self.keys, self.points, self.last_us, self.intensity

    def of(self, keys: NDArray[np.int64]) -> Attributes:
        """Those of voxels (n,); 0 where there are none."""
        if len(keys) == len(self) and (keys == self.keys).all():
            return self
        places = np.searchsorted(self.keys, keys)
        places[places == len(self)] = 0
        known = self.keys[places] == keys if len(self) else np.zeros(len(keys), np.bool_)
        found = [np.zeros(len(keys), column.dtype) for column in self.columns[1:]]
        for column, values in zip(found, self.columns[1:], strict=True):
            column[known] = values[places[known]]
        return Attributes(keys, *found)


ROWS_AT_ONCE = 1 << 18
NOTHING = Attributes(
    np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0, np.uint8)
)


def combined(parts: Sequence[Attributes]) -> Attributes:
    """Those of all points of some parts, in any order: the last moment, and the median of the medians.

    Each median counts as often as it has points. Rows of some voxels at a time are looked at: to sort them takes four
    times their memory, and a tile that is driven through again and again has millions.
    """
    longest = max(parts, key=len, default=NOTHING)
    step = len(longest) * ROWS_AT_ONCE // max(sum(map(len, parts)), 1)
    edges = np.sort(longest.keys)[step + 1 :: step + 1]
    places = [np.searchsorted(edges, part.keys, side="right") for part in parts]
    found = [
        _combined([part[np.flatnonzero(place == k)] for part, place in zip(parts, places, strict=True)])
        for k in range(len(edges) + 1)
    ]
    return Attributes(*_columns(found))


def _columns(parts: Sequence[Attributes]) -> Iterator[NDArray[Any]]:
    """The columns of all parts."""
    return map(np.concatenate, zip(NOTHING.columns, *(part.columns for part in parts), strict=True))


def _combined(parts: Sequence[Attributes]) -> Attributes:
    keys, points, last_us, intensity = _columns(parts)
    order = np.lexsort((intensity, keys))
    keys, points, last_us, intensity = keys[order], points[order], last_us[order], intensity[order]
    changes = np.ones(len(keys), np.bool_)
    changes[1:] = keys[1:] != keys[:-1]
    starts = np.flatnonzero(changes)
    if not len(starts):
        return NOTHING
    until = np.cumsum(points)
    before = until[starts] - points[starts]
    of_voxel = np.diff(before, append=until[-1])
    middles = np.searchsorted(until, before + (of_voxel + 1) // 2)
    return Attributes(keys[starts], of_voxel, np.maximum.reduceat(last_us, starts), intensity[middles])


def encode(attributes: Attributes) -> bytes:
    """The file of a tile."""
    _, points, last_us, intensity = attributes.columns
    values = local_keys(attributes.keys), points, last_us, intensity.astype(np.int32)
    return as_parquet(dict(zip(COLUMNS, values, strict=True)), by_difference=COLUMNS, page_checksums=True)


def write(attributes: Iterable[tuple[Tile, Attributes]], folder: Path) -> None:
    """Write those of the tiles of a map into a new folder; raises OSError."""
    folder.mkdir()
    for tile, of_tile in attributes:
        (folder / name_of(tile)).write_bytes(encode(of_tile))


def decode(content: bytes, tile: Tile) -> Attributes:
    """What `encode` wrote; raises ValueError where it is damaged."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        table = pq.ParquetFile(pa.BufferReader(content), page_checksum_verification=True).read()
        local, points, last_us, intensity = (numbers_of(table, name) for name in COLUMNS)
    except (pa.ArrowException, OSError, KeyError) as error:
        raise ValueError(one_line(error)) from None
    keys = global_keys(tile, local)
    if not (keys[1:] > keys[:-1]).all():
        raise ValueError("its keys are not sorted and unique")
    if not ((intensity >= 0) & (intensity <= 255) & (points > 0)).all():
        raise ValueError("it has intensities beyond 0..255, or voxels without points")
    return Attributes(keys, points.astype(np.int64), last_us.astype(np.int64), intensity.astype(np.uint8))


@dataclass(frozen=True)
class TiledAttributes:
    """The attributes of a map on disk, tile by tile; `open_attributes` makes it."""

    folders: tuple[Path, ...]
    """Of its drives."""

    def of(self, tile: Tile, keys: NDArray[np.int64]) -> Attributes:
        """Those of voxels (n,) of a tile; raises DataError."""
        return self.read_tile(tile).of(keys)

    def read_tile(self, tile: Tile) -> Attributes:
        """Those of all voxels of a tile; raises DataError."""
        parts = [
            _read(folder / name_of(tile), tile, voxels[name_of(tile)])
            for folder, voxels in zip(self.folders, self._voxels, strict=True)
            if name_of(tile) in voxels
        ]
        return parts[0] if len(parts) == 1 else combined(parts)

    def whole(self) -> Attributes:
        """Those of all voxels at once; raises DataError."""
        return combined([self.read_tile(tile_of(name)) for name in sorted(set[str]().union(*self._voxels))])

    @cached_property
    def _voxels(self) -> list[dict[str, int]]:
        """Name of every tile of the map of each drive -> how many voxels it has."""
        files = [files_of(folder.parent / "map") for folder in self.folders]
        return [{name: about["voxels"] for name, about in of_drive.items()} for of_drive in files]


def open_attributes(run: Path) -> TiledAttributes | None:
    """The attributes of a run folder; None where it has none, or one of its drives, as older versions wrote them."""
    drives = sorted((run / DRIVES).iterdir()) if is_folder(run / DRIVES) else [run]
    folders = tuple(drive / ATTRIBUTES for drive in drives)
    return TiledAttributes(folders) if all(map(is_folder, folders)) else None


def _read(path: Path, tile: Tile, voxels: int) -> Attributes:
    content = read_bytes(path)
    try:
        found = decode(content, tile)
        if len(found) != voxels:
            raise ValueError(f"found {len(found)} voxels, expected {voxels}")
        return found
    except ValueError as error:
        raise DataError(
            f"{shown(path)}: damaged attributes ({error}); make the run again, or remove the folder"
            f" {shown(path.parent)} to export without them"
        ) from None
