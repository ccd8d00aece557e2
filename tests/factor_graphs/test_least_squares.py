"""The optimiser finds what no small step makes better, from wherever it begins, or says that there is nothing."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import X

from factor_graphs.fitting import fit_noise
from factor_graphs.geodesy import LocalFrame
from factor_graphs.held_constraints import constrain
from factor_graphs.least_squares import minimise
from factor_graphs.model import from_values
from factor_graphs.problem import pose_problem
from factor_graphs.settings import SmootherSettings

FRAME = LocalFrame(49.0, 8.4, 115.0)
LEVER = np.array([0.5, 0.3, 1.0])


@pytest.fixture(scope="module")
def held(mems):
    """The graph of a drive in which the vehicle constraint is held, its solution, and the number of its keyframes."""
    problem = pose_problem(mems.imu, mems.fixes, FRAME, SmootherSettings(), LEVER, None)
    fit, _, vehicle, _ = constrain(*fit_noise(problem))
    assert vehicle.held
    return fit.graph, fit.values, len(problem.intervals.keyframes)


def moved(values, k, turn_rad, shift_m):
    """The same values with every pose turned and shifted at random."""
    far, rng = gtsam.Values(values), np.random.default_rng(0)
    for i in range(k):
        turn = gtsam.Rot3.Expmap(rng.normal(scale=turn_rad, size=3))
        far.update(X(i), values.atPose3(X(i)) * gtsam.Pose3(turn, rng.normal(scale=shift_m, size=3)))
    return far


def assert_least(graph, values):
    """A step of the linear graph would gain nothing."""
    linear = graph.linearize(values)
    least = linear.error(linear.optimize())
    assert least == pytest.approx(linear.error(values.zeroVectors()), rel=1e-6)


def test_undamped_steps_find_the_least_cost(held):
    graph, values, k = held
    found, iterations = minimise(graph, moved(values, k, 0.01, 0.5), False, 100, 1e-10)
    assert_least(graph, found)
    again, fewer = minimise(graph, found, False, 100, 1e-5)
    assert iterations > fewer == 1
    for one, other in zip(from_values(found, k), from_values(again, k), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-5)


def test_where_an_undamped_step_makes_it_worse_steps_are_damped(held):
    graph, values, k = held
    found, iterations = minimise(graph, moved(values, k, 0.5, 30.0), False, 100, 1e-9)
    assert iterations < 100
    assert graph.error(found) == pytest.approx(graph.error(values), rel=1e-3)


def test_a_bound_graph_is_solved_from_far_away(bound):
    (_, fit), k = fit_noise(bound), len(bound.intervals.keyframes)
    found, iterations = minimise(fit.graph, moved(fit.values, k, 0.5, 30.0), True, 100, 1e-9)
    assert iterations < 100
    assert fit.graph.error(found) == pytest.approx(fit.graph.error(fit.values), rel=1e-3)


def test_a_limit_of_iterations_is_kept(held):
    graph, values, k = held
    assert minimise(graph, moved(values, k, 0.5, 30.0), False, 2, 1e-10)[1] == 2
