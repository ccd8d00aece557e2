"""Elimination keyframe by keyframe, against GTSAM's own of the whole graph."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, V, X

from factor_graphs.elimination import by_sections, conditionals, eliminate, in_time, split, split_key
from factor_graphs.fitting import fit_noise


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
    for keys, one in reversed(list(zip(groups, conditionals(split(linear, groups), groups), strict=True))):
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
