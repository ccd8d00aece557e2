"""One point per cube, beside grouping in numpy and small_gicp's own."""

import numpy as np
import small_gicp

from gnss_sem_map.scans.downsampling import one_per_cube


def test_every_cube_that_holds_points_has_their_mean():
    points, edge_m = np.random.default_rng(0).normal(size=(5000, 3)) * [9, 9, 2], 0.5
    cubes, cube = np.unique(np.floor(points / edge_m), axis=0, return_inverse=True)
    expected = np.stack([np.bincount(cube.ravel(), points[:, axis]) for axis in range(3)], axis=1)
    expected /= np.bincount(cube.ravel())[:, None]
    found = one_per_cube(points, edge_m)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(np.floor(found / edge_m), cubes)


def test_the_points_are_those_of_small_gicp():
    points = np.random.default_rng(1).normal(size=(5000, 3)) * [9, 9, 2]
    theirs = np.asarray(small_gicp.voxelgrid_sampling(points, 0.5).points())[:, :3]
    ours = one_per_cube(points, 0.5)
    assert len(ours) == len(theirs)
    np.testing.assert_allclose(ours[np.lexsort(ours.T)], theirs[np.lexsort(theirs.T)], rtol=0, atol=1e-9)


def test_no_points_are_no_cubes():
    assert one_per_cube(np.empty((0, 3)), 0.5).shape == (0, 3)
