"""The memo: what was made from the same comes back bit for bit; what is damaged, or of something else, is not there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from damage import flipped, halved

from factor_graphs.trajectory import Trajectory
from gnss_sem_map.errors import DataError
from gnss_sem_map.files.memo import arrays_of, recall, remember

TRACK = Trajectory(np.array([0.0, 0.1]), np.tile(np.eye(4), (2, 1, 1)), np.full((2, 3), 1 / 3))
ABOUT = {"counts": {"scans": 3}, "third": 1 / 3, "none": None}


def written(folder: Path) -> Path:
    remember(folder / "deep/1.npz", "inputs", ABOUT, arrays_of("track", TRACK))
    return folder / "deep/1.npz"


def test_what_was_made_from_the_same_comes_back(tmp_path: Path) -> None:
    path = written(tmp_path)
    for made_from in ("inputs", None):
        found = recall(path, made_from)
        assert found is not None
        assert found.about == ABOUT
        again = Trajectory(**found.of("track"))
        np.testing.assert_array_equal(again.T_map_imu, TRACK.T_map_imu)
        np.testing.assert_array_equal(again.velocities, TRACK.velocities)
        assert again.covariances is None
        assert found.of("other") == {}
    assert recall(path, "other inputs") is None
    assert recall(tmp_path / "none.npz", None) is None
    assert [one.name for one in path.parent.iterdir()] == ["1.npz"]


@pytest.mark.parametrize("damage", [halved, flipped, lambda path: path.write_bytes(b""), Path.unlink])
def test_what_is_damaged_is_not_there(damage, tmp_path: Path) -> None:
    path = written(tmp_path)
    damage(path)
    assert recall(path, "inputs") is None


def test_a_place_that_cannot_be_written_is_an_error_that_says_where(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(DataError, match=r"file: cannot be written .*; free the disk, then run it again$"):
        remember(tmp_path / "file/1.npz", "inputs", {}, {})
