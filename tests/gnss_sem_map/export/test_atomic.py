"""A file is whole or not there."""

from pathlib import Path

import pytest

from gnss_sem_map.errors import DataError
from gnss_sem_map.files.atomic import replacing


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


def test_a_missing_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"the folder .*nowhere does not exist"):
        half_of_a_map(tmp_path / "nowhere" / "map.ply")
