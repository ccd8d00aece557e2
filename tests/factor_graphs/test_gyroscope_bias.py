"""A gyroscope that turns by degrees a second at rest: found from standstill or from the course, and taken out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import PchipInterpolator

from factor_graphs.accuracy import errors
from factor_graphs.geodesy import LocalFrame
from factor_graphs.gyroscope_bias import large_gyroscope_bias
from factor_graphs.measurements import GnssFixes, ImuNoise, ImuSamples
from factor_graphs.rigid_motion import drone, hand_held
from factor_graphs.simulation import Motion, random_drive
from factor_graphs.smoothing import heading_stddevs, smooth

FRAME = LocalFrame(49.0, 8.4, 115.0)
LEVER = np.array([0.5, 0.3, 1.0])


def without_stops(seconds: float, rng: np.random.Generator) -> Motion:
    """The way of a random drive, at speeds that are never zero."""
    path = random_drive(2 * seconds, rng).path
    stamps = np.linspace(0, seconds, int(seconds / 10))
    return Motion(path, PchipInterpolator(stamps, rng.uniform(5, 9, len(stamps))), np.radians(0.3))


def reversing(seconds: float, rng: np.random.Generator) -> Motion:
    """Forward, and twice as far in reverse."""
    path = random_drive(2 * seconds, rng).path
    speeds = PchipInterpolator([0, 0.6, 0.7, 1], np.array([9.0, 9.0, -7.0, -7.0]))
    return Motion(path, PchipInterpolator(seconds * speeds.x, speeds(speeds.x)), np.radians(0.3))


def biased(drive, degrees_per_s: np.ndarray):
    """The same with another gyroscope."""
    imu, more = drive.imu, np.radians(degrees_per_s)
    biased = ImuSamples(imu.stamps, imu.specific_force, imu.angular_rate + more)
    return replace(drive, imu=biased, biases=drive.biases + np.append(np.zeros(3), more))


def check(drive) -> None:
    """Heading within a degree, errors within three of their standard deviations, and the bias is the true one."""
    solution = smooth(drive.imu, drive.fixes, FRAME, p_imu_antenna=LEVER)
    found = errors(solution.trajectory, drive.motion.trajectory(solution.trajectory.stamps))
    assert found.heading_rms_deg < 1
    assert np.radians(found.heading_rms_deg) < 3 * np.median(heading_stddevs(solution.keyframes))
    variances = np.einsum("kii->k", solution.keyframes.covariances[:, 3:, 3:])
    truth = drive.motion.poses(solution.keyframes.stamps)[:, :3, 3]
    off = np.linalg.norm(solution.keyframes.positions - truth, axis=1)
    assert np.sqrt(np.mean(off**2)) < 3 * np.sqrt(variances.mean())
    at = np.searchsorted(drive.imu.stamps, solution.keyframes.stamps[1:-1])
    np.testing.assert_allclose(solution.biases[1:-1, 3:], drive.biases[at, 3:], atol=np.radians(0.1))
    assert any("deg/s at rest" in note for note in solution.notes)


@pytest.mark.parametrize("moves", [random_drive, without_stops, reversing])
@pytest.mark.parametrize("up", [-2.0, 5.0])
def test_the_heading_survives_a_large_bias(simulate, moves, up) -> None:
    check(biased(simulate(3, 240.0, ImuNoise(), moves), np.array([1.5, -0.7, up])))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(20))
def test_any_bias_of_up_to_5_degrees_per_second(simulate, seed) -> None:
    rng = np.random.default_rng(seed)
    moves = (random_drive, without_stops)[seed % 2]
    check(biased(simulate(seed, 240.0, ImuNoise(), moves), rng.choice([-1, 1], 3) * rng.uniform(1, 5, 3)))


def test_a_bias_as_data_sheets_have_it_is_left_to_the_graph(simulate) -> None:
    drive = simulate(1, 120.0, ImuNoise())
    level = drive.imu.angular_rate - drive.biases[:, 3:]
    for degrees_per_s in (0.0, 0.3, -0.3):
        rates = level + np.radians([0, 0, degrees_per_s])
        imu = ImuSamples(drive.imu.stamps, drive.imu.specific_force, rates)
        assert not large_gyroscope_bias(imu, drive.fixes).any()


@pytest.mark.parametrize("moves", [hand_held, drone])
@pytest.mark.parametrize("seed", [3, 4])
def test_what_does_not_look_where_it_goes_shows_no_bias(simulate, moves, seed: int) -> None:
    drive = simulate(seed, 300.0, ImuNoise(), moves)
    assert not large_gyroscope_bias(drive.imu, drive.fixes).any()


def test_what_turns_as_its_course_does_has_no_bias() -> None:
    """On a circle, forever: the mean rate is 6 degrees a second, and so is that of the course."""
    stamps = np.arange(0, 300, 0.01)
    rate = np.radians(6)
    imu = ImuSamples(
        stamps, np.tile([0, 8 * rate, 9.81], (len(stamps), 1)), np.tile([0, 0, rate], (len(stamps), 1))
    )
    at = np.arange(0.5, 299, 1.0)
    circle = 8 / rate * np.column_stack([np.sin(rate * at), -np.cos(rate * at), 0 * at])
    fixes = GnssFixes(at, circle, np.ones((len(at), 3)))
    assert not large_gyroscope_bias(imu, fixes).any()
    straight = GnssFixes(at, 8 * np.column_stack([at, 0 * at, 0 * at]), np.ones((len(at), 3)))
    np.testing.assert_allclose(large_gyroscope_bias(imu, straight), [0, 0, rate], atol=1e-2)


@pytest.mark.parametrize("count", [0, 2, 3])
def test_few_fixes_show_nothing(count) -> None:
    stamps = np.arange(0, 10, 0.01)
    imu = ImuSamples(stamps, np.tile([0, 0, 9.81], (1000, 1)), np.tile([0, 0, 0.05], (1000, 1)))
    fixes = GnssFixes(np.arange(count) + 1.0, np.zeros((count, 3)), np.ones((count, 3)))
    large_gyroscope_bias(imu, fixes)
