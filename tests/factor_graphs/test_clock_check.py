"""Fixes that are late, and rows that repeat them: what the graph finds is what the motion supports."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from factor_graphs.calibration import Calibration
from factor_graphs.clock_check import checked, supported_offsets
from factor_graphs.geodesy import LocalFrame
from factor_graphs.measurements import GnssFixes, ImuNoise, ImuSamples
from factor_graphs.rigid_motion import Mounted
from factor_graphs.settings import SmootherSettings
from factor_graphs.simulation import random_drive, simulate_gnss
from factor_graphs.smoothing import smooth

FRAME = LocalFrame(49.0, 8.4, 115.0)
LEVER = np.array([0.5, 0.3, 1.0])
LATE_S = 0.6


def turned(seconds, rng):
    """A drive seen by an IMU that looks to the left, leans, and lies on its back."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("ZYX", [90.0, 5.0, 170.0], degrees=True).as_matrix()
    return Mounted(random_drive(seconds + 2.0, rng), T)


def late(drive) -> GnssFixes:
    """A 1 Hz receiver whose message comes late."""
    rng = np.random.default_rng(1)
    return simulate_gnss(
        drive.motion, drive.fixes.stamps[1:], (1.0, 1.0, 2.0), LEVER, rng, time_offset_s=-LATE_S
    )


def repeated(fixes: GnssFixes) -> GnssFixes:
    """The same, as a logger writes them ten times a second."""
    stamps = (fixes.stamps[:, None] + 0.1 * np.arange(10)).ravel()
    return GnssFixes(stamps, np.repeat(fixes.positions, 10, axis=0), np.repeat(fixes.stddevs, 10, axis=0))


@pytest.mark.slow
def test_fixes_that_a_logger_repeats_are_used_once_at_the_moment_of_the_first(simulate):
    drive = simulate(0, seconds=150.0, noise=ImuNoise(), moves=turned)
    fixes = late(drive)
    s = smooth(drive.imu, repeated(fixes), FRAME, None, LEVER)
    assert s.calibration.time_offset_s == pytest.approx(-LATE_S, abs=4 * s.calibration.time_offset_stddev_s)
    assert s.calibration.time_offset_stddev_s < 0.05
    assert any(f"{9 * len(fixes)} of {10 * len(fixes)} fixes repeat" in note for note in s.notes)
    once = smooth(drive.imu, fixes, FRAME, None, LEVER)
    np.testing.assert_allclose(once.keyframes.positions, s.keyframes.positions, atol=1e-6)


def test_a_receiver_may_hold_its_position_while_it_stands():
    stamps = np.arange(0.0, 60.0, 0.01)
    imu = ImuSamples(stamps, np.tile([0.0, 0.0, 9.81], (len(stamps), 1)), np.zeros((len(stamps), 3)))
    held = GnssFixes(np.arange(1.0, 59.0), np.tile([1.0, 2.0, 3.0], (58, 1)), np.ones((58, 3)))
    s = smooth(imu, held, FRAME)
    assert not s.rejected.any()
    np.testing.assert_allclose(
        s.keyframes.positions, np.tile([1.0, 2.0, 3.0], (len(s.keyframes), 1)), atol=0.05
    )


@pytest.mark.parametrize("seed", range(3))
def test_the_motion_supports_the_true_offset_and_only_what_is_near(simulate, seed):
    drive = simulate(seed, seconds=300.0, noise=ImuNoise(), moves=turned)
    supported = supported_offsets(drive.imu, late(drive), LEVER, 3.0)
    assert np.abs(supported + LATE_S).min() < 0.05
    assert np.abs(supported + LATE_S).max() < 0.3


def test_an_offset_that_the_motion_excludes_is_not_taken_but_counted(simulate):
    drive = simulate(0, seconds=150.0, noise=ImuNoise(), moves=turned)
    fixes, antenna = late(drive), Calibration(-1.8, LEVER, 0.05)
    refused = checked(antenna, drive.imu, fixes, of_noise=1.0)
    assert refused.time_offset_s == 0.0
    assert refused.time_offset_stddev_s == pytest.approx(LATE_S, abs=0.1)
    assert "-1.80 s after their stamps" in refused.refused
    right = replace(antenna, time_offset_s=-LATE_S)
    assert checked(right, drive.imu, fixes, of_noise=1.0) is right


@pytest.mark.slow
def test_an_offset_is_not_taken_where_a_wrong_gyroscope_leaves_nothing_to_tell_it_by(simulate):
    drive = simulate(0, seconds=80.0, noise=ImuNoise())
    mirrored = ImuSamples(
        drive.imu.stamps, drive.imu.specific_force, drive.imu.angular_rate * [1.0, 1.0, -1.0]
    )
    s = smooth(mirrored, drive.fixes, FRAME, SmootherSettings(estimate_time_offset=True), LEVER)
    assert s.calibration.time_offset_s == 0.0
    assert s.calibration.time_offset_stddev_s > 0.1
    assert any("not taken" in note for note in s.notes)
