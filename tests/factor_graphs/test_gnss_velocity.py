"""Velocity of the receiver: exact where the motion is, worth having, and wrong units and axes are found."""

from dataclasses import replace

import numpy as np
import pytest

from factor_graphs.accuracy import errors, nees
from factor_graphs.chi_square import quantile
from factor_graphs.fitting import fit_noise
from factor_graphs.geodesy import LocalFrame
from factor_graphs.gnss_velocity import observe_velocities
from factor_graphs.measurements import UNMEASURED, GnssVelocities, ImuNoise, clean_velocities
from factor_graphs.problem import pose_problem
from factor_graphs.settings import SmootherSettings
from factor_graphs.simulation import simulate_velocities
from factor_graphs.smoothing import smooth

FRAME = LocalFrame(49.0, 8.4, 115.0)
LEVER = np.array([0.5, 0.3, 1.0])
FREE = SmootherSettings(vehicle_constraint="off", standing_stddev_mps=None)
STDDEVS = (0.05, 0.05, 0.1)


def velocities_of(drive, seed: int | None, stamps: np.ndarray | None = None) -> GnssVelocities:
    rng = None if seed is None else np.random.default_rng(500 + seed)
    return simulate_velocities(
        drive.motion, drive.fixes.stamps if stamps is None else stamps, STDDEVS, LEVER, rng
    )


def test_in_exact_motion_the_velocities_of_the_antenna_cost_nothing(simulate):
    """The lever arm turns with the vehicle, and stamps beside keyframes are carried: all of it within 1 cm/s."""
    drive = simulate(2, 100.0)
    late = velocities_of(drive, None, drive.fixes.stamps + 0.01)
    relative = drive.fixes.stamps  # keyframes at the fixes alone
    problem, fit = fit_noise(pose_problem(drive.imu, drive.fixes, FRAME, FREE, LEVER, None))
    assert len(problem.intervals.keyframes) < 2 * len(relative)
    observed = observe_velocities(late, problem, fit)
    assert observed.factors is not None
    costs = np.array([factor.error(fit.values) for factor in observed.factors(fit)])
    assert len(costs) == len(late)
    assert np.sqrt(2 * np.median(costs)) * 0.05 < 0.01


def test_velocities_go_on_where_positions_end(simulate):
    """In 30 s without positions the error falls by more than half, and is as large as it says."""
    outage, with_them, without, squares = (40.0, 70.0), [], [], []
    for seed in range(4):
        drive = simulate(seed, 110.0, ImuNoise(), outages=[outage])
        velocities = velocities_of(drive, seed, np.arange(1.37, 109.0))
        for found, also in ((with_them, (velocities,)), (without, ())):
            keyframes = smooth(drive.imu, drive.fixes, FRAME, FREE, LEVER, also=also).keyframes
            e = errors(keyframes, drive.motion.trajectory(keyframes.stamps))
            found.append(e.within([outage]).horizontal_rms_m)
            if also:
                middle = np.argmin(np.abs(keyframes.stamps - 55.0))
                squares.append(nees(e.position[[middle]], keyframes.position_covariances[[middle]])[0])
    assert np.mean(with_them) < np.mean(without) / 2
    assert quantile(0.01, 3 * len(squares)) < np.sum(squares) < quantile(0.99, 3 * len(squares))


@pytest.mark.parametrize(
    ("made", "said"),
    [
        (lambda v: v * 3600 / 1852, "in knots, not m/s"),
        (lambda v: v * 3.6, "in km/h, not m/s"),
        (lambda v: v[:, [1, 0, 2]], "north, east, not east, north"),
        (lambda v: -v, "backwards"),
    ],
)
def test_another_unit_or_order_is_found_against_the_positions(simulate, made, said):
    drive = simulate(1, 60.0, ImuNoise())
    right = velocities_of(drive, 1)
    wrong = replace(right, velocities=made(right.velocities))
    plain, found = (smooth(drive.imu, drive.fixes, FRAME, FREE, LEVER, also=also) for also in ((), (wrong,)))
    assert any(note.startswith("GNSS velocity off") and said in note for note in found.notes)
    np.testing.assert_allclose(found.keyframes.positions, plain.keyframes.positions, atol=1e-6)


def test_a_velocity_along_the_axes_of_the_vehicle_is_named_and_not_used(simulate):
    """Drivers of ROS publish both as a TwistStamped."""
    drive = simulate(1, 60.0, ImuNoise())
    right = velocities_of(drive, 1)
    R = drive.motion.poses(right.stamps)[:, :3, :3]
    wrong = replace(right, velocities=np.einsum("kji,kj->ki", R, right.velocities))
    plain, found = (smooth(drive.imu, drive.fixes, FRAME, FREE, LEVER, also=also) for also in ((), (wrong,)))
    assert any("are they along the axes of the vehicle, not east, north?" in note for note in found.notes)
    np.testing.assert_allclose(found.keyframes.positions, plain.keyframes.positions, atol=1e-6)


def test_noise_that_is_not_stated_is_found(simulate):
    """Velocities with six times the noise that they state: the claim of the solution stays honest."""
    ratios = []
    for seed in range(3):
        drive = simulate(seed, 100.0, ImuNoise())
        exact, noisy = velocities_of(drive, None), velocities_of(drive, seed)
        noise = 6 * (noisy.velocities - exact.velocities)
        found = smooth(
            drive.imu,
            drive.fixes,
            FRAME,
            FREE,
            LEVER,
            also=(replace(exact, velocities=exact.velocities + noise),),
        )
        said = next(note for note in found.notes if note.startswith("GNSS velocity"))
        ratios.append(float(said.split("as if of ")[1].split(" times")[0]))
    assert np.mean(ratios) == pytest.approx(6.0, rel=0.15)


def test_errors_that_last_count_once(simulate):
    """Ten velocities a second whose errors last 1 s, exp(-t/1 s): 1 + 2 sum rho^k = 20 of them say as much as one."""
    counted = []
    for seed in range(3):
        drive = simulate(seed, 100.0, ImuNoise())
        stamps = np.arange(1.37, 99.0, 0.1)
        exact, rng = velocities_of(drive, None, stamps), np.random.default_rng(seed)
        noise = np.zeros((len(stamps), 3))
        rho = np.exp(-0.1)
        for k in range(1, len(noise)):
            noise[k] = rho * noise[k - 1] + np.sqrt(1 - rho**2) * rng.standard_normal(3)
        given = replace(exact, velocities=exact.velocities + 6 * noise * exact.stddevs)
        problem, fit = fit_noise(
            pose_problem(drive.imu, drive.fixes, FRAME, FREE, LEVER, None, also_at=stamps)
        )
        verdict = observe_velocities(given, problem, fit).verdict
        counted.append(float(verdict.split("as if of ")[1].split(" times")[0]) / 6)
    expected = np.sqrt((1 + rho) / (1 - rho))
    assert np.mean(counted) == pytest.approx(expected, rel=0.25)


def test_what_is_not_measured_is_not_used_and_rows_without_velocity_are_counted():
    v = np.array([[1.0, 2.0, np.nan], [np.nan, 2.0, 0.0], [1.0, 2.0, 3.0], [1.0, 1.0, 1.0]])
    s = np.array([[0.1, 0.1, np.nan], [0.1, 0.1, 0.1], [0.1, 0.1, 0.2], [0.0, 0.1, 0.1]])
    found, repairs = clean_velocities(np.arange(4.0), v, s)
    assert found.stamps.tolist() == [0.0, 2.0]
    assert found.stddevs[0, 2] == UNMEASURED
    assert repairs.not_finite == 2


def test_axes_turn_with_the_curved_earth():
    """The local up of gravity, and north towards the pole along the meridian."""
    points = np.array([[0.0, 0, 0], [10_000.0, 0, 0], [3_000.0, -8_000.0, 20.0]])
    axes = FRAME.axes_at(points)
    gravity = FRAME.gravity_at(points)
    np.testing.assert_allclose(axes[:, :, 2], -gravity / np.linalg.norm(gravity, axis=1)[:, None], atol=1e-12)
    lat, lon, alt = FRAME.to_geodetic(points)
    north = FRAME.to_map(lat + 1e-5, lon, alt) - points
    np.testing.assert_allclose(axes[:, :, 1], north / np.linalg.norm(north, axis=1)[:, None], atol=1e-6)
    np.testing.assert_allclose(axes[0], np.eye(3), atol=1e-12)
