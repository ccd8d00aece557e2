"""Levels of the viewer: a map above the budget has coarse voxels in its page, and finer ones in a folder beside it."""

import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from viewer_pages import decoded, unpacked, written

from factor_graphs.trajectory import Trajectory
from gnss_sem_map.errors import DataError
from gnss_sem_map.export.viewer import write_viewer
from gnss_sem_map.voxels import tiles
from gnss_sem_map.voxels.semantic_map import SemanticMap
from gnss_sem_map.voxels.tiles import in_memory


def levels(tmp_path: Path) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Indices (v, 3) in voxels of the level and label, confidence, state (v, 3) of the page and its folder."""
    page = (tmp_path / "viewer.html").read_text("utf-8")
    meta, indices, about = decoded(page)
    found: dict[int, list[tuple[np.ndarray, np.ndarray]]] = {meta["level"]: [(indices, about)]}
    files = {file.name for file in (tmp_path / "viewer").iterdir()}
    for listed in meta["nodes"]:
        level, x, y = listed[:3]
        if level != meta["level"]:
            name = f"{level}_{x}_{y}"
            files.remove(f"{name}.js")
            script = (tmp_path / "viewer" / f"{name}.js").read_text("ascii")
            text = script.removeprefix(f'voxels("{name}","').removesuffix('");\n')
            found.setdefault(level, []).append(unpacked(listed, text, meta))
    assert not files
    return {
        level: (np.concatenate([i for i, _ in nodes]), np.concatenate([a for _, a in nodes]))
        for level, nodes in found.items()
    }


@pytest.mark.slow
def test_a_map_above_the_budget_has_levels_of_which_each_shows_the_most_hit_of_the_voxels_it_joins(
    town: SemanticMap, tmp_path: Path
) -> None:
    """Against a dictionary; a labelled voxel that stands goes before the others."""
    written(tmp_path, town, None, most_voxels=20_000)
    found = levels(tmp_path)
    assert len(found) > 2
    labels = np.where(town.labels < 0, 6, town.labels).tolist()
    ranks = list(zip(town.shown.tolist(), town.voxels.hits.tolist(), strict=True))
    for level, (indices, about) in found.items():
        best: dict[tuple[int, ...], tuple[tuple[bool, int], set[tuple[int, int]]]] = {}
        joined = map(tuple, (town.voxels.indices >> level).tolist())
        for index, rank, label, state in zip(joined, ranks, labels, town.states.tolist(), strict=True):
            highest, those = best.get(index, (rank, set()))
            if rank >= highest:
                best[index] = rank, {(label, state)} | (those if rank == highest else set())
        shown = {
            tuple(i): (label, state)
            for i, (label, _, state) in zip(indices.tolist(), about.tolist(), strict=True)
        }
        assert len(shown) == len(indices)
        assert shown.keys() == best.keys()
        assert all(shown[index] in those for index, (_, those) in best.items())
    assert len(found[max(found)][0]) <= 20_000 < len(found[max(found) - 1][0])


def test_a_map_in_tiles_on_disk_gives_the_same_bytes_and_each_tile_is_read_once(
    town: SemanticMap, track: Trajectory, tmp_path: Path
) -> None:
    tiles.write(town, tmp_path / "map", None)
    opened, read = tiles.open_map(tmp_path / "map"), list[tiles.Tile]()

    def read_tile(tile: tiles.Tile) -> SemanticMap:
        read.append(tile)
        return opened.read_tile(tile)

    for name, tiled_map in (("disk", replace(opened, read_tile=read_tile)), ("memory", in_memory(town))):
        (tmp_path / name).mkdir()
        write_viewer(tiled_map, [track], tmp_path / name / "viewer.html", most_voxels=20_000)
    assert sorted(read) == list(opened.tiles)
    disk, memory = (
        {file.relative_to(tmp_path / name): file.read_bytes() for file in (tmp_path / name).rglob("*.*")}
        for name in ("disk", "memory")
    )
    assert disk == memory
    assert len(disk) > 10


def test_the_files_of_an_earlier_page_are_not_replaced(town: SemanticMap, tmp_path: Path) -> None:
    written(tmp_path, town, None, most_voxels=20_000)
    with pytest.raises(DataError, match=r"viewer: exists; move it away"):
        written(tmp_path, town, None, most_voxels=20_000)


def peak_memory(edge: int, piece: SemanticMap, page: Path) -> int:
    """Bytes that writing a map of edge x edge such tiles takes at most."""
    corners = tuple((x, y) for x in range(edge) for y in range(edge))
    tiled_map = replace(in_memory(piece), tiles=corners, read_tile=lambda _: piece[np.arange(len(piece))])
    tracemalloc.start()
    write_viewer(tiled_map, (), page, most_voxels=20_000)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak


def test_memory_does_not_grow_with_the_map(street: SemanticMap, tmp_path: Path) -> None:
    small, large = (peak_memory(edge, street, tmp_path / f"{edge}.html") for edge in (3, 9))
    assert large < 1.2 * small
