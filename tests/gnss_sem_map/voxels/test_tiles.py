"""What is read back is what was written, by us and by a plain Parquet reader."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from factor_graphs.geodesy import LocalFrame
from gnss_sem_map.errors import DataError
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.voxels import tile_files, tiles
from gnss_sem_map.voxels.map_json import read_frame
from gnss_sem_map.voxels.semantic_map import Reason, SemanticMap, State
from gnss_sem_map.voxels.voxel_map import VoxelMap, pack

URBAN, FRAME = open_label_set(), LocalFrame(49.0, 8.4, 110.0)


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


def test_hits_of_what_moved_come_back_from_every_tile(tmp_path: Path) -> None:
    written = random_map()
    gone = written.voxels.hits // 2
    tiles.write(replace(written, hits_removed=gone), tmp_path / "map", FRAME)
    np.testing.assert_array_equal(tiles.read(tmp_path / "map", URBAN).hits_removed, gone)
    low, high = written.voxels.centres.min(axis=0), written.voxels.centres.max(axis=0)
    inside = tiles.read(tmp_path / "map", URBAN, (low, (low + high) / 2))
    np.testing.assert_array_equal(inside.hits_removed, inside.voxels.hits // 2)


def test_hits_that_moved_are_not_written_where_they_are_those_of_the_removed_voxels(tmp_path: Path) -> None:
    written = random_map()
    states = np.where(np.arange(len(written)) % 7 == 0, np.uint8(State.REMOVED), written.states)
    written = replace(written, states=states)
    tiles.write(replace(written, hits_removed=written.hits_of_removed), tmp_path / "map", FRAME)
    read = tiles.read(tmp_path / "map", URBAN)
    assert read.hits_removed is None
    assert read.removed_hits.sum() > 0
    np.testing.assert_array_equal(read.removed_hits, written.hits_of_removed)


def test_reasons_come_back_and_cost_little(tmp_path: Path) -> None:
    written = random_map()
    reasons = np.where(np.arange(len(written)) % 50 < 2, np.uint8(Reason.CRUMB), np.uint8(Reason.NONE))
    told = replace(written, reasons=reasons)
    tiles.write(told, tmp_path / "map", FRAME)
    np.testing.assert_array_equal(tiles.read(tmp_path / "map", URBAN).reasons, reasons)
    assert json.loads((tmp_path / "map/map.json").read_text())["reasons"]["crumb"] == Reason.CRUMB
    assert len(tile_files.encode(told)) - len(tile_files.encode(written)) < 0.2 * len(written)


def test_a_reason_that_is_none_is_damage(tmp_path: Path) -> None:
    written = random_map()
    tiles.write(replace(written, reasons=np.full(len(written), 9, np.uint8)), tmp_path / "map", FRAME)
    with pytest.raises(DataError, match="reasons"):
        tiles.read(tmp_path / "map", URBAN)


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


def test_a_box_gives_the_voxels_inside_and_opens_only_its_tiles(tmp_path: Path) -> None:
    written = random_map(count=20_000)
    tiles.write(written, tmp_path / "map", FRAME)
    low, high = np.array([-40.0, 10.0, -5.0]), np.array([80.0, 120.0, 15.0])
    centres = written.voxels.centres
    inside = ((centres >= low) & (centres <= high)).all(axis=1)
    for path in (tmp_path / "map").glob("*.parquet"):
        if path.name not in ("-1_0.parquet", "0_0.parquet", "-1_1.parquet", "0_1.parquet"):
            path.write_bytes(b"must not be opened")
    read = tiles.read(tmp_path / "map", box=(low, high))
    assert 0 < len(read) < len(written)
    np.testing.assert_array_equal(read.voxels.keys, written.voxels.keys[inside])
    np.testing.assert_array_equal(read.labels, written.labels[inside])
    with pytest.raises(DataError, match="checksum"):
        tiles.read(tmp_path / "map")


@pytest.mark.parametrize("margin_m", [0.0, 3.3, 150.0])
def test_around_a_tile_are_its_voxels_and_those_of_a_margin_on_disk_and_in_memory(
    tmp_path: Path, margin_m: float
) -> None:
    written = random_map(count=20_000)
    tiles.write(written, tmp_path / "map", FRAME)
    margin = np.ceil(margin_m / written.voxels.voxel_size_m)
    for opened in (tiles.open_map(tmp_path / "map", URBAN), tiles.in_memory(written, FRAME)):
        np.testing.assert_array_equal(opened.whole().voxels.keys, written.voxels.keys)
        for tile in opened.tiles:
            low = np.array(tile) * 512 - margin
            xy = written.voxels.indices[:, :2]
            inside = ((xy >= low) & (xy < low + 512 + 2 * margin)).all(axis=1)
            around = opened.around((tile,), margin_m)
            for name in ("keys", "evidence", "hits"):
                expected = getattr(written.voxels, name)[inside]
                np.testing.assert_array_equal(getattr(around, name), expected)


@pytest.mark.parametrize(("held", "reads"), [(10**6, 1), (0, 9)])
def test_a_small_map_is_read_once_however_many_tiles_ask_for_their_surroundings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, held: int, reads: int
) -> None:
    written, names = random_map(count=20_000), Counter[str]()
    tiles.write(written, tmp_path / "map", FRAME)
    original = tile_files.read_voxels

    def counted(path: Path, *others: Any) -> VoxelMap:
        names[path.name] += 1
        return original(path, *others)

    monkeypatch.setattr(tile_files, "read_voxels", counted)
    opened = tiles.open_map(tmp_path / "map", URBAN, voxels_held=held)
    for tile in opened.tiles:
        opened.around((tile,), 1.0)
    assert len(names) == len(opened.tiles)
    assert max(names.values()) == reads


def test_a_map_read_without_sums_is_decided_as_with_them_and_cannot_be_written(tmp_path: Path) -> None:
    tiles.write(random_map(count=20_000), tmp_path / "map", FRAME)
    opened = tiles.open_map(tmp_path / "map", with_sums=False)
    for decided, piece in zip(opened, tiles.open_map(tmp_path / "map"), strict=True):
        assert decided.voxels.evidence.shape == (len(piece), 0)
        for name in ("labels", "confidence", "states", "removed_hits", "told_reasons"):
            np.testing.assert_array_equal(getattr(decided, name), getattr(piece, name))
        for name in ("keys", "hits"):
            np.testing.assert_array_equal(getattr(decided.voxels, name), getattr(piece.voxels, name))
        with pytest.raises(ValueError, match="zip"):
            tile_files.encode(decided)
        for asked in ("observed", "labels", "probabilities"):
            with pytest.raises(DataError, match="read without its sums"):
                getattr(decided.voxels, asked)


def test_one_changed_byte_in_a_tile_is_noticed_and_named(tmp_path: Path) -> None:
    tiles.write(random_map(), tmp_path / "map", FRAME)
    path = sorted((tmp_path / "map").glob("*.parquet"))[2]
    content = bytearray(path.read_bytes())
    content[len(content) // 3] ^= 1
    path.write_bytes(content)
    with pytest.raises(DataError, match=f"{path.name}: damaged tile .its checksum"):
        tiles.read(tmp_path / "map", URBAN)


def test_a_tile_name_cannot_lead_out_of_the_folder(tmp_path: Path) -> None:
    tiles.write(random_map(), tmp_path / "map", FRAME)
    about = json.loads((tmp_path / "map/map.json").read_text())
    name, file = about["files"].popitem()
    about["files"][f"../{name}"] = file
    (tmp_path / "map/map.json").write_text(json.dumps(about))
    with pytest.raises(DataError, match="expected a name like"):
        tiles.read(tmp_path / "map", URBAN)


def test_a_map_of_another_class_set_or_in_the_way_is_refused(tmp_path: Path) -> None:
    tiles.write(random_map(), tmp_path / "map", FRAME)
    with pytest.raises(DataError, match="found classes"):
        tiles.read(tmp_path / "map", replace(URBAN, names=(*URBAN.names[:4], "water"), sources={}))
    with pytest.raises(DataError, match="exists"):
        tiles.write(random_map(), tmp_path / "map", FRAME)
    assert len(tiles.read(tmp_path / "map")) == len(random_map())
    assert read_frame(tmp_path / "map") == FRAME


def test_a_map_of_a_user_s_class_set_is_opened_without_its_file(tmp_path: Path) -> None:
    mine = replace(URBAN, name="mine", colours=URBAN.colours[::-1].copy())
    known = random_map()
    tiles.write(replace(known, voxels=replace(known.voxels, label_set=mine)), tmp_path / "map", FRAME)
    assert tiles.open_map(tmp_path / "map").label_set.about() == mine.about()


def test_the_pieces_by_tile_are_the_map(tmp_path: Path) -> None:
    voxels = random_map().voxels
    pieces = dict(tiles.by_tile(voxels))
    assert list(pieces) == sorted(pieces)
    for tile, piece in pieces.items():
        np.testing.assert_array_equal(piece.indices[:, :2] >> 9, np.tile(tile, (len(piece), 1)))
    keys = np.concatenate([piece.keys for piece in pieces.values()])
    np.testing.assert_array_equal(np.sort(keys), voxels.keys)


def test_morton_codes_interleave_the_bits_of_indices() -> None:
    indices = np.random.default_rng(0).integers(0, 1 << 21, (50, 3))
    indices[0] = (1 << 21) - 1
    bits = [[value >> bit & 1 for bit in range(21)] for value in indices.T]
    expected = sum(bits[axis][bit] << 3 * bit + axis for bit in range(21) for axis in range(3))
    np.testing.assert_array_equal(tile_files.morton_codes(*indices.T), expected)
