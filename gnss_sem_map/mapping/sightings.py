"""When each voxel of a finished map was last seen, and how strongly it reflects: of the points of all scans.

A row holds the points of one voxel with one of 256 intensities: how many they are, and the last moment. Rows are joined
exactly, in any order. A part of them is in memory; the others wait on disk, tile by tile, until all scans are read.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.files.atomic import adding_folder
from gnss_sem_map.voxels import attributes
from gnss_sem_map.voxels.attributes import Attributes
from gnss_sem_map.voxels.kernels import AXIS_BITS, AXIS_MASK, AXIS_OFFSET
from gnss_sem_map.voxels.tile_files import TILE_BITS, Z_BITS, Z_OFFSET, Tile, local_keys
from gnss_sem_map.voxels.tiles import TiledMap

Rows = NDArray[np.void]
ROW = np.dtype([("place", "<u8"), ("points", "<i8"), ("last_us", "<i8")])
"""The place is that of the tile, of the voxel in it (see `local_keys`), and the intensity."""
LEVEL_BITS = 8
LOCAL_BITS = 2 * TILE_BITS + Z_BITS
TILE_SHIFT = LOCAL_BITS + LEVEL_BITS
TILE_AXIS_BITS = AXIS_BITS - TILE_BITS
MOST_ROWS = 1 << 20
"""In memory: 25 MB, and twice that while they are joined."""


def rows_of(keys: NDArray[np.int64], intensity: NDArray[np.float32], moments_us: NDArray[np.int64]) -> Rows:
    """Rows of points (n,): their voxels, their intensities in 0..1, and when they were measured, Unix time in us."""
    x, y, z = keys >> 2 * AXIS_BITS, keys >> AXIS_BITS & AXIS_MASK, keys & AXIS_MASK
    mask = (1 << TILE_BITS) - 1
    tile = x >> TILE_BITS << TILE_AXIS_BITS | y >> TILE_BITS
    local = (x & mask) << TILE_BITS + Z_BITS | (y & mask) << Z_BITS | z - AXIS_OFFSET + Z_OFFSET
    level = np.rint(255 * np.clip(np.nan_to_num(intensity), 0, 1)).astype(np.int64)
    rows = np.empty(len(keys), ROW)
    rows["place"] = (tile << TILE_SHIFT | local << LEVEL_BITS | level).astype(np.uint64)
    rows["points"], rows["last_us"] = 1, moments_us
    return _joined([rows])


class Sightings:
    """Rows of all scans; those that do not fit in memory are in the files of a folder."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._waiting, self._tiles = folder, list[Rows](), set[int]()

    def add(self, rows: Rows) -> None:
        """Add rows, in any order; raises OSError."""
        self._waiting.append(rows)
        if sum(map(len, self._waiting)) > MOST_ROWS:
            self._waiting = [_joined(self._waiting)]
            if len(self._waiting[0]) > MOST_ROWS // 2:
                self._put_away()

    def write(self, tiled_map: TiledMap, folder: Path) -> None:
        """Write the attributes of all voxels of the map into a new folder; raises DataError."""
        with adding_folder(folder) as beside:
            self._put_away()
            for tile in tiled_map.tiles:
                local = local_keys(tiled_map.read_voxels(tile))
                attributes.write_tile(_attributes_of(local, self._rows_of(tile)), beside, tile)

    def _put_away(self) -> None:
        rows, self._waiting = _joined(self._waiting), []
        of_rows = rows["place"] >> np.uint64(TILE_SHIFT)
        for tile in np.unique(of_rows).tolist():
            first, last = np.searchsorted(of_rows, [tile, tile + 1])
            self._tiles.add(tile)
            with (self._folder / str(tile)).open("ab") as file:
                rows[first:last].tofile(file)

    def _rows_of(self, tile: Tile) -> Rows:
        """All rows of a tile, joined."""
        first = AXIS_OFFSET >> TILE_BITS
        number = tile[0] + first << TILE_AXIS_BITS | tile[1] + first
        rows = np.empty(0, ROW)
        if number in self._tiles:
            for part in _parts_of(self._folder / str(number)):
                rows = _joined([rows, part])
        return rows


def _parts_of(file: Path) -> Iterator[Rows]:
    with file.open("rb") as opened:
        while len(part := np.fromfile(opened, ROW, MOST_ROWS)):
            yield part


def _joined(parts: Sequence[Rows]) -> Rows:
    """One row for each place, in their order."""
    rows = np.concatenate([np.empty(0, ROW), *parts])
    rows = rows[np.argsort(rows["place"], kind="stable")]
    starts = _starts(rows["place"])
    if len(starts) == len(rows):
        return rows
    joined = rows[starts]
    joined["points"] = np.add.reduceat(rows["points"], starts)
    joined["last_us"] = np.maximum.reduceat(rows["last_us"], starts)
    return joined


def _starts(values: NDArray[np.uint64]) -> NDArray[np.int64]:
    """Where another value begins."""
    changes = np.ones(len(values), np.bool_)
    changes[1:] = values[1:] != values[:-1]
    return np.flatnonzero(changes)


def _attributes_of(local: NDArray[np.uint32], rows: Rows) -> Attributes:
    """Attributes of voxels (v,), which are sorted, of the joined rows of their tile."""
    found = Attributes(np.zeros(len(local), np.int64), np.zeros(len(local), np.uint8))
    if not len(rows):
        return found
    of_rows = rows["place"] >> np.uint64(LEVEL_BITS) & np.uint64((1 << LOCAL_BITS) - 1)
    starts = _starts(of_rows)
    places = np.searchsorted(local, of_rows[starts].astype(np.uint32))
    found.last_us[places] = np.maximum.reduceat(rows["last_us"], starts)
    until = np.cumsum(rows["points"])
    before, points = until[starts] - rows["points"][starts], np.add.reduceat(rows["points"], starts)
    middles = np.searchsorted(until, before + (points + 1) // 2)
    found.intensity[places] = rows["place"][middles] & np.uint64((1 << LEVEL_BITS) - 1)
    return found
