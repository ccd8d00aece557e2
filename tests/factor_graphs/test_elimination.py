"""Elimination keyframe by keyframe, and the optimiser on it, against GTSAM's own of the whole graph."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, V, X

from factor_graphs.elimination import by_sections, eliminate, in_time, split, split_key
from factor_graphs.fitting import fit_noise
from factor_graphs.geodesy import LocalFrame
from factor_graphs.graph import from_values
from factor_graphs.levenberg_marquardt import minimise
from factor_graphs.measurements import ImuNoise
from factor_graphs.problem import first_values, motion_graph, optimise, pose_problem
from factor_graphs.relative_poses import RelativePoses
from factor_graphs.settings import SmootherSettings

FRAME = LocalFrame(49.0, 8.4, 115.0)
LEVER = np.array([0.5, 0.3, 1.0])
STDDEVS = np.repeat([1e-3, 0.01], 3)


def odometry(motion, stamps):
    """Relative poses without errors: each keyframe to the next, and every fifth, an anchor, to all up to the next."""
    earlier = np.concatenate([np.arange(len(stamps) - 1), np.arange(len(stamps) - 1) // 5 * 5])
    pairs = np.unique(np.column_stack([earlier, np.tile(np.arange(1, len(stamps)), 2)]), axis=0)
    T = motion.poses(stamps)
    between = np.linalg.inv(T[pairs[:, 0]]) @ T[pairs[:, 1]]
    return RelativePoses(stamps[pairs], between, np.tile(np.diag(STDDEVS**2), (len(pairs), 1, 1)))


@pytest.fixture
def bound(simulate):
    """A problem whose keyframes are bound by odometry."""
    drive = simulate(2, seconds=20.0, noise=ImuNoise())
    relative = odometry(drive.motion, np.arange(1.0, 19.0, 0.2))
    problem = pose_problem(drive.imu, drive.fixes, FRAME, SmootherSettings(), LEVER, None, relative)
    assert problem.is_bound
    return problem


def test_an_anchor_waits_until_its_section_is_eliminated():
    graph, model = gtsam.NonlinearFactorGraph(), gtsam.noiseModel.Unit.Create(6)
    for i, j in ((0, 1), (1, 2), (2, 3), (3, 4), (4, 5), (0, 2), (0, 3), (3, 5)):
        graph.push_back(gtsam.BetweenFactorPose3(X(i), X(j), gtsam.Pose3(), model))
    assert [split_key(keys[0])[1] for keys in by_sections(graph, 6)] == [1, 2, 0, 4, 5, 3]


@pytest.mark.parametrize("order", [in_time, by_sections])
def test_the_conditionals_are_the_whole_graph(bound, order):
    (_, fit), k = fit_noise(bound), len(bound.intervals.keyframes)
    groups = in_time(k) if order is in_time else by_sections(fit.graph, k)
    linear = fit.graph.linearize(fit.values)
    found = {}
    for keys, one in reversed(list(zip(groups, eliminate(split(linear, groups), groups), strict=True))):
        given = np.concatenate([np.empty(0), *(found[key] for key in one.later)])
        x = np.linalg.solve(one.R, one.d - one.S @ given if len(given) else one.d)
        found |= dict(zip(keys, np.split(x, [6, 9]), strict=True))
    theirs = linear.optimize()
    scale = np.max([np.abs(theirs.at(X(i))).max() for i in range(k)])
    for key in (key for i in range(k) for key in (X(i), V(i), B(i))):
        np.testing.assert_allclose(found[key], theirs.at(key), rtol=1e-5, atol=1e-6 * scale)


def test_what_no_group_needs_is_left(bound):
    (_, fit), k = fit_noise(bound), len(bound.intervals.keyframes)
    linear = fit.graph.linearize(fit.values)
    groups = in_time(k)[:-1]
    *parts, beyond = split(linear, groups)
    left: list[gtsam.GaussianFactor] = []
    assert len(list(eliminate(parts, groups, left))) == k - 1
    last = gtsam.GaussianFactorGraph()
    last.push_back(beyond)
    for factor in left:
        last.push_back(factor)
    ours = np.linalg.inv(last.hessian()[0])
    marginals = gtsam.Marginals(fit.graph, fit.values)
    theirs = marginals.jointMarginalCovariance([X(k - 1), V(k - 1), B(k - 1)]).fullMatrix()
    # the keys of a Hessian are sorted: biases, velocity, pose
    places = np.r_[9:15, 6:9, 0:6]
    theirs = theirs[np.ix_(places, places)]
    unit = np.sqrt(np.outer(theirs.diagonal(), theirs.diagonal()))
    np.testing.assert_allclose(ours / unit, theirs / unit, atol=1e-5)


def test_the_optimiser_finds_what_gtsams_finds(bound):
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
    far = gtsam.Values(fit.values)
    rng = np.random.default_rng(0)
    for i in range(k):
        turned = gtsam.Pose3(gtsam.Rot3.Expmap(rng.normal(scale=0.5, size=3)), rng.normal(scale=30.0, size=3))
        far.update(X(i), fit.values.atPose3(X(i)) * turned)
    values, iterations = minimise(fit.graph, far, k, 100, 1e-9)
    assert iterations < 100
    assert fit.graph.error(values) == pytest.approx(fit.graph.error(fit.values), rel=1e-3)


def test_keyframes_that_nothing_holds_are_an_error(bound):
    _, fit = fit_noise(bound)
    fit.values.insert(X(len(bound.intervals.keyframes)), gtsam.Pose3())
    with pytest.raises(RuntimeError):
        minimise(fit.graph, fit.values, len(bound.intervals.keyframes) + 1, 10, 1e-5)
