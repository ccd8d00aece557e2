from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from factor_graphs.accuracy import errors
from factor_graphs.calibration import LastingErrors
from factor_graphs.geodesy import LocalFrame
from factor_graphs.measurements import GnssFixes, ImuNoise, ImuSamples
from factor_graphs.problem import Fit, Problem, fit_as_expected, pose_problem
from factor_graphs.rigid_motion import Mounted
from factor_graphs.settings import SmootherSettings
from factor_graphs.simulation import random_drive, simulate_gnss
from factor_graphs.smoothing import smooth

FRAME = LocalFrame(49.0, 8.4, 115.0)
LEVER = np.array([0.5, 0.3, 1.0])


def precise(drive, offset: float) -> GnssFixes:
    """Fixes of 5 cm, of `offset` s after their stamps."""
    return simulate_gnss(
        drive.motion, drive.fixes.stamps, 0.05, LEVER, np.random.default_rng(0), time_offset_s=offset
    )


@pytest.mark.parametrize("offset", [pytest.param(0.1, marks=pytest.mark.slow), -0.04])
def test_a_time_offset_is_found_unasked_where_the_data_leave_no_doubt(simulate, offset):
    drive = simulate(60, seconds=180.0, noise=ImuNoise())
    s = smooth(drive.imu, precise(drive, offset), FRAME, None, LEVER)
    found = s.calibration
    assert found.time_offset_s == pytest.approx(offset, abs=4 * found.time_offset_stddev_s)
    assert found.time_offset_stddev_s < 0.005
    assert any("after its stamp" in note for note in s.notes)
    assert 0.8 < s.chi2_per_dof < 1.3


def test_where_there_is_no_offset_none_is_applied(simulate):
    for seed in range(3):
        drive = simulate(61 + seed, seconds=180.0, noise=ImuNoise())
        s = smooth(drive.imu, drive.fixes, FRAME, None, LEVER)
        assert s.calibration.time_offset_s == 0.0


@pytest.mark.slow
def test_a_time_offset_is_left_alone_when_it_shall_be(simulate):
    drive = simulate(60, seconds=180.0, noise=ImuNoise())
    s = smooth(drive.imu, precise(drive, 0.1), FRAME, SmootherSettings(estimate_time_offset=False), LEVER)
    assert s.calibration.time_offset_s == 0.0
    assert s.calibration.time_offset_stddev_s is None


def test_lever_arm_and_offset_are_found_together_when_asked(simulate):
    drive = simulate(65, seconds=180.0, noise=ImuNoise())
    settings = SmootherSettings(estimate_lever_arm=True, estimate_time_offset=True)
    s = smooth(drive.imu, precise(drive, 0.05), FRAME, settings, LEVER + np.array([0.4, -0.3, 0.0]))
    found = s.calibration
    off = np.abs(found.p_imu_antenna - LEVER) / found.p_imu_antenna_stddevs
    assert np.all(off < 4)
    assert np.all(found.p_imu_antenna_stddevs[:2] < 0.1)
    assert (
        found.p_imu_antenna_stddevs[2] > 0.3
    )  # a vehicle that hardly tilts does not show the height of its antenna
    assert found.time_offset_s == pytest.approx(0.05, abs=4 * found.time_offset_stddev_s)


def test_covariances_hold_what_is_not_known_of_clock_and_lever_arm(simulate):
    """They are those of the same data with both given, and what an error of either does to the place."""
    drive = simulate(65, seconds=130.0, noise=ImuNoise())
    both = SmootherSettings(estimate_lever_arm=True, estimate_time_offset=True)
    found = smooth(drive.imu, drive.fixes, FRAME, both, LEVER)
    clock, fixes = found.calibration, drive.fixes
    given = GnssFixes(fixes.stamps + clock.time_offset_s, fixes.positions, fixes.stddevs)
    none = SmootherSettings(estimate_time_offset=False)
    known = smooth(drive.imu, given, FRAME, none, clock.p_imu_antenna).keyframes
    R, moving = known.T_map_imu[:, :3, :3], known.velocities
    of_clock = clock.time_offset_stddev_s**2 * moving[:, :, None] * moving[:, None]
    of_lever = R @ np.diag(clock.p_imu_antenna_stddevs**2) @ np.swapaxes(R, 1, 2)
    expected = known.position_covariances + of_clock + of_lever
    np.testing.assert_allclose(found.keyframes.position_covariances, expected, atol=1e-6)


@pytest.mark.parametrize("scale", [1.01, pytest.param(0.97, marks=pytest.mark.slow)])
def test_a_gyroscope_that_turns_too_much_is_found(simulate, scale):
    drive = simulate(66, seconds=300.0, noise=ImuNoise(), moves=on_its_side)
    wrong = ImuSamples(drive.imu.stamps, drive.imu.specific_force, scale * drive.imu.angular_rate)
    right, found = (smooth(imu, drive.fixes, FRAME, None, LEVER) for imu in (drive.imu, wrong))
    assert right.calibration.gyroscope_scale == 0.0
    assert found.calibration.gyroscope_scale == pytest.approx(scale - 1, abs=2e-3)
    assert any("% too much about its y axis" in note for note in found.notes)
    truth = drive.motion.trajectory(found.keyframes.stamps)
    of_right, of_found = (errors(s.keyframes, truth).heading_rms_deg for s in (right, found))
    assert of_found < 1.5 * of_right


def on_its_side(seconds, rng):
    """The imu lies on its side: its y axis looks up."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("x", -90, degrees=True).as_matrix()
    return Mounted(random_drive(seconds, rng), T)


@pytest.mark.parametrize("stddev", [pytest.param(0.02, marks=pytest.mark.slow), 1.0])
def test_a_step_of_the_receivers_clock_is_found_where_it_is(simulate, stddev):
    drive = simulate(67, seconds=300.0, noise=ImuNoise())
    fixes = simulate_gnss(drive.motion, drive.fixes.stamps, stddev, LEVER, np.random.default_rng(0))
    stepped = replace(fixes, stamps=fixes.stamps + 0.3 * (fixes.stamps > 200.0))
    s = smooth(drive.imu, stepped, FRAME, None, LEVER)
    ((begin, step, of_step),) = s.calibration.clock_steps
    assert begin == pytest.approx(200.0, abs=5.0 if stddev == 1.0 else 1.0)
    assert step == pytest.approx(-0.3, abs=4 * of_step)
    assert of_step < 0.05
    assert any("clock of the fixes steps" in note for note in s.notes)
    without = smooth(drive.imu, fixes, FRAME, None, LEVER)
    assert without.calibration.clock_steps == ()
    truth = drive.motion.trajectory(s.keyframes.stamps)
    off = errors(s.keyframes, truth).horizontal_rms_m
    assert off < 1.5 * errors(without.keyframes, truth).horizontal_rms_m + 0.05


@pytest.mark.parametrize("noise", [None, ImuNoise()])
def test_lasting_errors_are_derivatives_of_the_cost_of_solutions_with_them(simulate, noise):
    """By finite differences: first derivatives with noise, second ones without, for residuals have their own."""
    drive = simulate(68, seconds=60.0, noise=noise)
    settings = SmootherSettings(robust=False, fix_correlation_time_s=0.0)

    def solved(scale: float, late: float) -> tuple[Problem, Fit]:
        right = drive.imu.angular_rate / [1, 1, 1 + scale]
        imu = ImuSamples(drive.imu.stamps, drive.imu.specific_force, right)
        fixes = replace(drive.fixes, stamps=drive.fixes.stamps + late * (drive.fixes.stamps > 30.0))
        problem = pose_problem(imu, fixes, FRAME, settings, LEVER, None)
        return problem, fit_as_expected(problem, tolerance=1e-9)

    says = LastingErrors.of(*solved(0.0, 0.0), np.array([30.0]))
    for column, direction in ((says.clock([30.0])[:, 1], (0.0, 0.01)), (np.eye(6)[5], (0.01, 0.0))):
        fits = [solved(*(sign * part for part in direction))[1] for sign in (0, 1, -1)]
        middle, more, less = (fit.graph.error(fit.values) for fit in fits)
        if noise is None:
            second = (more + less - 2 * middle) / 1e-4
            assert column @ says.information @ column == pytest.approx(second, rel=0.02)
        else:
            assert column @ says.vector == pytest.approx((less - more) / 2e-2, rel=0.02)
