"""Levels of detail of a map: the voxels of its tiles, and coarser ones for views from farther away.

A node of level k holds voxels of 2^k times the size of those of the map, in 2^k x 2^k tiles. So a node has 512 x 512
columns on every level, and its four quadrants are nodes of the next finer level. Of the voxels that are joined into
one, the most hit tells what is there. A labelled one that stands goes first: from afar, a wall has no holes where no
camera saw it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.voxels.semantic_map import SemanticMap
from gnss_sem_map.voxels.tile_files import TILE_BITS, Z_BITS, Tile, local_keys, morton_codes
from gnss_sem_map.voxels.tiles import TiledMap

COLUMNS = 1 << TILE_BITS


@dataclass(frozen=True, eq=False)
class Node:
    """The voxels of one level in one square, quadrant by quadrant, in Z-order: neighbours in space mostly follow each
    other.
    """

    level: int
    corner: Tile
    """Column and row of the square among those of its level, from the lowest of the map."""
    cells: NDArray[np.int16]
    """(v, 3) column and row in the square, and height above the lowest that a tile can hold, in voxels of the level."""
    labels: NDArray[np.uint8]
    """(v,) class, c for `other`, c + 1 for no label."""
    confidence: NDArray[np.uint8]
    """(v,) 0 to 255."""
    states: NDArray[np.uint8]
    """(v,) of `State`."""
    ranks: NDArray[np.uint64]
    """(v,) hits, and above them whether the voxel is shown: the highest rank wins when voxels are joined."""
    quadrants: tuple[int, ...]
    """Voxels in the south-west, south-east, north-west, north-east; all in the first in a tile, which has no finer."""

    def __len__(self) -> int:
        return len(self.cells)


def lowest_tile(tiles: Sequence[Tile]) -> Tile:
    """The westernmost column and the southernmost row of some tiles."""
    return min(x for x, _ in tiles), min(y for _, y in tiles)


def visit_nodes(tiled_map: TiledMap, visit: Callable[[Node], None], most_voxels: int) -> None:
    """Call `visit` with every node of a map, finer ones first, up to one of at most `most_voxels` that covers it.

    Each tile is read once. In memory are a tile and, of each level, at most four nodes.
    """
    west, south = lowest_tile(tiled_map.tiles)

    def node_of(level: int, corner: Tile, within: list[Tile]) -> Node:
        if level == 0:
            node = _of_tile(corner, tiled_map.read_tile((corner[0] + west, corner[1] + south)))
        else:
            finer: dict[Tile, list[Tile]] = {}
            for x, y in sorted(within, key=lambda tile: (tile[1] >> (level - 1), tile[0] >> (level - 1))):
                finer.setdefault((x >> (level - 1), y >> (level - 1)), []).append((x, y))
            node = _joined([_coarser(node_of(level - 1, *part)) for part in finer.items()])
        visit(node)
        return node

    tiles = [(x - west, y - south) for x, y in tiled_map.tiles]
    node = node_of(max(map(max, tiles)).bit_length(), (0, 0), tiles)
    while len(node) > most_voxels:
        node = _coarser(node)
        visit(node)


def _of_tile(corner: Tile, piece: SemanticMap) -> Node:
    keys = local_keys(piece.voxels.keys)
    x, y, z = keys >> (TILE_BITS + Z_BITS), keys >> Z_BITS & (COLUMNS - 1), keys & ((1 << Z_BITS) - 1)
    order = np.argsort(morton_codes(x, y, z))  # no two are equal
    labels = np.where(piece.labels < 0, len(piece.voxels.label_set.legend.names), piece.labels)
    ranks = piece.shown.astype(np.uint64) << np.uint64(32) | piece.voxels.hits
    return Node(
        level=0,
        corner=corner,
        cells=np.stack([x, y, z], axis=1).astype(np.int16)[order],
        labels=labels.astype(np.uint8)[order],
        confidence=np.rint(255 * piece.confidence).astype(np.uint8)[order],
        states=piece.states[order],
        ranks=ranks[order],
        quadrants=(len(piece), 0, 0, 0),
    )


def _coarser(node: Node) -> Node:
    """What a node is in that of the next coarser level: one of its quadrants.

    In Z-order the 2 x 2 x 2 voxels that are joined follow each other, and so do then those that are joined next.
    """
    x, y = node.corner
    place = np.array([COLUMNS * (x & 1), COLUMNS * (y & 1), 0], np.int16)
    cells = (node.cells + place) >> 1
    first = np.flatnonzero(np.diff(cells, axis=0, prepend=np.int16(-1)).any(axis=1))
    last_place = np.uint64((1 << 31) - 1)
    # of equal ranks the first wins
    words = node.ranks << np.uint64(31) | (last_place - np.arange(len(node), dtype=np.uint64))
    best = last_place - (np.maximum.reduceat(words, first) & last_place)
    quadrants = [0, 0, 0, 0]
    quadrants[(x & 1) | (y & 1) << 1] = len(first)
    return Node(
        level=node.level + 1,
        corner=(x >> 1, y >> 1),
        cells=cells[first],
        labels=node.labels[best],
        confidence=node.confidence[best],
        states=node.states[best],
        ranks=node.ranks[best],
        quadrants=tuple(quadrants),
    )


def _joined(quadrants: Sequence[Node]) -> Node:
    """A node of what its quadrants hold."""
    return Node(
        level=quadrants[0].level,
        corner=quadrants[0].corner,
        cells=np.concatenate([part.cells for part in quadrants]),
        labels=np.concatenate([part.labels for part in quadrants]),
        confidence=np.concatenate([part.confidence for part in quadrants]),
        states=np.concatenate([part.states for part in quadrants]),
        ranks=np.concatenate([part.ranks for part in quadrants]),
        quadrants=tuple(np.sum([part.quadrants for part in quadrants], axis=0).tolist()),
    )
