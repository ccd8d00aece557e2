"""Heading of two antennas: exact in exact motion, worth having at rest, and wrong signs and offsets are found."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from factor_graphs.accuracy import errors
from factor_graphs.antenna_heading import observe_headings, wrapped
from factor_graphs.errors import MeasurementError
from factor_graphs.fitting import fit_noise
from factor_graphs.geodesy import LocalFrame
from factor_graphs.measurements import AntennaHeadings, ImuNoise
from factor_graphs.model import from_values, to_values
from factor_graphs.problem import pose_problem
from factor_graphs.settings import SmootherSettings
from factor_graphs.simulation import follow, simulate_headings
from factor_graphs.smoothing import heading_stddevs, smooth

FRAME = LocalFrame(49.0, 8.4, 115.0)
LEVER = np.array([0.5, 0.3, 1.0])
BASELINE = np.array([-0.9, 0.4, 0.05])
FREE = SmootherSettings(vehicle_constraint="off", standing_stddev_mps=None)
STDDEV = np.radians(0.5)


def headings_of(drive, seed: int | None) -> AntennaHeadings:
    rng = None if seed is None else np.random.default_rng(700 + seed)
    return simulate_headings(drive.motion, drive.fixes.stamps, STDDEV, BASELINE, rng)


def creeping(seconds: float, rng: np.random.Generator):
    """A machine that goes straight ahead at 0.05 m/s: its fixes do not show where it looks."""
    angle = rng.uniform(0, 2 * np.pi)
    way = np.linspace(0, 0.05 * seconds, 30)[:, None] * [np.cos(angle), np.sin(angle), 0.0]
    return follow(way, np.array([0.0, seconds]), np.array([0.05, 0.05]))


def test_the_jacobian_is_that_of_the_azimuth_and_exact_headings_cost_nothing(simulate):
    drive = simulate(2, 60.0)
    problem, fit = fit_noise(pose_problem(drive.imu, drive.fixes, FRAME, FREE, LEVER, None))
    observed = observe_headings(headings_of(drive, None), problem, fit)
    assert observed.factors is not None
    factors = observed.factors(fit)
    costs = [factor.error(fit.values) for factor in factors]
    assert np.sqrt(2 * np.max(costs)) * np.degrees(STDDEV) < 0.2  # degrees: the solution without them
    T, v, biases = from_values(fit.values, len(problem.intervals.keyframes))
    turned = T.copy()
    turned[:, :3, :3] = T[:, :3, :3] @ Rotation.from_rotvec([2e-4, -1e-4, 3e-4]).as_matrix()
    values = to_values(turned, v, biases)
    again = observe_headings(headings_of(drive, None), problem, replace(fit, values=values))
    assert again.factors is not None
    np.testing.assert_allclose(
        [f.error(values) for f in factors], [f.error(values) for f in again.factors(replace(fit, values=values))],
        rtol=1e-2, atol=1e-5,
    )  # fmt: skip


def test_a_machine_that_creeps_knows_its_heading_and_says_how_well(simulate):
    """Without: not observable. With: within the claimed deviation of 0.1 to 0.5 degrees."""
    off, claimed = [], []
    for seed in range(3):
        drive = simulate(seed, 60.0, ImuNoise(), creeping)
        found = smooth(drive.imu, drive.fixes, FRAME, FREE, LEVER, also=(headings_of(drive, seed),))
        assert not any("unobservable" in note for note in found.notes)
        keyframes = found.keyframes
        e = errors(keyframes, drive.motion.trajectory(keyframes.stamps))
        middle = len(keyframes) // 2
        off.append(e.rotation[middle, 2])
        claimed.append(heading_stddevs(keyframes)[middle])
    assert np.degrees(np.max(claimed)) < 0.5
    assert np.sum((np.array(off) / claimed) ** 2) < 11.3  # chi2 of 3 at 99 %


def test_headings_never_cost_accuracy(simulate):
    with_them, without = [], []
    for seed in range(3):
        drive = simulate(seed, 100.0, ImuNoise())
        for found, also in ((with_them, (headings_of(drive, seed),)), (without, ())):
            keyframes = smooth(drive.imu, drive.fixes, FRAME, FREE, LEVER, also=also).keyframes
            found.append(errors(keyframes, drive.motion.trajectory(keyframes.stamps)).heading_rms_deg)
    assert np.mean(with_them) < 0.7 * np.mean(without)


@pytest.mark.parametrize(
    ("made", "said"),
    [
        (lambda a: -a, "turns against the vehicle"),
        (lambda a: np.pi / 2 - a, "turns against the vehicle"),
        (lambda a: a + np.pi, "exchanged"),
        (lambda a: a + np.radians(12.0), "it is +11"),
        (lambda a: a - np.radians(90.0), "it is -91"),
        (lambda a: a + np.radians(8.0), "° off the heading of the motion"),
        (lambda a: np.radians(a % (2 * np.pi)), "is it in radians, not degrees?"),
        (lambda a: np.random.default_rng(3).uniform(-np.pi, np.pi, len(a)), "it does not follow the motion"),
    ],
)
def test_a_wrong_sign_or_a_constant_offset_is_found_against_the_motion(simulate, made, said):
    drive = simulate(1, 60.0, ImuNoise())
    right = headings_of(drive, 1)
    wrong = replace(right, azimuths=wrapped(made(right.azimuths)))
    plain, found = (smooth(drive.imu, drive.fixes, FRAME, FREE, LEVER, also=also) for also in ((), (wrong,)))
    assert any(note.startswith("antenna heading off") and said in note for note in found.notes), found.notes
    np.testing.assert_allclose(found.keyframes.positions, plain.keyframes.positions, atol=1e-6)


@pytest.mark.parametrize("baseline", [np.zeros(3), np.array([0.0, 0.01, 0.8])])
def test_two_antennas_that_are_one_are_refused(baseline):
    with pytest.raises(MeasurementError, match=r"two antennas are 0\.0.. m apart .* expected 0\.05 m"):
        AntennaHeadings([0.0], [1.0], [0.01], baseline)
