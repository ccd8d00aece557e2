import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, M, V, X

from factor_graphs.covariances import keyframe_covariances
from factor_graphs.fitting import fit_noise
from factor_graphs.geodesy import LocalFrame
from factor_graphs.held_constraints import constrain
from factor_graphs.measurements import ImuNoise
from factor_graphs.problem import pose_problem
from factor_graphs.settings import SmootherSettings

FRAME = LocalFrame(49.0, 8.4, 115.0)
LEVER = np.array([0.5, 0.3, 1.0])


def relative_difference(ours: np.ndarray, theirs: np.ndarray) -> float:
    stddevs = np.sqrt(np.einsum("kii->ki", theirs))
    return float(np.abs((ours - theirs) / stddevs[:, :, None] / stddevs[:, None]).max())


def test_they_are_those_of_gtsams_marginals(simulate):
    drive = simulate(1, seconds=40.0, noise=ImuNoise())
    problem = pose_problem(drive.imu, drive.fixes, FRAME, SmootherSettings(), LEVER, None)
    (_, fit), k = fit_noise(problem), len(problem.intervals.keyframes)
    marginals = gtsam.Marginals(fit.graph, fit.values)
    theirs = [marginals.jointMarginalCovariance([X(i), V(i), B(i)]).fullMatrix() for i in range(k)]
    ours, _ = keyframe_covariances(fit.graph, fit.values, k)
    assert relative_difference(ours, np.array(theirs)) < 1e-5


def test_they_hold_where_factors_reach_over_several_keyframes(simulate):
    drive = simulate(2, seconds=20.0, noise=ImuNoise())
    problem = pose_problem(drive.imu, drive.fixes, FRAME, SmootherSettings(), LEVER, None)
    (_, fit), k = fit_noise(problem), len(problem.intervals.keyframes)
    graph = gtsam.NonlinearFactorGraph(fit.graph)
    model = gtsam.noiseModel.Isotropic.Sigma(6, 0.05)
    for i in range(0, k - 5, 3):
        between = fit.values.atPose3(X(i)).between(fit.values.atPose3(X(i + 5)))
        graph.push_back(gtsam.BetweenFactorPose3(X(i), X(i + 5), between, model))
    marginals = gtsam.Marginals(graph, fit.values)
    theirs = [marginals.jointMarginalCovariance([X(i), V(i), B(i)]).fullMatrix() for i in range(k)]
    ours, _ = keyframe_covariances(graph, fit.values, k)
    assert relative_difference(ours, np.array(theirs)) < 1e-5


def test_they_hold_where_all_keyframes_share_an_unknown(simulate):
    drive = simulate(3, seconds=120.0, noise=ImuNoise())
    problem = pose_problem(drive.imu, drive.fixes, FRAME, SmootherSettings(), LEVER, None)
    fit, _, vehicle, _ = constrain(*fit_noise(problem))
    assert vehicle.held
    k = len(problem.intervals.keyframes)
    marginals = gtsam.Marginals(fit.graph, fit.values)
    theirs = [marginals.jointMarginalCovariance([X(i), V(i), B(i)]).fullMatrix() for i in range(k)]
    ours, of_mounting = keyframe_covariances(fit.graph, fit.values, k)
    assert relative_difference(ours, np.array(theirs)) < 1e-5
    assert relative_difference(of_mounting[None], marginals.marginalCovariance(M(k))[None]) < 1e-5
