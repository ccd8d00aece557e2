import copy

import numpy as np
import pytest
from evo.core import metrics
from evo.core.trajectory import PoseTrajectory3D
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from factor_graphs.accuracy import anees_band, coverage, errors, nees, pose_nees, relative_error, state_error
from factor_graphs.errors import MeasurementError
from factor_graphs.trajectory import Trajectory


def pair(seed: int, k: int = 40) -> tuple[Trajectory, Trajectory]:
    """A wandering reference and an estimate a little off."""
    rng = np.random.default_rng(seed)
    stamps = np.arange(k) * 0.1
    T = np.tile(np.eye(4), (k, 1, 1))
    T[:, :3, 3] = np.cumsum(rng.standard_normal((k, 3)), axis=0)
    T[:, :3, :3] = Rotation.from_rotvec(np.cumsum(0.1 * rng.standard_normal((k, 3)), axis=0)).as_matrix()
    off = T.copy()
    off[:, :3, 3] += 0.3 * rng.standard_normal((k, 3))
    off[:, :3, :3] = off[:, :3, :3] @ Rotation.from_rotvec(0.02 * rng.standard_normal((k, 3))).as_matrix()
    return Trajectory(stamps, off), Trajectory(stamps, T)


def as_evo(t: Trajectory) -> PoseTrajectory3D:
    return PoseTrajectory3D(poses_se3=list(copy.deepcopy(t.T_map_imu)), timestamps=t.stamps)


@given(st.integers(0, 10**6))
def test_absolute_error_is_that_of_evo(seed):
    estimate, reference = pair(seed)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((as_evo(reference), as_evo(estimate)))
    assert errors(estimate, reference).ate_m == pytest.approx(ape.get_statistic(metrics.StatisticsType.rmse))


@given(st.integers(0, 10**6), st.integers(1, 10))
def test_relative_error_is_that_of_evo(seed, step):
    estimate, reference = pair(seed)
    ours = relative_error(estimate, reference, step)
    for relation, figure in (
        (metrics.PoseRelation.translation_part, ours.translation_m),
        (metrics.PoseRelation.rotation_angle_deg, ours.rotation_deg),
    ):
        rpe = metrics.RPE(relation, delta=step, delta_unit=metrics.Unit.frames, all_pairs=True)
        rpe.process_data((as_evo(reference), as_evo(estimate)))
        assert figure == pytest.approx(rpe.get_statistic(metrics.StatisticsType.rmse), rel=1e-6)


@given(st.integers(0, 10**6))
def test_moving_the_whole_world_changes_no_error(seed):
    estimate, reference = pair(seed)
    world = np.eye(4)
    world[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    world[:3, 3] = [100.0, -20.0, 3.0]
    moved = [Trajectory(t.stamps, world @ t.T_map_imu) for t in (estimate, reference)]
    assert errors(*moved).ate_m == pytest.approx(errors(estimate, reference).ate_m)
    assert relative_error(*moved).translation_m == pytest.approx(
        relative_error(estimate, reference).translation_m
    )


def test_errors_are_split_into_what_an_engineer_asks_for():
    _, reference = pair(0)
    T = reference.T_map_imu.copy()
    T[:, :3, 3] += [3.0, 4.0, 2.0]
    T[:, :3, :3] = Rotation.from_euler("z", 1, degrees=True).as_matrix() @ T[:, :3, :3]
    e = errors(Trajectory(reference.stamps, T), reference)
    assert (e.horizontal_rms_m, e.vertical_rms_m) == (pytest.approx(5.0), pytest.approx(2.0))
    assert (e.heading_rms_deg, e.tilt_rms_deg) == (pytest.approx(1.0), pytest.approx(0.0, abs=1e-6))
    assert len(e.within([(0.5, 1.0), (3.0, 3.15)]).stamps) == 6 + 2


def test_nees_of_honest_errors_has_the_mean_of_their_dimension():
    rng = np.random.default_rng(0)
    root = rng.standard_normal((15, 15))
    e = rng.standard_normal((20000, 15)) @ root.T
    P = np.broadcast_to(root @ root.T, (20000, 15, 15))
    low, high = anees_band(15, 20000, confidence=0.999)
    assert low < nees(e, P).mean() < high
    assert not low < nees(2 * e, P).mean() < high


def honest_pair(seed: int, k: int = 4000) -> tuple[Trajectory, Trajectory]:
    """An estimate, and a truth that differs from it by errors drawn from the covariances that the estimate claims."""
    rng = np.random.default_rng(seed)
    stamps = np.arange(k) * 0.1
    T = np.tile(np.eye(4), (k, 1, 1))
    T[:, :3, 3] = np.cumsum(rng.standard_normal((k, 3)), axis=0)
    T[:, :3, :3] = Rotation.random(k, random_state=seed).as_matrix()
    root = rng.standard_normal((6, 6)) * [[1e-3], [2e-3], [5e-3], [0.1], [0.5], [2.0]]  # no axis like another
    tangent = rng.standard_normal((k, 6)) @ root.T
    off = np.tile(np.eye(4), (k, 1, 1))
    off[:, :3, :3], off[:, :3, 3] = Rotation.from_rotvec(tangent[:, :3]).as_matrix(), tangent[:, 3:]
    claimed = np.broadcast_to(root @ root.T, (k, 6, 6))
    return Trajectory(stamps, T, covariances=claimed), Trajectory(stamps, T @ off)


def test_nees_of_an_honest_trajectory_is_its_degrees_of_freedom_whichever_way_it_looks():
    estimate, truth = honest_pair(1)
    boast = Trajectory(estimate.stamps, estimate.T_map_imu, covariances=estimate.covariances / 4)
    honest, boasted = pose_nees(estimate, truth), pose_nees(boast, truth)
    for part, dof in (("position", 3), ("horizontal", 2), ("orientation", 3)):
        low, high = anees_band(dof, len(truth), confidence=0.999)
        assert low < getattr(honest, part).mean() < high
        np.testing.assert_allclose(getattr(boasted, part), 4 * getattr(honest, part))


@pytest.mark.parametrize("dof", [2, 3])
@pytest.mark.parametrize("too_small", [0.5, 1.0, 4.0])
def test_coverage_is_what_chi_square_says_and_the_scale_gap_what_the_variances_lack(
    dof: int, too_small: float
):
    e = np.random.default_rng(dof).standard_normal((20000, dof))
    found = coverage(nees(e, np.broadcast_to(np.eye(dof) / too_small, (len(e), dof, dof))), dof)
    expected = chi2.cdf(chi2.ppf([0.5, 0.9, 0.95], dof) / too_small, dof)
    np.testing.assert_allclose(found.inside, expected, atol=4 * 0.5 / np.sqrt(len(e)))
    assert found.scale_gap == pytest.approx(too_small, rel=0.05)


def test_nees_takes_the_covariance_of_the_nearest_stamp():
    T = np.tile(np.eye(4), (3, 1, 1))
    covariances = np.array([1.0, 4.0, 16.0])[:, None, None] * np.eye(6)
    estimate = Trajectory(np.array([0.0, 1.0, 2.0]), T, covariances=covariances)
    moved = np.tile(np.eye(4), (5, 1, 1))
    moved[:, 0, 3] = 4.0
    found = pose_nees(estimate, Trajectory(np.array([0.0, 0.4, 0.6, 1.4, 2.0]), moved))
    np.testing.assert_allclose(found.position, [16.0, 16.0, 4.0, 4.0, 1.0])
    np.testing.assert_allclose(found.orientation, 0.0)
    with pytest.raises(MeasurementError, match="no covariances"):
        pose_nees(Trajectory(estimate.stamps, T), estimate)


def test_a_state_without_error_has_none_and_a_turned_one_has_the_turn():
    T = np.eye(4)
    T[:3, :3] = Rotation.random(random_state=1).as_matrix()
    zero = np.zeros(3)
    assert np.all(np.abs(state_error(T, zero, np.zeros(6), T, zero, np.zeros(6))) < 1e-12)
    true = T.copy()
    true[:3, :3] = T[:3, :3] @ Rotation.from_rotvec([0.01, 0.02, 0.03]).as_matrix()
    true[:3, 3] = T[:3, :3] @ [1.0, 2.0, 3.0]
    e = state_error(T, zero, np.zeros(6), true, [4, 5, 6], np.arange(6.0))
    np.testing.assert_allclose(e, [0.01, 0.02, 0.03, 1, 2, 3, 4, 5, 6, 0, 1, 2, 3, 4, 5], atol=1e-12)


def test_trajectories_that_do_not_overlap_are_refused():
    estimate, reference = pair(0)
    later = Trajectory(reference.stamps + 100, reference.T_map_imu)
    with pytest.raises(MeasurementError, match="do not overlap"):
        errors(estimate, later)
    with pytest.raises(MeasurementError, match="more than the step of 40"):
        relative_error(estimate, reference, 40)
