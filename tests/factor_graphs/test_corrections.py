import numpy as np
from scipy.spatial.transform import Rotation

from factor_graphs.corrections import Correction
from factor_graphs.simulation import random_drive
from factor_graphs.trajectory import Trajectory

STAMPS, ANCHORS = np.arange(0.0, 20.0, 0.05), np.arange(1.0, 19.0, 1.0)


def track() -> Trajectory:
    motion = random_drive(20.0, np.random.default_rng(8))
    covariances = np.tile(np.diag([1e-6] * 3 + [1e-2] * 3), (len(STAMPS), 1, 1))
    return Trajectory(STAMPS, motion.poses(STAMPS), motion.velocities(STAMPS), covariances)


def rigid(degrees: float, shift: tuple[float, float, float]) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("ZYX", [degrees, 0.3 * degrees, -0.2 * degrees], degrees=True).as_matrix()
    T[:3, 3] = shift
    return T


def correction(trajectory: Trajectory, after: np.ndarray, stddev_m: float = 0.1) -> Correction:
    covariances = np.tile(np.diag([1e-6] * 3 + [stddev_m**2] * 3), (len(ANCHORS), 1, 1))
    return Correction(ANCHORS, trajectory.at(ANCHORS), after, covariances)


def test_a_rigid_motion_of_the_anchors_moves_the_whole_trajectory_rigidly():
    trajectory, G = track(), rigid(20.0, (3.0, -2.0, 1.0))
    moved = correction(trajectory, G @ trajectory.at(ANCHORS)).of(trajectory)
    expected = trajectory.moved(G)
    assert np.allclose(moved.T_map_imu, expected.T_map_imu, atol=1e-9)
    assert np.allclose(moved.velocities, expected.velocities, atol=1e-9)


def test_anchors_are_met_and_velocities_are_those_of_the_positions():
    trajectory, rng = track(), np.random.default_rng(9)
    after = trajectory.at(ANCHORS)
    after[:, :3, 3] += np.cumsum(0.02 * rng.standard_normal((len(ANCHORS), 3)), axis=0)
    moved = correction(trajectory, after).of(trajectory)
    assert np.allclose(moved.at(ANCHORS), after, atol=1e-9)
    middle = slice(30, -30)
    driven = np.gradient(moved.positions, STAMPS, axis=0)[middle]
    before = np.gradient(trajectory.positions, STAMPS, axis=0)[middle]
    error = np.linalg.norm(driven - moved.velocities[middle], axis=1)
    # at an anchor the slope changes: a difference over two steps sees half of it
    assert np.median(error) < np.median(np.linalg.norm(before - trajectory.velocities[middle], axis=1)) + 1e-3


def test_covariances_become_those_of_the_anchors_and_keep_what_they_have_more():
    trajectory = track()
    own = trajectory.covariances.copy()
    between = np.abs(STAMPS - 7.5) < 0.01
    own[between, 3:, 3:] += 0.05 * np.eye(3)
    trajectory = Trajectory(STAMPS, trajectory.T_map_imu, trajectory.velocities, own)
    found = correction(trajectory, trajectory.at(ANCHORS), stddev_m=0.02).of(trajectory).covariances
    assert np.allclose(found[~between, 3:, 3:], 0.02**2 * np.eye(3), atol=1e-9)
    assert np.allclose(found[between, 3:, 3:], (0.02**2 + 0.05) * np.eye(3), atol=1e-9)
    assert np.linalg.eigvalsh(found).min() > 0


def test_a_trajectory_without_velocities_and_covariances_stays_without():
    trajectory = Trajectory(STAMPS, track().T_map_imu)
    moved = correction(trajectory, trajectory.at(ANCHORS)).of(trajectory)
    assert moved.velocities is None
    assert moved.covariances is None
    assert np.allclose(moved.T_map_imu, trajectory.T_map_imu)
