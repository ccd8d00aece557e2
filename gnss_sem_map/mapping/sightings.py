"""When each voxel of a finished map was last seen, and how strongly it reflects: of the points of all scans.

A row holds points of one voxel with one of 256 intensities: how many they are, and the last moment. Rows add up
exactly, in any order. Some of them are in memory; the others wait on disk, a file for each strip of a tile, until all
scans are read.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numba import njit, uint64
from numpy.typing import NDArray

from gnss_sem_map.files.atomic import adding_folder
from gnss_sem_map.voxels import attributes
from gnss_sem_map.voxels.attributes import Attributes
from gnss_sem_map.voxels.kernels import AXIS_BITS, AXIS_MASK, AXIS_OFFSET, home
from gnss_sem_map.voxels.tile_files import TILE_BITS, Z_BITS, Z_OFFSET, Tile, local_keys
from gnss_sem_map.voxels.tiles import TiledMap

Rows = NDArray[np.void]
ROW = np.dtype([("place", "<u8"), ("last_us", "<i8"), ("points", "<u4")], align=True)
"""The place is that of the tile, of the voxel in it (see `local_keys`), and the intensity. Aligned rows are sorted in
half the time."""
LEVEL_BITS = 8
LOCAL_BITS = 2 * TILE_BITS + Z_BITS
TILE_SHIFT = LOCAL_BITS + LEVEL_BITS
TILE_AXIS_BITS = AXIS_BITS - TILE_BITS
MOST_ROWS = 1 << 19
"""In memory: 21 MB, and 20 MB more while they are put away."""
STRIP_BITS = 4
"""A tile is decided in so many strips, 2^4 of 6.4 m: few MB at a time."""
STRIP_SHIFT = TILE_SHIFT - STRIP_BITS


class Seen(NamedTuple):
    """Points (n,) of one scan."""

    keys: NDArray[np.int64]
    """Their voxels."""
    intensity: NDArray[np.float32]
    """In 0..1."""
    moments_us: NDArray[np.int64]
    """When they were measured, Unix time in us."""


class Sightings:
    """Rows of all scans: a table of those in memory, and the files of a folder with the others."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._strips, self._rows = folder, set[int](), 0
        slots = 2 * MOST_ROWS
        self._places, self._last_us = np.empty(slots, np.uint64), np.empty(slots, np.int64)
        self._points = np.zeros(slots, np.uint32)  # 0: an empty slot

    def add(self, seen: Seen) -> None:
        """Add points, in any order; raises OSError."""
        done = 0
        while done < len(seen.keys):
            done, self._rows = _count(
                *seen, done, self._rows, MOST_ROWS, self._places, self._points, self._last_us
            )
            if self._rows == MOST_ROWS:
                self._put_away()

    def write(self, tiled_map: TiledMap, folder: Path) -> None:
        """Write the attributes of all voxels of the map into a new folder; raises DataError."""
        with adding_folder(folder) as beside:
            self._put_away()
            for tile in tiled_map.tiles:
                local = local_keys(tiled_map.read_voxels(tile))
                attributes.write_tile(self._attributes_of(tile, local), beside, tile)

    def _put_away(self) -> None:
        """Append the rows of the table to the files of their strips."""
        slots = np.flatnonzero(self._points)
        slots = slots[np.argsort(self._places[slots])]
        rows = np.zeros(len(slots), ROW)
        rows["place"], rows["points"] = self._places[slots], self._points[slots]
        rows["last_us"] = self._last_us[slots]
        self._points[:], self._rows = 0, 0
        strips = rows["place"] >> np.uint64(STRIP_SHIFT)
        starts = _starts(strips)
        ends = np.append(starts, len(rows))[1:]
        for strip, start, end in zip(strips[starts].tolist(), starts, ends, strict=True):
            self._strips.add(strip)
            with (self._folder / str(strip)).open("ab") as file:
                file.write(rows[start:end].tobytes())  # `tofile` would not say why it fails

    def _attributes_of(self, tile: Tile, local: NDArray[np.uint32]) -> Attributes:
        """Attributes of the voxels (v,) of a tile, which are sorted."""
        found = Attributes(np.zeros(len(local), np.int64), np.zeros(len(local), np.uint8))
        first = AXIS_OFFSET >> TILE_BITS
        number = tile[0] + first << TILE_AXIS_BITS | tile[1] + first
        for strip in range(number << STRIP_BITS, number + 1 << STRIP_BITS):
            if strip in self._strips:
                _decide(np.fromfile(self._folder / str(strip), ROW), local, found)
        return found


@njit(cache=True, nogil=True)
def _count(keys, intensity, moments_us, first, rows, most, places, points, last_us):
    """Count points from the first on, until a row more than `most` would be needed: the next point, and the rows."""
    mask, slots = (1 << TILE_BITS) - 1, len(places)
    for i in range(first, len(keys)):
        x, y, z = keys[i] >> 2 * AXIS_BITS, keys[i] >> AXIS_BITS & AXIS_MASK, keys[i] & AXIS_MASK
        tile = x >> TILE_BITS << TILE_AXIS_BITS | y >> TILE_BITS
        local = (x & mask) << TILE_BITS + Z_BITS | (y & mask) << Z_BITS | (z - AXIS_OFFSET + Z_OFFSET)
        level = 0
        if intensity[i] > 0:  # not for NaN
            level = int(np.rint(min(np.float32(255) * intensity[i], np.float32(255))))
        place = uint64(tile << TILE_SHIFT | local << LEVEL_BITS | level)
        slot = home(place, slots)
        while points[slot] > 0 and places[slot] != place:
            slot = (slot + 1) & (slots - 1)
        if points[slot] == 0:
            if rows == most:
                return i, rows
            places[slot], last_us[slot] = place, moments_us[i]
            rows += 1
        points[slot] += 1
        last_us[slot] = max(last_us[slot], moments_us[i])
    return len(keys), rows


def _decide(rows: Rows, local: NDArray[np.uint32], found: Attributes) -> None:
    """Set the attributes of those of the voxels (v,) of a tile that have rows."""
    rows = rows.take(np.argsort(rows["place"], kind="stable"))  # quick: of sorted parts
    of_rows = rows["place"] >> np.uint64(LEVEL_BITS) & np.uint64((1 << LOCAL_BITS) - 1)
    starts = _starts(of_rows)
    places = np.searchsorted(local, of_rows[starts].astype(np.uint32))
    found.last_us[places] = np.maximum.reduceat(rows["last_us"], starts)
    until = np.cumsum(rows["points"], dtype=np.int64)
    before = until[starts] - rows["points"][starts]
    points = np.diff(before, append=until[-1])
    middles = np.searchsorted(until, before + (points + 1) // 2)
    found.intensity[places] = rows["place"][middles] & np.uint64((1 << LEVEL_BITS) - 1)


def _starts(values: NDArray[np.uint64]) -> NDArray[np.int64]:
    """Where another value begins."""
    changes = np.ones(len(values), np.bool_)
    changes[1:] = values[1:] != values[:-1]
    return np.flatnonzero(changes)
