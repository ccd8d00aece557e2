"""One point per cube, beside grouping in numpy and small_gicp's own."""

from dataclasses import replace

import numpy as np
import pytest
import small_gicp

from gnss_sem_map.scans.downsampling import one_per_cube, thinned
from gnss_sem_map.sensor_log import Points


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


def sweep(n: int = 20_000) -> Points:
    """Points in runs, as beams meet surfaces, over a tenth of a second; some are too near, too far or no numbers."""
    rng = np.random.default_rng(2)
    xyz = np.cumsum(rng.normal(0, 0.3, (n, 3)) * [1, 1, 0.1], axis=0)
    xyz[::97] = np.nan
    xyz[1::89] *= 100.0
    xyz[2::101] = 0.0
    return Points(xyz.astype(np.float32), rng.random(n).astype(np.float32), 7.0 + np.linspace(-0.02, 0.08, n))


@pytest.mark.parametrize("is_timed", [True, False])
def test_a_thinned_sweep_has_the_means_of_its_usable_points(is_timed: bool) -> None:
    points, edge_m, nearest_m, farthest_m = sweep(), 0.65, 0.5, 60.0
    points = points if is_timed else replace(points, stamps=None)
    p = points.xyz.astype(float)
    stamps = np.zeros(len(p)) if points.stamps is None else points.stamps
    values = np.column_stack([p, points.intensity, stamps])
    distances = np.linalg.norm(p, axis=1)
    values = values[(distances >= nearest_m) & (distances <= farthest_m)]
    cells = np.floor(np.column_stack([values[:, :3] / edge_m, values[:, 4] / 0.05]))
    _, first, cell = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    means = np.stack([np.bincount(cell.ravel(), column) for column in values.T], axis=1)
    expected = (means / np.bincount(cell.ravel())[:, None])[np.argsort(first)]
    found = thinned(points, edge_m, nearest_m, farthest_m)
    np.testing.assert_allclose(found.xyz, expected[:, :3], rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(found.intensity, expected[:, 3], rtol=1e-6)
    if found.stamps is None:
        assert not is_timed
    else:
        np.testing.assert_allclose(found.stamps, expected[:, 4], rtol=0, atol=1e-12)


def test_a_point_without_a_stamp_is_in_no_mean() -> None:
    points = sweep()
    assert points.stamps is not None
    is_timed = np.arange(len(points.stamps)) % 7 > 0
    found = thinned(replace(points, stamps=np.where(is_timed, points.stamps, np.nan)), 0.65, 0.5, 60.0)
    np.testing.assert_array_equal(found.xyz, thinned(points[is_timed], 0.65, 0.5, 60.0).xyz)


def test_a_sweep_without_usable_points_is_empty_when_thinned() -> None:
    assert len(thinned(sweep(), 0.5, 1e4, 1e5).xyz) == 0
    assert len(thinned(sweep(0), 0.5, 1.0, 80.0).xyz) == 0


def test_where_a_sweep_begins_and_ends_its_points_are_of_two_places() -> None:
    xyz = np.array([[-5.0, 0.1, 0.1], [-5.0, 0.2, 0.1]], np.float32)
    both = Points(xyz, np.zeros(2, np.float32), np.array([0.0, 0.099]))
    np.testing.assert_array_equal(thinned(both, 0.5, 1.0, 80.0).xyz, xyz)
