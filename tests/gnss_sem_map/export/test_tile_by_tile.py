"""Files are written tile by tile: every voxel once, and in memory that does not grow with the map."""

import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from factor_graphs.geodesy import LocalFrame
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.export.exported import Exported, sure_part
from gnss_sem_map.export.formats import FORMATS
from gnss_sem_map.voxels import tiles
from gnss_sem_map.voxels.semantic_map import SemanticMap, State

WRITE = {each.name: each.write for each in FORMATS}


@pytest.mark.integration
@pytest.mark.parametrize("name", WRITE)
def test_the_tiles_on_disk_give_the_bytes_of_the_map_in_memory(
    name: str, street: SemanticMap, track: Trajectory, karlsruhe: LocalFrame, tmp_path: Path
) -> None:
    tiles.write(street, tmp_path / "refined", karlsruhe)
    opened = tiles.open_map(tmp_path / "refined")
    assert len(opened.tiles) > 1
    WRITE[name](Exported(opened, [track], "street"), tmp_path / f"from_disk.{name}")
    WRITE[name](
        Exported(tiles.in_memory(street, karlsruhe), [track], "street"), tmp_path / f"from_memory.{name}"
    )
    assert content(tmp_path / f"from_disk.{name}") == content(tmp_path / f"from_memory.{name}")


def content(path: Path) -> dict[str, bytes]:
    """The bytes of a file, or of all files of a folder."""
    files = path.iterdir() if path.is_dir() else [path]
    return {file.name if path.is_dir() else "": file.read_bytes() for file in files}


def everything(m: SemanticMap) -> SemanticMap:
    return m


def without_labels(m: SemanticMap) -> SemanticMap:
    return replace(m, labels=np.where(m.states == State.REMOVED, m.labels, -1).astype(np.int8))


def all_removed(m: SemanticMap) -> SemanticMap:
    return replace(m, states=np.full_like(m.states, State.REMOVED))


@pytest.mark.parametrize("part", [everything, without_labels, all_removed])
def test_the_extent_is_that_of_the_labelled_voxels_else_of_the_standing_ones_else_of_all(
    part: Callable[[SemanticMap], SemanticMap], street: SemanticMap
) -> None:
    whole = part(street)
    extent = Exported(tiles.in_memory(whole)).extent
    standing = whole.states != State.REMOVED
    drawable = standing if standing.any() else ~standing
    visible = whole.shown if whole.shown.any() else drawable
    np.testing.assert_array_equal(extent.drawable(whole), drawable)
    np.testing.assert_array_equal(extent.visible(whole), visible)
    indices = whole.voxels.indices[visible]
    assert extent.count == len(indices)
    np.testing.assert_array_equal([extent.low, extent.high], [indices.min(axis=0), indices.max(axis=0)])
    np.testing.assert_allclose(extent.mean, indices.mean(axis=0))
    labels = [(whole.labels[drawable] == label).sum() for label in (0, 1, 2, 3, 4, 5, -1)]
    np.testing.assert_array_equal(extent.labels, labels)
    assert extent.inferred == whole.inferred.sum()


@pytest.mark.parametrize("least", [0.0, 0.7, 1.0])
def test_a_label_that_is_less_sure_is_none_and_all_else_stays(least: float, street: SemanticMap) -> None:
    kept = sure_part(tiles.in_memory(street), least).whole()
    sure = street.confidence >= np.float32(least)
    np.testing.assert_array_equal(kept.labels, np.where(sure, street.labels, -1))
    np.testing.assert_array_equal(kept.confidence, np.where(sure, street.confidence, 0))
    np.testing.assert_array_equal(kept.voxels.hits, street.voxels.hits)
    differ = kept.states != street.states  # what no camera saw, and is not inferred any more
    np.testing.assert_array_equal(differ, ~sure & (street.states == State.INFERRED))
    assert (kept.states[differ] == State.UNOBSERVED).all()


PEAK_OF_EACH_FILE = """
import resource, sys
from pathlib import Path
import numpy as np
from factor_graphs.geodesy import LocalFrame
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.export import formats
from gnss_sem_map.export.exported import Exported
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.voxels.semantic_map import SemanticMap
from gnss_sem_map.voxels.tiles import TiledMap
from gnss_sem_map.voxels.voxel_map import VoxelMap, pack

label_set, side, name = open_label_set(), int(sys.argv[1]), sys.argv[2]
columns = np.stack(np.meshgrid(np.arange(512), np.arange(512), indexing="ij"), axis=-1).reshape(-1, 2)
keys, n = pack(np.column_stack([columns, columns.sum(axis=1) % 7])), len(columns)
labels = np.random.default_rng(0).integers(-1, 5, n).astype(np.int8)


def read_tile(tile):
    corner = pack(np.array([[512 * tile[0], 512 * tile[1], 0]])) - pack(np.zeros((1, 3), int))
    voxels = VoxelMap(0.2, label_set, keys + corner, np.zeros((n, 5), np.int32), np.ones(n, np.uint32))
    return SemanticMap(voxels, labels, np.ones(n, np.float32), np.ones(n, np.uint8))


tiles = tuple((x, y) for x in range(side) for y in range(side))
T = np.tile(np.eye(4), (20, 1, 1))
T[:, :3, 3] = np.linspace((20, 50, 2), (102.4 * side - 20, 50, 2), 20)
driven = Trajectory(np.arange(20.0), T)
frame = LocalFrame(49.0, 8.4, 115.0)
tiled = TiledMap(0.2, label_set, frame, tiles, read_tile, lambda tile: read_tile(tile).voxels)
exported = Exported(tiled, [driven], "tiles")
write = {each.name: each.write for each in formats.FORMATS}[name]
write(exported, Path(sys.argv[3]))
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""


def peak_kb(side: int, name: str, path: Path) -> int:
    """Peak memory of a process that writes side x side full tiles in one format."""
    command = [sys.executable, "-c", PEAK_OF_EACH_FILE, str(side), name, str(path)]
    return int(subprocess.run(command, capture_output=True, text=True, check=True).stdout)


@pytest.mark.integration
@pytest.mark.slow
@pytest.mark.parametrize("name", ["laz", "removed", "ply", "geotiff", "topview", "perspective", "nav2"])
def test_sixteen_times_the_map_takes_no_more_memory(name: str, tmp_path: Path) -> None:
    assert peak_kb(8, name, tmp_path / "large") < 1.2 * peak_kb(2, name, tmp_path / "small")
