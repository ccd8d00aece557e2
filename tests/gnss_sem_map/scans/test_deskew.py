"""A point lies where the sensor was at its own stamp, whatever else its sweep holds."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from factor_graphs.errors import MeasurementError
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.scans.deskew import points_in_map, usable_points_at_stamp, usable_points_in_map
from gnss_sem_map.scans.downsampling import thinned
from gnss_sem_map.sensor_log import Points

T_IMU_LIDAR = np.eye(4)
T_IMU_LIDAR[:3, 3] = 0.8, -0.3, 0.9


def turning(rate: float = 1.0, speed: float = 15.0) -> Trajectory:
    """A circle driven at a steady rate, rad/s, and speed, m/s, for a second."""
    stamps = np.arange(0.0, 1.001, 0.01)
    T = np.tile(np.eye(4), (len(stamps), 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(np.outer(rate * stamps, [0, 0, 1])).as_matrix()
    T[:, 0, 3] = speed / rate * np.sin(rate * stamps)
    T[:, 1, 3] = speed / rate * (1 - np.cos(rate * stamps))
    velocities = speed * T[:, :3, 0]
    return Trajectory(stamps, T, velocities)


def sweep(n: int = 5000, seed: int = 0) -> Points:
    rng = np.random.default_rng(seed)
    xyz = rng.uniform(-60, 60, (n, 3)).astype(np.float32)
    return Points(xyz, np.zeros(n, np.float32), np.sort(rng.uniform(0.4, 0.5, n)))


def test_every_point_moves_with_the_pose_of_its_own_stamp() -> None:
    """Turning at 1 rad/s, the poses that are computed are dense enough for half a millimetre."""
    points, trajectory = sweep(), turning()
    assert points.stamps is not None
    T = trajectory.at(points.stamps) @ T_IMU_LIDAR
    exact = np.einsum("nij,nj->ni", T[:, :3, :3], points.xyz.astype(np.float64)) + T[:, :3, 3]
    moved = points_in_map(points, 0.45, trajectory, T_IMU_LIDAR)
    assert np.abs(moved - exact).max() < 5e-4


def test_seen_from_the_stamp_of_the_sweep_the_points_are_the_same() -> None:
    points, trajectory = sweep(), turning()
    p_map, valid = usable_points_in_map(points, 0.45, trajectory, T_IMU_LIDAR, 5.0, 70.0)
    p_lidar, T_map_lidar = usable_points_at_stamp(points, 0.45, trajectory, T_IMU_LIDAR, 5.0, 70.0)
    assert 0 < valid.sum() < len(valid)
    np.testing.assert_allclose(p_lidar @ T_map_lidar[:3, :3].T + T_map_lidar[:3, 3], p_map, atol=1e-9)
    still = Points(points.xyz, points.intensity, None)
    as_read, _ = usable_points_at_stamp(still, 0.45, trajectory, T_IMU_LIDAR, 5.0, 70.0)
    np.testing.assert_allclose(as_read, points.xyz[valid], atol=1e-9)


def test_a_point_does_not_move_for_what_else_the_sweep_holds() -> None:
    """Bit for bit, though the rest decides which poses are computed and how the points lie in blocks."""
    points, trajectory = sweep(), turning()
    whole = points_in_map(points, 0.45, trajectory, T_IMU_LIDAR)
    rng = np.random.default_rng(1)
    for share in (0.9, 0.3, 0.01):
        some = rng.random(len(whole)) < share
        np.testing.assert_array_equal(points_in_map(points[some], 0.45, trajectory, T_IMU_LIDAR), whole[some])


@pytest.mark.parametrize("junk", [0.0, 1.3, -1e9, 1e300, np.nan])
def test_stamps_of_points_that_are_left_out_may_be_anything(junk: float) -> None:
    points, trajectory = sweep(), turning()
    whole = points_in_map(points, 0.45, trajectory, T_IMU_LIDAR)
    out = np.random.default_rng(2).random(len(whole)) < 0.2
    xyz, stamps = points.xyz.copy(), np.array(points.stamps)
    xyz[out], stamps[out] = np.nan, junk
    damaged = Points(xyz, points.intensity, stamps)
    p_map, valid = usable_points_in_map(damaged, 0.45, trajectory, T_IMU_LIDAR)
    np.testing.assert_array_equal(valid, ~out)
    np.testing.assert_array_equal(p_map, whole[~out])


def test_a_row_of_zeros_is_no_point_whatever_the_range() -> None:
    points = sweep(100)
    xyz = np.where(np.arange(100)[:, None] % 3 == 0, np.float32(0), points.xyz)
    zeros = Points(xyz, points.intensity, points.stamps)
    _, valid = usable_points_in_map(zeros, 0.45, turning(), T_IMU_LIDAR, nearest_m=0.0)
    np.testing.assert_array_equal(valid, np.arange(100) % 3 > 0)
    np.testing.assert_array_equal(thinned(zeros, 0.5, 0, 80).xyz, thinned(points[valid], 0.5, 0, 80).xyz)


@pytest.mark.parametrize("junk", [np.nan, np.inf, -np.inf])
def test_a_point_without_a_stamp_is_left_out(junk: float) -> None:
    points, trajectory = sweep(), turning()
    whole = points_in_map(points, 0.45, trajectory, T_IMU_LIDAR)
    out = np.random.default_rng(3).random(len(whole)) < 0.2
    damaged = Points(points.xyz, points.intensity, np.where(out, junk, np.array(points.stamps)))
    p_map, valid = usable_points_in_map(damaged, 0.45, trajectory, T_IMU_LIDAR)
    np.testing.assert_array_equal(valid, ~out)
    np.testing.assert_array_equal(p_map, whole[~out])


def test_no_usable_point_is_no_point() -> None:
    points = sweep(100)
    nothing = Points(np.full((100, 3), np.nan, np.float32), points.intensity, np.full(100, np.nan))
    p_map, valid = usable_points_in_map(nothing, 0.45, turning(), T_IMU_LIDAR)
    assert p_map.shape == (0, 3)
    assert not valid.any()


def test_a_sweep_outside_the_trajectory_is_refused() -> None:
    points = sweep(100)
    late = Points(points.xyz, points.intensity, np.array(points.stamps) + 0.8)
    with pytest.raises(MeasurementError, match="leave the trajectory"):
        points_in_map(late, 1.25, turning(), T_IMU_LIDAR)


@pytest.mark.parametrize("columns", [3, 4, 5])
def test_points_need_not_lie_as_in_a_file(columns: int) -> None:
    """Rows of four are used where they are; anything else is brought into that form."""
    points, trajectory = sweep(), turning()
    rows: NDArray[np.float32] = np.full((len(points.xyz), columns), 7, np.float32)
    rows[:, :3] = points.xyz
    view = Points(rows[:, :3], points.intensity, points.stamps)
    assert np.shares_memory(view.rows, rows) == (columns == 4)
    np.testing.assert_array_equal(
        points_in_map(view, 0.45, trajectory, T_IMU_LIDAR),
        points_in_map(points, 0.45, trajectory, T_IMU_LIDAR),
    )
