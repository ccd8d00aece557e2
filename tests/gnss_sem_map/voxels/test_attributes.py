"""Attributes of voxels are the greatest stamp and the lower median of their points, as numpy finds them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from gnss_sem_map.errors import DataError
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.voxels import attributes
from gnss_sem_map.voxels.attribute_table import SAMPLE, WAITS, seen_of
from gnss_sem_map.voxels.attributes import (
    ATTRIBUTES,
    NOTHING,
    Attributes,
    combined,
    open_attributes,
    write,
)
from gnss_sem_map.voxels.map_json import describe, name_of
from gnss_sem_map.voxels.tiles import indices_by_tile
from gnss_sem_map.voxels.voxel_map import SMALLEST_TABLE, VoxelTable, pack

Points = tuple[np.ndarray, np.ndarray, np.ndarray]


def points_of(seed: int, each: int, voxels: int = 300) -> Points:
    """Keys, levels and moments of points, about so many in each voxel, in tiles on all sides of the origin."""
    rng = np.random.default_rng(seed)
    corners = rng.integers(-(1 << 19), 1 << 19, (6, 3)) * [1, 1, 0]
    places = (corners[:, None] + rng.integers(-20, 20, (1, voxels, 3))).reshape(-1, 3)
    count = each * len(places)
    return (
        pack(places[rng.integers(0, len(places), count)]),
        rng.integers(WAITS, 256, count).astype(np.int16),
        1_700_000_000_000_000 + rng.integers(0, 10**7, count),
    )


def in_table(*scans: Points) -> Attributes:
    table = VoxelTable(0.2, open_label_set(), with_attributes=True)
    for keys, *seen in scans:
        table.add(keys, seen=(seen[0], seen[1]))
    return Attributes(*table.attributes())


def assert_same(one: Attributes, other: Attributes) -> None:
    for mine, theirs in zip(one.columns, other.columns, strict=True):
        np.testing.assert_array_equal(mine, theirs)


def test_of_few_points_the_median_is_that_of_numpy() -> None:
    keys, levels, moments_us = points_of(0, 15)
    found = in_table(*zip(*(np.array_split(each, 7) for each in (keys, levels, moments_us)), strict=True))
    counted = levels != WAITS
    assert found.keys.tolist() == sorted(set(keys[counted].tolist()))
    assert found.points.max() <= SAMPLE
    for key, points, last_us, median in zip(*found.columns, strict=True):
        there = counted & (keys == key)
        assert points == there.sum()
        assert last_us == moments_us[there].max()
        assert median == np.percentile(levels[there], 50, method="lower")


def test_of_many_points_the_median_is_that_of_a_regular_sample() -> None:
    for count in (SAMPLE, SAMPLE + 1, 2 * SAMPLE, 5 * SAMPLE + 3, 1000):
        levels = np.random.default_rng(count).integers(0, 256, count).astype(np.int16)
        found = in_table((np.full(count, 7), levels, np.arange(count)))
        stride = 1
        while -(-count // stride) > SAMPLE:
            stride *= 2
        assert found.intensity[0] == np.percentile(levels[::stride], 50, method="lower")
        assert (found.points[0], found.last_us[0]) == (count, count - 1)


def test_points_may_be_seen_after_they_were_added() -> None:
    keys, levels, moments_us = points_of(5, 20)
    waits = np.random.default_rng(5).random(len(keys)) < 0.5
    table = VoxelTable(0.2, open_label_set(), with_attributes=True)
    table.add(keys, seen=(np.where(waits, np.int16(WAITS), levels), moments_us))
    table.see(keys[waits], (levels[waits], moments_us[waits]))
    order = np.argsort(waits, kind="stable")
    assert_same(Attributes(*table.attributes()), in_table((keys[order], levels[order], moments_us[order])))


def test_a_table_grows() -> None:
    keys = np.arange(1, 2 * SMALLEST_TABLE)
    found = in_table((keys, (keys % 256).astype(np.int16), keys))
    assert_same(found, Attributes(keys, np.ones_like(keys), keys, (keys % 256).astype(np.uint8)))


def test_intensities_that_are_none_count_as_dark_or_bright() -> None:
    values = np.array([np.nan, -1, 1, np.inf, 7, 0.25, 0.5], np.float32)
    valid = np.array([True] * 6 + [False])
    levels, moments_us = seen_of(values, np.array([2.0]), valid, 5)
    assert levels.tolist() == [0, 0, 255, 255, 255, 64]
    assert moments_us.tolist() == [2_000_005] * 6
    assert seen_of(values, np.arange(7.0), valid, 5)[1].tolist() == [5 + 10**6 * i for i in range(6)]


def test_parts_combine_in_any_order_and_number_of_rows_to_the_median_of_medians(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    parts = [in_table(points_of(seed, 5, voxels=50)) for seed in (1, 1, 2)]
    parts[1] = Attributes(parts[1].keys, 3 * parts[1].points, parts[1].last_us + 1, parts[1].intensity[::-1])
    whole = combined(parts)
    assert_same(combined(parts[::-1]), whole)
    for rows in (1, 50, 1000):
        monkeypatch.setattr(attributes, "ROWS_AT_ONCE", rows)
        assert_same(combined(parts), whole)
    assert_same(combined([parts[0]]), parts[0])
    assert_same(combined([]), NOTHING)
    for key, points, last_us, median in zip(*whole.columns, strict=True):
        there = [(part, int(np.flatnonzero(part.keys == key)[0])) for part in parts if key in part.keys]
        levels = np.repeat(
            [part.intensity[row] for part, row in there], [part.points[row] for part, row in there]
        )
        assert points == len(levels)
        assert last_us == max(part.last_us[row] for part, row in there)
        assert median == np.percentile(levels, 50, method="lower")


def test_voxels_without_any_have_0() -> None:
    known = in_table(points_of(3, 5))
    keys = np.sort(np.append(known.keys[::3], [1, (1 << 63) - 1]))
    found = known.of(keys)
    assert_same(found[np.flatnonzero(np.isin(keys, known.keys))], known[np.arange(0, len(known), 3)])
    assert not any(column[[0, -1]].any() for column in found.columns[1:])
    assert not NOTHING.of(keys).points.any()


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A run folder with attributes, and the names of the tiles of its map."""
    known = in_table(points_of(4, 5))
    write(((tile, known[rows]) for tile, rows in indices_by_tile(known.keys)), tmp_path / ATTRIBUTES)
    (tmp_path / "map").mkdir()
    voxels = {name_of(tile): len(rows) for tile, rows in indices_by_tile(known.keys)}
    about = {name: {"voxels": count, "points": 0, "sha256": ""} for name, count in voxels.items()}
    described = describe(0.2, open_label_set(), None, about)
    (tmp_path / "map/map.json").write_text(json.dumps(described))
    for name in voxels:
        (tmp_path / "map" / name).touch()
    return tmp_path


def test_files_hold_what_was_written(run: Path) -> None:
    opened, known = open_attributes(run), in_table(points_of(4, 5))
    assert opened is not None
    assert_same(opened.whole(), known)
    tiles = dict(indices_by_tile(known.keys))
    assert len(tiles) > 3
    for tile, rows in tiles.items():
        assert_same(opened.of(tile, known.keys[rows]), known[rows])


def test_a_damaged_file_is_refused_by_name(run: Path) -> None:
    opened = open_attributes(run)
    assert opened is not None
    tile, _ = next(indices_by_tile(in_table(points_of(4, 5)).keys))
    path, right = run / ATTRIBUTES / name_of(tile), opened.read_tile(tile)
    whole, refused = path.read_bytes(), list[str]()
    for place in range(0, len(whole), 7):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 0x10]) + whole[place + 1 :])
        try:
            assert_same(opened.read_tile(tile), right)  # a byte that tells nothing of the values
        except DataError as error:
            refused.append(str(error))
    assert len(refused) > 10
    assert all(name_of(tile) in message for message in refused)
    other, _ = list(indices_by_tile(right.of(in_table(points_of(4, 5)).keys).keys))[1]
    path.write_bytes((run / ATTRIBUTES / name_of(other)).read_bytes())
    with pytest.raises(DataError, match="expected"):
        opened.read_tile(tile)
    path.unlink()
    with pytest.raises(DataError, match=name_of(tile)):
        opened.read_tile(tile)
