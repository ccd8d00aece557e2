import numpy as np
from scipy.spatial.transform import Rotation

from factor_graphs import dense as dense_module
from factor_graphs.dense import densify
from factor_graphs.geodesy import LocalFrame
from factor_graphs.intervals import split
from factor_graphs.measurements import ImuNoise
from factor_graphs.trajectory import Trajectory

FRAME = LocalFrame(49.0, 8.4, 115.0)


def dense_of(drive, disturb=0.0):
    """Dense output from true keyframes, each disturbed a little, and an exact IMU."""
    cut = split(drive.imu, drive.fixes.stamps)
    rng = np.random.default_rng(0)
    T = drive.motion.poses(cut.keyframes)
    k = len(T)
    T[:, :3, 3] += disturb * rng.standard_normal((k, 3))
    T[:, :3, :3] = (
        T[:, :3, :3] @ Rotation.from_rotvec(0.01 * disturb * rng.standard_normal((k, 3))).as_matrix()
    )
    root = 0.1 * rng.standard_normal((k, 6, 6))
    keyframes = Trajectory(
        cut.keyframes, T, drive.motion.velocities(cut.keyframes), root @ np.swapaxes(root, 1, 2)
    )
    dense = densify(cut, keyframes, np.zeros((k, 6)), cut.noise(ImuNoise()), FRAME)
    return cut, keyframes, dense


def test_an_exact_imu_between_true_keyframes_gives_the_truth_everywhere(simulate):
    drive = simulate(2, seconds=60.0)
    _, _, dense = dense_of(drive)
    truth = drive.motion.trajectory(dense.stamps)
    assert np.abs(dense.positions - truth.positions).max() < 1e-4
    assert (
        np.abs(dense.velocities - truth.velocities).max() < 1e-3
    )  # the steps of the IMU are 1e-2 s, its jerk some m/s³
    assert np.abs(dense.T_map_imu[:, :3, :3] - truth.T_map_imu[:, :3, :3]).max() < 1e-5


def test_it_passes_through_every_keyframe_with_its_velocity_and_covariance_and_without_a_step(simulate):
    drive = simulate(2, seconds=60.0)
    cut, keyframes, dense = dense_of(drive, disturb=0.1)
    at = cut.bounds
    np.testing.assert_allclose(dense.T_map_imu[at], keyframes.T_map_imu, atol=1e-9)
    np.testing.assert_allclose(dense.velocities[at], keyframes.velocities, atol=1e-9)
    np.testing.assert_allclose(dense.covariances[at], keyframes.covariances, atol=1e-9)
    moved = np.diff(dense.positions, axis=0) / np.diff(dense.stamps)[:, None]
    np.testing.assert_allclose(moved, (dense.velocities[1:] + dense.velocities[:-1]) / 2, atol=0.02)


def test_blocks_change_nothing(simulate, monkeypatch):
    drive = simulate(2, seconds=20.0)
    _, _, whole = dense_of(drive, disturb=0.1)
    for block in (1, 150, 777):
        monkeypatch.setattr(dense_module, "BLOCK", block)
        _, _, parts = dense_of(drive, disturb=0.1)
        for name in ("stamps", "T_map_imu", "velocities", "covariances"):
            np.testing.assert_allclose(getattr(parts, name), getattr(whole, name), atol=1e-11)


def test_covariances_between_keyframes_are_covariances_and_no_smaller_than_the_mixture_of_both_ends(simulate):
    drive = simulate(2, seconds=20.0)
    _, keyframes, dense = dense_of(drive)
    assert np.linalg.eigvalsh(dense.covariances).min() > 0
    variance = dense.position_stddevs**2
    ends = keyframes.position_stddevs**2
    for axis in range(3):
        mixture = np.interp(dense.stamps, keyframes.stamps, ends[:, axis])
        assert np.all(variance[:, axis] >= mixture - 1e-12)
        assert np.all(variance[:, axis] <= mixture + 1e-4)
