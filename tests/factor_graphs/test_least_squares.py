"""Gauss-Newton and Levenberg-Marquardt over keyframes, against GTSAM's own of the whole graph."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import M, X

from factor_graphs.fitting import fit_noise
from factor_graphs.geodesy import LocalFrame
from factor_graphs.graph import from_values
from factor_graphs.held_constraints import constrain
from factor_graphs.least_squares import gauss_newton, levenberg_marquardt
from factor_graphs.problem import first_values, motion_graph, optimise, pose_problem
from factor_graphs.settings import SmootherSettings

FRAME = LocalFrame(49.0, 8.4, 115.0)
LEVER = np.array([0.5, 0.3, 1.0])


@pytest.fixture(scope="module")
def held(mems):
    """The solution of a drive in which the vehicle constraint is held, and the number of its keyframes."""
    problem = pose_problem(mems.imu, mems.fixes, FRAME, SmootherSettings(), LEVER, None)
    fit, factors, vehicle, _ = constrain(*fit_noise(problem))
    assert factors
    assert vehicle.held
    return fit, len(problem.intervals.keyframes)


def moved(values, k, turn_rad, shift_m):
    """The same values with every pose turned and shifted at random."""
    far, rng = gtsam.Values(values), np.random.default_rng(0)
    for i in range(k):
        turn = gtsam.Rot3.Expmap(rng.normal(scale=turn_rad, size=3))
        far.update(X(i), values.atPose3(X(i)) * gtsam.Pose3(turn, rng.normal(scale=shift_m, size=3)))
    return far


def test_gauss_newton_finds_what_gtsams_finds(held):
    fit, k = held
    start = moved(fit.values, k, 0.01, 0.5)
    values, steps = gauss_newton(fit.graph, start, k, 100, 1e-10)
    params = gtsam.GaussNewtonParams()
    params.setLinearSolverType("MULTIFRONTAL_QR")
    newton = gtsam.GaussNewtonOptimizer(fit.graph, start, params)
    for _ in range(steps):
        newton.iterate()
    for ours, theirs in zip(from_values(values, k), from_values(newton.values(), k), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-8)
    np.testing.assert_allclose(values.atVector(M(k)), newton.values().atVector(M(k)), atol=1e-8)


def test_gauss_newton_stops_where_the_linear_graph_is_right(held):
    fit, k = held
    values, first = gauss_newton(fit.graph, moved(fit.values, k, 0.01, 0.5), k, 100, 1e-10)
    again, steps = gauss_newton(fit.graph, values, k, 100, 1e-5)
    assert first > steps == 1
    assert fit.graph.error(again) == pytest.approx(fit.graph.error(values), rel=1e-9)


def test_where_a_step_gains_nothing_gauss_newton_finds_nothing(held):
    fit, k = held
    assert gauss_newton(fit.graph, moved(fit.values, k, 2.0, 100.0), k, 100, 1e-5) is None


def test_a_limit_of_steps_is_kept(held):
    fit, k = held
    assert gauss_newton(fit.graph, moved(fit.values, k, 0.01, 0.5), k, 1, 1e-10) is None


def test_levenberg_marquardt_finds_what_gtsams_finds(bound):
    fit = optimise(
        bound, motion_graph(bound, 1.0, 1.0), first_values(bound), (1.0, 1.0), "huber", tolerance=1e-10
    )
    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(1e-10)
    params.setLinearSolverType("MULTIFRONTAL_QR")
    theirs = gtsam.LevenbergMarquardtOptimizer(fit.graph, first_values(bound), params).optimize()
    k = len(bound.intervals.keyframes)
    for ours, other in zip(from_values(fit.values, k), from_values(theirs, k), strict=True):
        np.testing.assert_allclose(ours, other, atol=1e-6)


def test_a_start_that_is_far_away_is_damped_until_it_helps(bound):
    (_, fit), k = fit_noise(bound), len(bound.intervals.keyframes)
    values, iterations = levenberg_marquardt(fit.graph, moved(fit.values, k, 0.5, 30.0), k, 100, 1e-9)
    assert iterations < 100
    assert fit.graph.error(values) == pytest.approx(fit.graph.error(fit.values), rel=1e-3)


def test_keyframes_that_nothing_holds_are_an_error(bound):
    _, fit = fit_noise(bound)
    fit.values.insert(X(len(bound.intervals.keyframes)), gtsam.Pose3())
    with pytest.raises(RuntimeError):
        levenberg_marquardt(fit.graph, fit.values, len(bound.intervals.keyframes) + 1, 10, 1e-5)
