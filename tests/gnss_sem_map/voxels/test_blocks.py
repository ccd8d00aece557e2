"""Tiles are refined together by what the map holds alone, so whoever asks finds the same blocks."""

from __future__ import annotations

from random import Random

from hypothesis import given
from hypothesis import strategies as st

from gnss_sem_map.voxels.blocks import MOST_VOXELS, blocks_of, bounds_of, tiles_around
from gnss_sem_map.voxels.tile_files import Tile

axis = st.integers(-5, 5)
maps = st.dictionaries(st.tuples(axis, axis), st.integers(1, MOST_VOXELS), min_size=1, max_size=30)


@given(maps, st.randoms())
def test_each_tile_is_in_one_block_of_few_voxels_whatever_the_order(
    voxels: dict[Tile, int], random: Random
) -> None:
    blocks = blocks_of(voxels)
    assert sorted(tile for block in blocks for tile in block) == sorted(voxels)
    for block in blocks:
        (x, y), (last_x, last_y) = bounds_of(block)
        assert last_x - x <= 1
        assert last_y - y <= 1
        assert len(block) == 1 or sum(voxels[tile] for tile in block) <= MOST_VOXELS
    tiles = list(voxels)
    random.shuffle(tiles)
    assert blocks_of({tile: voxels[tile] for tile in tiles}) == blocks


def test_the_four_tiles_at_the_origin_are_one_block_unless_they_hold_too_much() -> None:
    four = dict.fromkeys([(-1, -1), (-1, 0), (0, -1), (0, 0)], MOST_VOXELS // 4)
    assert blocks_of(four | {(1, 0): 1}) == [tuple(four), ((1, 0),)]
    assert blocks_of(four | {(0, 0): MOST_VOXELS // 4 + 1}) == [(tile,) for tile in four]
    assert blocks_of({}) == [((0, 0),)]


def test_around_a_block_are_the_tiles_of_its_rectangle_and_its_neighbours() -> None:
    assert bounds_of(((-1, 0), (0, -1))) == ((-1, -1), (0, 0))
    assert list(tiles_around(((3, 0), (4, 0)), 0)) == [(3, 0), (4, 0)]
    around = set(tiles_around(((3, 0), (4, 0)), 1))
    assert around == {(x, y) for x in range(2, 6) for y in (-1, 0, 1)}
