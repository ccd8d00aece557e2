"""What a run keeps beside its map comes back as it was, however long the drive; what cannot be used is refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import DENSE

from gnss_sem_map.dynamics.range_images import WIDTH
from gnss_sem_map.dynamics.visibility import KeyframeScans
from gnss_sem_map.errors import DataError
from gnss_sem_map.mapping import evidence

IMAGE_SHAPE = (DENSE.count + 1, WIDTH)


def keyframes(count: int) -> KeyframeScans:
    images = np.random.default_rng(0).integers(0, 1 << 16, (count, *IMAGE_SHAPE), np.uint16)
    return KeyframeScans(images, np.tile(np.eye(4), (count, 1, 1)), DENSE)


def test_keyframes_come_back(tmp_path: Path) -> None:
    written = keyframes(3)
    evidence.write_keyframes(written, tmp_path / "k.npz")
    read = evidence.read_keyframes(tmp_path / "k.npz")
    np.testing.assert_array_equal(read.images, written.images)
    np.testing.assert_array_equal(read.T_lidar_map, written.T_lidar_map)
    np.testing.assert_array_equal(read.rows.seen, written.rows.seen)


@pytest.mark.slow
def test_those_of_more_than_a_gibibyte_too(tmp_path: Path) -> None:
    """10 km of drive."""
    count = (1 << 30) // (2 * int(np.prod(IMAGE_SHAPE))) + 1
    images = np.zeros((count, *IMAGE_SHAPE), np.uint16)
    evidence.write_keyframes(
        KeyframeScans(images, np.tile(np.eye(4), (count, 1, 1)), DENSE), tmp_path / "k.npz"
    )
    assert len(evidence.read_keyframes(tmp_path / "k.npz").images) == count


def test_some_of_them_come_back_in_any_order(tmp_path: Path) -> None:
    written = keyframes(5)
    evidence.write_keyframes(written, tmp_path / "k.npz")
    some = evidence.read_packed(tmp_path / "k.npz").scans(np.array([4, 0, 2]))
    np.testing.assert_array_equal(some.images, written.images[[4, 0, 2]])


@pytest.mark.parametrize("shape", [(3, 68, 900), (2, *IMAGE_SHAPE), (3, IMAGE_SHAPE[0], IMAGE_SHAPE[1] + 1)])
def test_images_of_another_shape_are_refused(shape: tuple[int, ...], tmp_path: Path) -> None:
    """They would be read beyond their end."""
    T = np.tile(np.eye(4), (3, 1, 1))
    evidence.write_keyframes(KeyframeScans(np.zeros(shape, np.uint16), T, DENSE), tmp_path / "k.npz")
    with pytest.raises(DataError, match=r"expected|damaged"):
        evidence.read_keyframes(tmp_path / "k.npz")


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("packed", lambda packed: packed[:-1]),
        ("packed", lambda packed: np.zeros_like(packed)),
        ("ends", lambda ends: ends[::-1]),
        ("ends", lambda ends: ends[:0]),
        ("ends", lambda ends: ends - ends[0]),
        ("T_lidar_map", lambda T: T * np.nan),
    ],
)
def test_damaged_keyframes_are_refused(
    name: str, change: Callable[[NDArray[Any]], NDArray[Any]], tmp_path: Path
) -> None:
    path = tmp_path / "k.npz"
    evidence.write_keyframes(keyframes(3), path)
    with np.load(path) as arrays:
        content = dict(arrays)
    np.savez(path, **content | {name: change(content[name])})
    with pytest.raises(DataError, match=r"k\.npz.*make the run again"):
        evidence.read_keyframes(path)


def test_keyframes_of_an_earlier_version_are_refused(tmp_path: Path) -> None:
    written = keyframes(3)
    np.savez(tmp_path / "k.npz", images=written.images, T_lidar_map=written.T_lidar_map, seen=DENSE.seen)
    with pytest.raises(DataError, match=r"no packed in it; found .*images"):
        evidence.read_keyframes(tmp_path / "k.npz")


@pytest.mark.parametrize(
    ("counts", "places"), [([2], [1, -1]), ([3], [1, 2]), ([-1, 3], [1, 2]), ([2, 2], [1, 2])]
)
def test_moving_points_that_no_scan_can_have_are_refused(
    counts: list[int], places: list[int], tmp_path: Path
) -> None:
    path = tmp_path / "m.npz"
    np.savez(path, frames=np.arange(len(counts)), counts=np.array(counts), places=np.array(places))
    with pytest.raises(DataError, match="do not fit"):
        evidence.read_moving_points(path)
