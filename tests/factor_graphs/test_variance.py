"""The noise of the IMU by variance components: against dense algebra, and on drives whose IMU is worse than said."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from factor_graphs.accuracy import pose_nees
from factor_graphs.covariances import keyframe_covariances
from factor_graphs.fitting import fit_noise
from factor_graphs.geodesy import LocalFrame
from factor_graphs.measurements import ImuNoise
from factor_graphs.problem import pose_problem
from factor_graphs.settings import SmootherSettings
from factor_graphs.smoothing import smooth
from factor_graphs.variance import _redundancy, missing_imu_noise

FRAME, LEVER = LocalFrame(49.0, 8.4, 115.0), np.array([0.5, 0.3, 1.0])


def test_redundancy_of_the_imu_is_that_of_dense_algebra(simulate):
    """Its rows, less the trace of their part of the hat matrix."""
    drive = simulate(41, seconds=20.0, noise=ImuNoise())
    problem = pose_problem(drive.imu, drive.fixes, FRAME, SmootherSettings(), LEVER, None)
    fit = fit_noise(problem)
    k = len(problem.intervals.keyframes)
    covariances, _ = keyframe_covariances(fit.graph, fit.values, k)
    ordering = gtsam.Ordering()
    for key in fit.values.keys():  # noqa: SIM118
        ordering.push_back(key)
    of_imu, whole = (graph.linearize(fit.values).jacobian(ordering)[0] for graph in (fit.motion, fit.graph))
    of_imu = of_imu[: 15 * (k - 1)]  # the priors follow
    _, R = np.linalg.qr(whole)
    taken = np.linalg.norm(np.linalg.solve(R.T, of_imu.T)) ** 2
    assert _redundancy(fit, covariances) == pytest.approx(len(of_imu) - taken, rel=1e-3)


@pytest.mark.parametrize("seed", range(4))
def test_an_imu_three_times_as_noisy_as_said_is_found_out_though_fixes_hide_it(simulate, seed):
    drive = simulate(500 + seed, seconds=200.0, noise=ImuNoise().scaled(3.0))
    found = smooth(drive.imu, drive.fixes, FRAME, None, LEVER)
    assert found.chi2_per_dof < 1.3
    assert 1.5 < found.inflation < 4.5
    settings = SmootherSettings(inflate_imu_noise=False)
    believed = smooth(drive.imu, drive.fixes, FRAME, settings, LEVER)
    assert believed.inflation == 1.0
    of_found, of_believed = (
        pose_nees(s.keyframes, drive.motion.trajectory(s.keyframes.stamps)).orientation
        for s in (found, believed)
    )
    assert abs(np.mean(of_found) - 3) < abs(np.mean(of_believed) - 3)


def test_an_honest_imu_is_believed(simulate):
    inflations = []
    for seed in range(8):
        drive = simulate(520 + seed, seconds=100.0, noise=ImuNoise())
        inflations.append(smooth(drive.imu, drive.fixes, FRAME, None, LEVER).inflation)
    assert np.median(inflations) == 1.0
    assert max(inflations) < 1.4


def test_without_information_nothing_is_said(simulate):
    """Fixes of a kilometre say nothing of any IMU."""
    drive = simulate(41, seconds=20.0, noise=ImuNoise().scaled(3.0))
    vague = type(drive.fixes)(drive.fixes.stamps, drive.fixes.positions, np.full((len(drive.fixes), 3), 1e3))
    problem = pose_problem(drive.imu, vague, FRAME, SmootherSettings(), LEVER, None)
    fit = fit_noise(problem)
    covariances, _ = keyframe_covariances(fit.graph, fit.values, len(problem.intervals.keyframes))
    assert missing_imu_noise(fit, covariances, False) == 1.0
