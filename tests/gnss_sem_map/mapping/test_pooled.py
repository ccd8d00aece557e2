"""What several cameras show of one point is one observation."""

from __future__ import annotations

import numpy as np

from gnss_sem_map.mapping.labelled_scans import Look, pooled


def look(points: list[int], classes: list[list[int]]) -> Look:
    return np.array(points, np.int32), np.array(classes, np.uint8).reshape(-1, 3)


def test_one_camera_says_what_it_says() -> None:
    rows, classes = pooled([look([1, 4], [[10, 20, 30], [0, 0, 0]])], 6, 3)
    assert rows.tolist() == [-1, 0, -1, -1, 1, -1]
    assert classes.tolist() == [[10, 20, 30], [0, 0, 0]]


def test_no_camera_says_nothing() -> None:
    rows, classes = pooled([], 3, 3)
    assert rows.tolist() == [-1, -1, -1]
    assert classes.shape == (0, 3)


def test_two_cameras_say_their_mean_and_void_pixels_nothing() -> None:
    one = look([0, 1, 3], [[255, 0, 0], [100, 155, 0], [0, 0, 0]])
    other = look([1, 2, 3], [[101, 154, 0], [7, 8, 9], [1, 2, 3]])
    rows, classes = pooled([one, other], 5, 3)
    assert rows.tolist() == [0, 1, 2, 3, -1]
    assert classes.tolist() == [[255, 0, 0], [101, 155, 0], [7, 8, 9], [1, 2, 3]]


def test_the_order_of_cameras_does_not_matter_and_the_same_said_twice_is_said_once() -> None:
    rng = np.random.default_rng(0)
    looks = [
        (np.sort(rng.choice(50, 30, replace=False)).astype(np.int32), rng.integers(0, 255, (30, 6), np.uint8))
        for _ in range(4)
    ]
    rows, classes = pooled(looks, 50, 6)
    again, same = pooled(looks[::-1], 50, 6)
    np.testing.assert_array_equal(rows, again)
    np.testing.assert_array_equal(classes, same)
    twice, once = pooled([looks[0], looks[0]], 50, 6), pooled(looks[:1], 50, 6)
    np.testing.assert_array_equal(twice[0], once[0])
    np.testing.assert_array_equal(twice[1], once[1])
