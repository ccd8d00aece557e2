"""Which moment a stamp of the IMU names, and so which clock the trajectory is in: the receiver's."""

import numpy as np
import pytest

from factor_graphs.accuracy import errors
from factor_graphs.geodesy import LocalFrame
from factor_graphs.measurements import GnssFixes, ImuNoise, ImuSamples
from factor_graphs.rigid_motion import RigidMotion
from factor_graphs.settings import SmootherSettings
from factor_graphs.simulation import random_drive, simulate_biases, simulate_gnss, simulate_imu
from factor_graphs.smoothing import smooth

FRAME = LocalFrame(49.0, 8.4, 115.0)
LEVER = np.array([0.5, 0.3, 1.0])
SECONDS, STEP_S, PARTS = 125.0, 0.01, 4


def precise(are_means: bool) -> tuple[RigidMotion, ImuSamples, GnssFixes]:
    """Fixes of 1 cm, and an IMU that says the mean of the interval before its stamp, or what is at the stamp."""
    rng = np.random.default_rng(7)
    motion, noise = random_drive(SECONDS, rng), ImuNoise()
    stamps = np.arange(1.0, SECONDS, STEP_S)
    moments = stamps[:, None] - STEP_S * (np.arange(PARTS)[::-1] + 0.5) / PARTS * are_means
    exact = [simulate_imu(motion, of_part, FRAME) for of_part in moments.T]
    force = np.mean([part.specific_force for part in exact], axis=0)
    rate = np.mean([part.angular_rate for part in exact], axis=0)
    biases = simulate_biases(stamps, noise, rng)
    for values, bias, density in (
        (force, biases[:, :3], noise.accelerometer_noise_density),
        (rate, biases[:, 3:], noise.gyroscope_noise_density),
    ):
        values += bias + density / np.sqrt(STEP_S) * rng.standard_normal(values.shape)
    fixes = simulate_gnss(motion, np.arange(1.1, SECONDS - 0.5, 0.25), (0.01, 0.01, 0.02), LEVER, rng)
    return motion, ImuSamples(stamps, force, rate), fixes


@pytest.mark.parametrize("are_means", [True, False])
def test_the_instant_of_a_sample_is_found_and_the_trajectory_is_in_the_time_of_the_receiver(are_means):
    motion, imu, fixes = precise(are_means)
    s = smooth(imu, fixes, FRAME, SmootherSettings(estimate_time_offset=True), LEVER)
    assert abs(s.calibration.time_offset_s) < 3 * s.calibration.time_offset_stddev_s < 0.003
    assert s.trajectory.start == pytest.approx(1.0 - are_means * STEP_S / 2, abs=1e-9)
    assert any("imu_sample_instant: end" in note for note in s.notes) == are_means
    off = errors(s.keyframes, motion.trajectory(s.keyframes.stamps))
    assert off.horizontal_rms_m < 0.012


def test_an_instant_that_is_set_is_not_looked_for():
    _, imu, fixes = precise(are_means=True)
    short = imu[imu.stamps < 40.0], fixes[fixes.stamps < 39.0]
    starts = [
        smooth(*short, FRAME, SmootherSettings(imu_sample_instant=instant), LEVER).trajectory.start
        for instant in ("end", "middle")
    ]
    assert starts == pytest.approx([0.995, 1.0])
