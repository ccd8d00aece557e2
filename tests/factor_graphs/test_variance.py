"""The noise of the IMU by variance components: against dense algebra, and on drives whose IMU is worse than said."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from factor_graphs.accuracy import coverage, pose_nees
from factor_graphs.covariances import keyframe_covariances
from factor_graphs.elimination import state_keys
from factor_graphs.fitting import fit_noise
from factor_graphs.geodesy import LocalFrame
from factor_graphs.measurements import GnssFixes, ImuNoise
from factor_graphs.problem import pose_problem
from factor_graphs.settings import SmootherSettings
from factor_graphs.simulation import simulate_gnss
from factor_graphs.smoothing import smooth
from factor_graphs.variance import BiasSteps, _redundancy, correlation_time_shown, imu_noise_shown

FRAME, LEVER = LocalFrame(49.0, 8.4, 115.0), np.array([0.5, 0.3, 1.0])


def test_redundancy_of_the_imu_is_that_of_dense_algebra(simulate):
    """Its rows, less the trace of their part of the hat matrix."""
    drive = simulate(41, seconds=20.0, noise=ImuNoise())
    problem = pose_problem(drive.imu, drive.fixes, FRAME, SmootherSettings(), LEVER, None)
    _, fit = fit_noise(problem)
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


@pytest.mark.slow
def test_biases_that_walk_faster_than_said_are_told_from_white_noise(simulate):
    """The walk is found to a half, and the white noise, which is as said, is hardly touched."""
    walking = {
        name: 5 * getattr(ImuNoise(), name) for name in ("accelerometer_bias_walk", "gyroscope_bias_walk")
    }
    whites, walks = [], []
    for seed in range(4):
        drive = simulate(540 + seed, seconds=400.0, noise=ImuNoise(**walking))
        found = smooth(drive.imu, drive.fixes, FRAME, None, LEVER)
        whites.append(found.inflation)
        walks.append(found.imu_noise.gyroscope_bias_walk / ImuNoise().gyroscope_bias_walk)
    assert np.median(whites) < 1.5
    assert 3.0 < np.median(walks) < 7.5


def test_the_variance_of_bias_steps_is_that_of_dense_algebra(simulate):
    drive = simulate(41, seconds=20.0, noise=ImuNoise())
    _, fit = fit_noise(pose_problem(drive.imu, drive.fixes, FRAME, SmootherSettings(), LEVER, None))
    k = sum(key >> 56 == ord("x") for key in fit.values.keys())  # noqa: SIM118
    steps = BiasSteps(k)
    keyframe_covariances(fit.graph, fit.values, k, steps)
    ordering = gtsam.Ordering()
    for i in range(k):
        for key in state_keys(i):
            ordering.push_back(key)
    A = fit.graph.linearize(fit.values).jacobian(ordering)[0]
    covariance = np.linalg.inv(A.T @ A)
    change = np.zeros((6, 15 * k))
    change[:, 15 * 3 + 9 : 15 * 3 + 15], change[:, 15 * 4 + 9 : 15 * 4 + 15] = -np.eye(6), np.eye(6)
    np.testing.assert_allclose(steps.variance[3], np.diag(change @ covariance @ change.T), rtol=1e-4)


def test_an_honest_imu_is_believed(simulate):
    inflations = []
    for seed in range(8):
        drive = simulate(520 + seed, seconds=100.0, noise=ImuNoise())
        inflations.append(smooth(drive.imu, drive.fixes, FRAME, None, LEVER).inflation)
    assert np.median(inflations) == 1.0
    assert max(inflations) < 1.4


@pytest.mark.parametrize("share", [3.0, 10.0])
def test_fixes_worse_than_they_say_are_found_out_and_the_imu_is_believed(simulate, share):
    """The solution is that of fixes that say what they are; before, the IMU followed them, up to 30 m off."""
    drive = simulate(550, seconds=200.0, noise=ImuNoise(), outages=[(80.0, 110.0)])
    boasting = GnssFixes(drive.fixes.stamps, drive.fixes.positions, drive.fixes.stddevs / share)
    found, honest = (smooth(drive.imu, fixes, FRAME, None, LEVER) for fixes in (boasting, drive.fixes))
    assert found.fix_inflation == pytest.approx(share, rel=0.15)
    assert honest.fix_inflation == 1.0
    assert found.inflation < 1.5
    assert any("as much as they say" in note for note in found.notes)
    apart = np.linalg.norm(found.keyframes.positions - honest.keyframes.positions, axis=1)
    assert np.all(apart < 0.5 * np.linalg.norm(honest.keyframes.position_stddevs, axis=1))
    np.testing.assert_allclose(found.keyframes.position_stddevs, honest.keyframes.position_stddevs, rtol=0.25)


def test_good_fixes_are_believed_beside_a_bad_imu(simulate):
    drive = simulate(551, seconds=100.0, noise=ImuNoise().scaled(30.0))
    rng = np.random.default_rng(1)
    precise = simulate_gnss(drive.motion, drive.fixes.stamps, (0.02, 0.02, 0.04), LEVER, rng)
    found = smooth(drive.imu, precise, FRAME, None, LEVER)
    assert found.fix_inflation == 1.0
    assert 20.0 < found.inflation < 45.0


def test_without_information_nothing_is_said(simulate):
    """Fixes of a kilometre say nothing of any IMU."""
    drive = simulate(41, seconds=20.0, noise=ImuNoise().scaled(3.0))
    vague = type(drive.fixes)(drive.fixes.stamps, drive.fixes.positions, np.full((len(drive.fixes), 3), 1e3))
    problem = pose_problem(drive.imu, vague, FRAME, SmootherSettings(), LEVER, None)
    _, fit = fit_noise(problem)
    steps = BiasSteps(len(problem.intervals.keyframes))
    covariances, _ = keyframe_covariances(fit.graph, fit.values, len(problem.intervals.keyframes), steps)
    assert imu_noise_shown(problem, fit, covariances, steps) == (1.0, 1.0)


def gauss_markov(rng, m, share, time):
    """Errors (m, 3) of variance 1 at 1 Hz: this share of it fades over a time, s; the rest is white."""
    keep, walked = np.exp(-1 / time), rng.standard_normal((m, 3))
    for i in range(1, m):
        walked[i] = keep * walked[i - 1] + np.sqrt(1 - keep**2) * walked[i]
    return np.sqrt(share) * walked + np.sqrt(1 - share) * rng.standard_normal((m, 3))


@pytest.mark.parametrize(("share", "time"), [(1.0, 10.0), (1.0, 60.0), (0.7, 10.0), (0.8, 30.0)])
def test_fixes_weigh_as_one_within_twice_the_integral_of_their_correlation(share, time):
    errors = gauss_markov(np.random.default_rng(1), 20_000, share, time)
    stamps = np.arange(len(errors)) + np.where(np.arange(len(errors)) > 9000, 500.0, 0.0)
    errors[9001:] += 1.0  # a step over a gap is none from neighbour to neighbour
    errors -= errors.mean(axis=0)
    assert correlation_time_shown(stamps, errors) == pytest.approx(2 * share * time, rel=0.25)


@pytest.mark.parametrize("better", [0.1, 1.0, 3.0])
def test_white_fixes_are_independent_however_good_they_are(better):
    for seed in range(20):
        errors = np.random.default_rng(seed).standard_normal((60, 3)) / better
        assert correlation_time_shown(np.arange(60.0), errors) == 0.0


def test_what_lasts_longer_than_the_drive_is_no_correlation_that_it_shows():
    ramp = np.linspace(-0.1, 0.1, 100)[:, None] * np.ones(3)
    assert correlation_time_shown(np.arange(100.0), ramp) == 0.0
    assert correlation_time_shown(np.arange(100.0), 0 * ramp) == 0.0
    assert correlation_time_shown(np.arange(3.0), ramp[:3]) == 0.0


@pytest.mark.slow
def test_fixes_that_wander_are_told_and_what_is_told_makes_covariances_honest(simulate):
    """Each claims white noise of its standard deviation; of many drives 90 % are in the ellipsoid for 90 %."""
    squares, believed = [], []
    for seed in range(4):
        drive = simulate(700 + seed, seconds=400.0, noise=ImuNoise())
        stamps, stddevs = drive.fixes.stamps, np.array([1.0, 1.0, 2.0])
        positions = simulate_gnss(
            drive.motion, stamps, [1e-6] * 3, LEVER, np.random.default_rng(seed),
            correlated_stddevs=stddevs, correlation_time_s=20.0,
        ).positions  # fmt: skip
        fixes = GnssFixes(stamps, positions, np.tile(stddevs, (len(stamps), 1)))
        alone = smooth(drive.imu, fixes, FRAME, None, LEVER)
        (note,) = (note for note in alone.notes if "wander" in note)
        told = float(note.split("fix_correlation_time_s to ")[1].split()[0])
        assert 30 < told < 60
        set_so = smooth(drive.imu, fixes, FRAME, SmootherSettings(fix_correlation_time_s=told), LEVER)
        assert not any("wander" in note for note in set_so.notes)
        for s, found in ((alone, believed), (set_so, squares)):
            found.append(pose_nees(s.keyframes, drive.motion.trajectory(s.keyframes.stamps)).position)
        assert not any("wander" in note for note in smooth(drive.imu, drive.fixes, FRAME, None, LEVER).notes)
    assert coverage(np.concatenate(believed), 3).scale_gap > 8
    assert 0.6 < coverage(np.concatenate(squares), 3).scale_gap < 1.5
