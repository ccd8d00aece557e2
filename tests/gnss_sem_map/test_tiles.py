"""What is read back is what was written, by us and by a plain Parquet reader."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from factor_graphs.geodesy import LocalFrame
from gnss_sem_map import tiles
from gnss_sem_map.errors import DataError
from gnss_sem_map.labels import label_set
from gnss_sem_map.voxel_map import SemanticMap, VoxelMap, pack

URBAN, FRAME = label_set(), LocalFrame(49.0, 8.4, 110.0)


def random_map(seed: int = 0, count: int = 5000, height: int = 100) -> SemanticMap:
    rng = np.random.default_rng(seed)
    keys = np.unique(pack(rng.integers((-1500, -1500, -height), (1500, 1500, height), (count, 3))))
    evidence = -rng.integers(0, 10**6, (len(keys), 5)).astype(np.int32)
    evidence[rng.random(len(keys)) < 0.5] = 0
    hits = rng.integers(1, 1000, len(keys)).astype(np.uint32)
    return SemanticMap.of(VoxelMap(0.2, URBAN, keys, evidence, hits))


def test_a_map_comes_back_as_it_was(tmp_path: Path) -> None:
    written = random_map()
    tiles.write(written, tmp_path / "map", FRAME)
    read = tiles.read(tmp_path / "map", URBAN)
    for name in ("keys", "evidence", "hits"):
        np.testing.assert_array_equal(getattr(read.voxels, name), getattr(written.voxels, name))
    for name in ("labels", "confidence", "states"):
        np.testing.assert_array_equal(getattr(read, name), getattr(written, name))
    about = json.loads((tmp_path / "map/map.json").read_text())
    assert about["voxels"] == len(written)
    assert about["utm_epsg"] == 32632


def test_the_same_map_gives_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        tiles.write(random_map(), tmp_path / name, FRAME)
    for path in sorted((tmp_path / "a").iterdir()):
        assert path.read_bytes() == (tmp_path / "b" / path.name).read_bytes(), path.name


def test_a_plain_reader_finds_every_voxel_where_the_name_of_its_tile_says(tmp_path: Path) -> None:
    written = random_map()
    tiles.write(written, tmp_path / "map", None)
    found = []
    for path in (tmp_path / "map").glob("*.parquet"):
        x, y = (int(part) for part in path.stem.split("_"))
        key = pq.read_table(path)["key"].to_numpy().astype(np.int64)
        found.append(
            np.stack([x * 512 + (key >> 23), y * 512 + (key >> 14 & 511), (key & 16383) - 8192], axis=1)
        )
    indices = np.concatenate(found)
    np.testing.assert_array_equal(indices[np.lexsort(indices.T[::-1])], written.voxels.indices)


def test_a_map_without_voxels_is_still_a_map(tmp_path: Path) -> None:
    empty = random_map()
    none = SemanticMap.of(empty.voxels[np.zeros(len(empty), bool)])
    tiles.write(none, tmp_path / "map", FRAME)
    assert len(tiles.read(tmp_path / "map", URBAN)) == 0


def test_a_damaged_or_missing_tile_is_named(tmp_path: Path) -> None:
    tiles.write(random_map(), tmp_path / "map", FRAME)
    path = sorted((tmp_path / "map").glob("*.parquet"))[3]
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(DataError, match=path.name):
        tiles.read(tmp_path / "map", URBAN)
    path.unlink()
    with pytest.raises(DataError, match="tiles, expected"):
        tiles.read(tmp_path / "map", URBAN)
    with pytest.raises(DataError, match="no map here"):
        tiles.read(tmp_path / "elsewhere", URBAN)


def test_a_voxel_too_high_for_a_tile_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="do not fit a tile"):
        tiles.write(random_map(height=20_000), tmp_path / "map", FRAME)
