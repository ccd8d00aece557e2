"""Attributes of voxels are the greatest stamp and the lower median of their points, as numpy finds them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gnss_sem_map.errors import DataError
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.mapping import sightings
from gnss_sem_map.mapping.sightings import Seen, Sightings
from gnss_sem_map.voxels.attributes import read_tile
from gnss_sem_map.voxels.map_json import name_of
from gnss_sem_map.voxels.semantic_map import SemanticMap
from gnss_sem_map.voxels.tiles import TiledMap, in_memory
from gnss_sem_map.voxels.voxel_map import VoxelMap, pack

SCANS, POINTS = 30, 4_000
LABELS = open_label_set()


@pytest.fixture(scope="module")
def points() -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Keys, intensities and moments of scans, in tiles on all sides of the origin."""
    rng = np.random.default_rng(11)
    corners = rng.integers(-(1 << 19), 1 << 19, (6, 3)) * [1, 1, 0]
    places = np.concatenate([corners, [[0, 0, 0]]])[:, None] + rng.integers(-20, 20, (1, 300, 3))
    places = places.reshape(-1, 3)
    return [
        (
            pack(places[rng.integers(0, len(places), POINTS)]),
            (rng.integers(0, 101, POINTS) / 100).astype(np.float32),
            1_700_000_000_000_000 + rng.integers(0, 10**7, POINTS),
        )
        for _ in range(SCANS)
    ]


@pytest.fixture(scope="module")
def tiled(points: list[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> TiledMap:
    """The voxels of these points, and one that no scan saw."""
    unseen = pack(np.array([[7, 7, 3000]]))
    keys = np.unique(np.concatenate([*(found for found, _, _ in points), unseen]))
    evidence = np.zeros((len(keys), len(LABELS.names)), np.int32)
    return in_memory(SemanticMap.of(VoxelMap(0.2, LABELS, keys, evidence, np.ones(len(keys), np.uint32))))


def written(points: list[tuple[np.ndarray, np.ndarray, np.ndarray]], tiled: TiledMap, folder: Path) -> Path:
    (folder / "waiting").mkdir(parents=True)
    seen = Sightings(folder / "waiting")
    for each in points:
        seen.add(Seen(*each))
    seen.write(tiled, folder / "attributes")
    return folder / "attributes"


def test_they_are_those_of_numpy(
    points: list[tuple[np.ndarray, np.ndarray, np.ndarray]], tiled: TiledMap, tmp_path: Path
) -> None:
    folder = written(points, tiled, tmp_path)
    keys, intensity, moments = map(np.concatenate, zip(*points, strict=True))
    levels = np.rint(255 * intensity)
    unseen = 0
    assert len(tiled.tiles) > 8
    for tile in tiled.tiles:
        voxels = tiled.read_voxels(tile)
        found = read_tile(folder, tile, len(voxels))
        for key, last_us, median in zip(voxels.keys, found.last_us, found.intensity, strict=True):
            there = keys == key
            unseen += not there.any()
            assert last_us == max(moments[there], default=0)
            assert median == (np.percentile(levels[there], 50, method="lower") if there.any() else 0)
    assert unseen == 1


def test_any_order_and_any_memory_give_the_same_bytes(
    points: list[tuple[np.ndarray, np.ndarray, np.ndarray]],
    tiled: TiledMap,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    at_once = written(points, tiled, tmp_path / "at_once")
    monkeypatch.setattr(sightings, "MOST_ROWS", 1 << 12)
    by_parts = written(points[::-1], tiled, tmp_path / "by_parts")
    waiting = [
        sum(path.stat().st_size for path in (tmp_path / name / "waiting").iterdir())
        for name in ("at_once", "by_parts")
    ]
    assert waiting[1] > 1.2 * waiting[0]  # the same rows more than once
    for tile in tiled.tiles:
        assert (at_once / name_of(tile)).read_bytes() == (by_parts / name_of(tile)).read_bytes()


def test_nothing_is_known_where_no_scan_was_read(tiled: TiledMap, tmp_path: Path) -> None:
    tile = tiled.tiles[0]
    found = read_tile(written([], tiled, tmp_path), tile, len(tiled.read_voxels(tile)))
    assert not found.last_us.any()
    assert not found.intensity.any()


def test_intensities_that_are_none_count_as_dark_or_bright(tiled: TiledMap, tmp_path: Path) -> None:
    values = np.array([np.nan, -1, np.nan, 1, np.inf, 7, 0.25], np.float32)
    voxels = tiled.read_voxels(tiled.tiles[0])
    seen = [Seen(voxels.keys[i // 3 : i // 3 + 1], values[i : i + 1], np.array([i])) for i in range(7)]
    found = read_tile(written(seen, tiled, tmp_path), tiled.tiles[0], len(voxels))
    assert found.intensity[:4].tolist() == [0, 255, 64, 0]
    assert found.last_us[:4].tolist() == [2, 5, 6, 0]


def test_a_damaged_file_is_refused_by_name(
    points: list[tuple[np.ndarray, np.ndarray, np.ndarray]], tiled: TiledMap, tmp_path: Path
) -> None:
    folder = written(points[:2], tiled, tmp_path)
    tile = tiled.tiles[0]
    path, voxels = folder / name_of(tile), len(tiled.read_voxels(tile))
    whole = path.read_bytes()
    with pytest.raises(DataError, match=f"damaged attributes .found {voxels} voxels, expected 5"):
        read_tile(folder, tile, 5)
    silent, refused = [], []
    for place in range(0, len(whole), 7):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 0x10]) + whole[place + 1 :])
        try:
            found = read_tile(folder, tile, voxels)
        except DataError as error:
            refused.append(str(error))
        else:
            silent.append(found)
    path.write_bytes(whole)
    right = read_tile(folder, tile, voxels)
    assert len(refused) > 10
    assert all(name_of(tile) in message for message in refused)
    for found in silent:  # a byte that tells nothing of the values
        np.testing.assert_array_equal(found.last_us, right.last_us)
        np.testing.assert_array_equal(found.intensity, right.intensity)
