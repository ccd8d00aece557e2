"""Sharp poses: what many scans hit, no scan sees through."""

import numpy as np
import pytest

from gnss_sem_map.dynamics.pose_sharpness import are_sharp, stand_still


def told_by(counts):
    """Whether hits and misses (2, v) of each scan tell sharp poses; the voxels of each scan are others."""
    together = np.concatenate(counts, axis=1)
    ends = np.cumsum([one.shape[1] for one in counts])
    return are_sharp(together, np.split(np.arange(together.shape[1], dtype=np.int32), ends[:-1]))


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
    assert told_by(wall(stddev_m)) is sharp


def test_movers_and_leaves_do_not_make_sharp_poses_seem_blurred():
    (counts, *_) = wall(0.02)
    of_movers = np.array([np.full(300, 25), np.full(300, 200)], np.int32)
    assert told_by([np.concatenate([counts, of_movers], axis=1)] * 60)


def test_a_short_drive_tells_by_half_of_its_scans():
    assert told_by(wall(0.02, scans=6))
    assert not told_by(wall(1.0, scans=6))


def test_a_drive_in_which_nothing_is_hit_twice_has_no_sharp_poses():
    assert not told_by([np.zeros((2, 10), np.int32)] * 3)
    assert not told_by([np.zeros((2, 0), np.int32)])


def test_a_voxel_counts_as_often_as_scans_have_it():
    """A voxel in sixty that is blurred decides if all scans have it."""
    sharp, blurred = np.array([[60], [0]], np.int32), np.array([[30], [30]], np.int32)
    counts = np.concatenate([np.repeat(sharp, 60, axis=1), blurred], axis=1)
    of_each = [np.array([place], np.int32) for place in range(60)]
    assert are_sharp(counts, [*of_each[:-1], np.array([59, 60], np.int32)])
    assert not are_sharp(counts, [np.append(place, np.int32(60)) for place in of_each])


def test_segments_that_stand_tell_sharp_poses_in_a_queue_of_traffic():
    stands, moves = np.array([[400.0], [0.5]]), np.array([[300.0], [200.0]])
    assert stand_still(np.repeat(np.hstack([stands, moves]), [70, 30], axis=1))
    assert not stand_still(np.repeat(np.hstack([stands, moves]), [50, 50], axis=1))
    assert not stand_still(np.repeat([[400.0], [4.0]], 50, axis=1))  # blurred: all are seen through a little
    assert not stand_still(np.zeros((2, 5)))
