"""A file is whole or not there, and a full disk is one clear line."""

import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from factor_graphs.geodesy import LocalFrame
from gnss_sem_map.errors import DataError
from gnss_sem_map.export.atomic import replacing
from gnss_sem_map.export.point_cloud import write_laz
from gnss_sem_map.labels import label_set
from gnss_sem_map.voxel_map import SemanticMap, VoxelMap, pack


@contextmanager
def room_for(size: int) -> Iterator[None]:
    """The operating system refuses to write more into any file, as a full disk does."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def half_of_a_map(path: Path) -> None:
    with replacing(path) as file:
        file.write(b"half")
        raise KeyboardInterrupt


def test_the_file_appears_only_when_the_block_has_ended(tmp_path: Path) -> None:
    path = tmp_path / "map.ply"
    with replacing(path) as file:
        file.write(b"whole")
        file.flush()
        assert not path.exists()
    assert path.read_bytes() == b"whole"
    assert list(tmp_path.iterdir()) == [path]


def test_an_interrupted_write_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "map.ply"
    path.write_bytes(b"old")
    with pytest.raises(KeyboardInterrupt):
        half_of_a_map(path)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_full_disk_is_one_line_that_names_the_file_and_leaves_nothing(tmp_path: Path) -> None:
    """Through the writer with most libraries between us and the disk."""
    indices = np.random.default_rng(0).integers(-3000, 3000, (50_000, 3))
    keys = np.unique(pack(indices))
    evidence = np.zeros((len(keys), 5), np.int32)
    voxels = VoxelMap(0.2, label_set(), keys, evidence, np.ones(len(keys), np.uint32))
    with room_for(4096), pytest.raises(DataError) as caught:
        write_laz(SemanticMap.of(voxels), LocalFrame(49.0, 8.4, 115.0), tmp_path / "map.laz")
    assert "map.laz: no room to write it" in str(caught.value)
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_a_missing_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"the folder .*nowhere does not exist"):
        half_of_a_map(tmp_path / "nowhere" / "map.ply")
