"""Given poses: fitted to fixes, compared with a gyroscope, held by relative poses; the oracle is exact motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from factor_graphs.errors import MeasurementError
from factor_graphs.geodesy import LocalFrame
from factor_graphs.given_poses import held_by, pose_by_fixes, turns_seen
from factor_graphs.measurements import GnssFixes
from factor_graphs.relative_poses import RelativePoses
from factor_graphs.simulation import random_drive, simulate_imu
from factor_graphs.trajectory import Trajectory

MOTION = random_drive(40.0, np.random.default_rng(3))
STAMPS = np.arange(0.0, 40.0, 0.1)
TRUTH = Trajectory(STAMPS, MOTION.poses(STAMPS))
LEVER = np.array([0.5, 0.3, 1.0])
NO_CORRELATION_S = 0.0


def fixes(stddev_m: float = 0.0) -> GnssFixes:
    stamps = np.arange(0.5, 39.0, 1.0)
    T = MOTION.poses(stamps)
    noise = stddev_m * np.random.default_rng(1).standard_normal((len(stamps), 3))
    return GnssFixes(
        stamps, T[:, :3, :3] @ LEVER + T[:, :3, 3] + noise, np.full((len(stamps), 3), max(stddev_m, 0.1))
    )


def a_frame(roll_deg: float = 0.0) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("ZYX", [123.0, 0.0, roll_deg], degrees=True).as_matrix()
    T[:3, 3] = 400.0, -70.0, 9.0
    return T


@pytest.mark.parametrize("roll_deg", [0.0, 5.0])
def test_a_frame_of_its_own_is_found_by_exact_fixes(roll_deg: float) -> None:
    T = pose_by_fixes(TRUTH.moved(a_frame(roll_deg)), fixes(), LEVER)
    assert T is not None
    np.testing.assert_allclose(T @ a_frame(roll_deg), np.eye(4), atol=1e-6 if not roll_deg else 1e-5)


def test_with_noise_the_map_stays_level_and_wrong_fixes_count_little() -> None:
    some = fixes(1.0)
    positions = some.positions.copy()
    positions[5:9] += 60.0
    T = pose_by_fixes(TRUTH.moved(a_frame()), replace(some, positions=positions), LEVER)
    assert T is not None
    assert T[2, 2] == 1.0
    off = (T @ a_frame())[:3, 3] - np.eye(4)[:3, 3]
    np.testing.assert_allclose(Rotation.from_matrix((T @ a_frame())[:3, :3]).magnitude(), 0.0, atol=0.01)
    assert np.linalg.norm((T @ a_frame() @ TRUTH.T_map_imu[200])[:3, 3] - TRUTH.positions[200]) < 1.5, off


def test_a_way_that_is_too_short_tells_no_heading() -> None:
    still = replace(TRUTH, T_map_imu=np.tile(TRUTH.T_map_imu[:1], (len(TRUTH), 1, 1)))
    assert pose_by_fixes(still, fixes(1.0), LEVER) is None


@pytest.mark.parametrize("late_s", [0.0, 0.4, -0.75])
def test_the_gyroscope_tells_how_late_stamps_are(late_s: float) -> None:
    imu = simulate_imu(
        MOTION, np.arange(0.0, 40.0, 0.01), LocalFrame(49.0, 8.4, 115.0), None, np.random.default_rng(0)
    )
    seen = turns_seen(replace(TRUTH, stamps=STAMPS + late_s), imu)
    assert seen is not None
    assert seen.is_known
    assert seen.late_s == pytest.approx(late_s, abs=0.051)
    assert seen.fits(seen.off_then)
    assert late_s or seen.off < 0.02 * seen.turning


def relative(truth: Trajectory, stddev: float = 1e-3) -> RelativePoses:
    T = np.linalg.inv(truth.T_map_imu[:-1]) @ truth.T_map_imu[1:]
    pairs = np.column_stack([truth.stamps[:-1], truth.stamps[1:]])
    return RelativePoses(pairs, T, np.tile(stddev**2 * np.eye(6), (len(T), 1, 1)))


def test_exact_poses_with_exact_relative_poses_stay() -> None:
    held = held_by(TRUTH, relative(TRUTH), (1e-3, 0.1), NO_CORRELATION_S)
    np.testing.assert_allclose(held.T_map_imu, TRUTH.T_map_imu, atol=1e-6)


def noisy(stddev_m: float) -> Trajectory:
    T = TRUTH.T_map_imu.copy()
    T[:, :3, 3] += stddev_m * np.random.default_rng(2).standard_normal((len(T), 3))
    return replace(TRUTH, T_map_imu=T)


def test_noise_of_poses_goes_where_relative_poses_are_better() -> None:
    given = noisy(0.2)
    held = held_by(given, relative(TRUTH), (np.radians(0.1), 0.2), NO_CORRELATION_S)
    before, after = (
        np.sqrt(((one.positions - TRUTH.positions) ** 2).sum(axis=1).mean()) for one in (given, held)
    )
    assert after < 0.25 * before
    # what is common to all poses stays: relative poses know no place
    np.testing.assert_allclose(held.positions.mean(axis=0), given.positions.mean(axis=0), atol=0.02)


def test_covariances_of_the_poses_are_the_weights() -> None:
    given = noisy(0.2)
    sure = np.tile(np.diag(np.repeat([1e-8, 1e-10], 3)), (len(given), 1, 1))
    held = held_by(replace(given, covariances=sure), relative(TRUTH, 1.0), (1.0, 1.0), NO_CORRELATION_S)
    np.testing.assert_allclose(held.positions, given.positions, atol=1e-4)
    assert held.covariances is not None
    with pytest.raises(MeasurementError, match="not positive definite"):
        held_by(replace(given, covariances=0 * sure), relative(TRUTH), (1.0, 1.0), NO_CORRELATION_S)
