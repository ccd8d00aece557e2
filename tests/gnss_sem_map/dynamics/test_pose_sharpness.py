"""Sharp poses: what many scans hit, no scan sees through."""

import numpy as np
import pytest

from gnss_sem_map.dynamics.pose_sharpness import are_sharp as told_of


def are_sharp(counts):
    """Of hits and misses (2, v) of each scan: those of different scans are different voxels, or half as many twice."""
    together = np.concatenate(counts, axis=1)
    once = told_of(together, np.ones(together.shape[1], np.intp), len(counts))
    if len(counts) % 2 == 0 and (counts[0] == counts[1]).all():
        half = np.concatenate(counts[::2], axis=1)
        assert told_of(half, np.full(half.shape[1], 2), len(counts)) is once
    return once


def wall(position_stddev_m, scans=60, voxels=4000, seed=0, thickness_m=0.4):
    """Hits and misses of a wall across the view, by scans whose range errs by their position.

    A scan misses a voxel whose surface seems to lie nearer than it does, by more than the tolerance.
    """
    rng = np.random.default_rng(seed)
    off = rng.normal(0, position_stddev_m, (scans, 1)) + rng.normal(0, 0.02, (scans, voxels))
    misses = (off > thickness_m).sum(axis=0)
    return [np.array([scans - misses, misses], np.int32)] * scans


@pytest.mark.parametrize(("stddev_m", "sharp"), [(0.01, True), (0.05, True), (0.4, False), (1.0, False)])
def test_poses_that_err_by_the_thickness_of_a_wall_are_not_sharp(stddev_m, sharp):
    assert are_sharp(wall(stddev_m)) is sharp


def test_movers_and_leaves_do_not_make_sharp_poses_seem_blurred():
    (counts, *_) = wall(0.02)
    of_movers = np.array([np.full(300, 25), np.full(300, 200)], np.int32)
    assert are_sharp([np.concatenate([counts, of_movers], axis=1)] * 60)


def test_a_short_drive_tells_by_half_of_its_scans():
    assert are_sharp(wall(0.02, scans=6))
    assert not are_sharp(wall(1.0, scans=6))


def test_a_drive_in_which_nothing_is_hit_twice_has_no_sharp_poses():
    assert not are_sharp([np.zeros((2, 10), np.int32)] * 3)
    assert not are_sharp([np.zeros((2, 0), np.int32)])
