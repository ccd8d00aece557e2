"""Scale, offset, latency and slip of wheels: found in exact motion, and worth having in outages."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, M, V, W, X
from scipy.spatial.transform import Rotation

from factor_graphs.accuracy import errors, nees
from factor_graphs.chi_square import quantile
from factor_graphs.covariances import keyframe_covariances
from factor_graphs.fitting import fit_noise
from factor_graphs.geodesy import LocalFrame
from factor_graphs.held_constraints import constrain
from factor_graphs.measurements import ImuNoise, WheelSpeeds
from factor_graphs.problem import pose_problem
from factor_graphs.rigid_motion import Mounted
from factor_graphs.settings import SmootherSettings
from factor_graphs.simulation import Motion, follow, random_drive, simulate_wheels
from factor_graphs.slip import Slip
from factor_graphs.smoothing import smooth
from factor_graphs.vehicle import BodyMotion
from factor_graphs.wheel_readings import read
from factor_graphs.wheels import Wheels, misfit, wheel_factors

FRAME = LocalFrame(49.0, 8.4, 115.0)
LEVER = np.array([0.5, 0.3, 1.0])
NO_VEHICLE = SmootherSettings(vehicle_constraint="off")
OUTAGES = [(60.0, 90.0), (130.0, 190.0)]
TRUTH = np.array([1.03, 0.1, 0.06, 0.4])
BUS = {"scale": 1.03, "offset_mps": 0.1, "latency_s": 0.06, "stddev_mps": 0.03, "quantum_mps": 0.05}


def mounted(seconds: float, rng: np.random.Generator) -> Mounted:
    """A random drive; the imu looks 2° left and 1° down, 1.2 m ahead of the axle and 0.4 m left of its middle."""
    T_vehicle_imu = np.eye(4)
    T_vehicle_imu[:3, :3] = Rotation.from_euler("ZYX", [2.0, 1.0, 0.0], degrees=True).as_matrix()
    T_vehicle_imu[:2, 3] = 1.2, 0.4
    return Mounted(random_drive(seconds, rng), T_vehicle_imu)


def shunting(seconds: float, rng: np.random.Generator) -> Motion:
    """Forward along a winding road, back along half of it, and forward again, at up to 8 m/s."""
    t = np.linspace(0.0, seconds, 13)
    speeds = np.array([0.0, 8, 8, 8, 0, 0, -5, -5, -5, 0, 0, 8, 8])
    way = np.linspace(0.0, 8.0 * seconds, int(0.4 * seconds))
    return follow(np.column_stack([way, 15 * np.sin(way / 30), 0 * way]), t, speeds, suspension_deg=0.3)


def wheels_of(drive, seed: int, seconds: float, **how: object) -> WheelSpeeds:
    stamps = np.arange(0.02, seconds, 0.05)
    return simulate_wheels(drive.motion, stamps, np.random.default_rng(1000 + seed), **{**BUS, **how})


def inside_outages(solution, drive) -> float:
    reference = drive.motion.trajectory(solution.keyframes.stamps)
    return errors(solution.keyframes, reference).within(OUTAGES).horizontal_rms_m


def test_the_linearised_factor_agrees_with_differences_of_the_real_one():
    rng, step, stddev = np.random.default_rng(0), 1e-6, 0.2
    attitude, velocity = Rotation.random(random_state=3).as_matrix(), np.array([4.0, -6.0, 0.5])
    pose, mounting = (
        gtsam.Pose3(gtsam.Rot3(attitude), rng.standard_normal(3)),
        np.array([0.05, -0.03, 1.2, 0.0, 1.8]),
    )
    stamps = np.arange(0.0, 2.0, 0.05)
    speeds = WheelSpeeds(stamps, 5.0 + 1.5 * stamps)  # a straight line is what the readings hold exactly

    def off(change: np.ndarray) -> tuple[float, BodyMotion, Wheels]:
        R_imu_map = pose.retract(change[:6]).rotation().matrix().T
        in_imu = (R_imu_map @ (velocity + change[6:9]))[None]
        motion = BodyMotion(R_imu_map[None], in_imu, np.array([[0.1, -0.2, 0.3]]), np.ones(1))
        calibration = TRUTH + change[9:]
        ahead = motion.ahead(mounting)
        readings = read(speeds, np.array([1.0]) + calibration[2], ahead)
        noise = Slip(np.array([stddev**2, 0.0, 0.0]), 1.0, stddev)
        left, _ = misfit(ahead, motion.yaw_rate, readings, calibration)
        return float(left[0]) / stddev, motion, Wheels(readings, calibration, noise, np.zeros(1))

    at = gtsam.Values()
    at.insert(X(0), pose)
    at.insert(V(0), velocity)
    at.insert(W(1), TRUTH)
    here, motion, wheels = off(np.zeros(13))
    row = next(iter(wheel_factors(at, motion, mounting, wheels)))
    jacobian, b = row.linearize(at).jacobian()
    numeric = np.array([(off(step * e)[0] - here) / step for e in np.eye(13)])
    columns = {X(0): numeric[:6], V(0): numeric[6:9], W(1): numeric[9:]}
    np.testing.assert_allclose(b, -here)
    np.testing.assert_allclose(jacobian[0], np.concatenate(list(map(columns.get, row.keys()))), atol=1e-3)


@pytest.mark.parametrize("signed", [True, False])
def test_exact_wheels_agree_with_exact_motion_forwards_and_backwards_wherever_the_imu_sits(signed):
    level = shunting(200.0, np.random.default_rng(0))
    T_vehicle_imu = np.eye(4)
    T_vehicle_imu[:3, 3] = 1.2, 0.4, 0.3
    motion, stamps = Mounted(Motion(level.path, level.speed), T_vehicle_imu), np.arange(1.0, 199.0, 0.5)
    in_imu = np.einsum("kij,ki->kj", motion.poses(stamps)[:, :3, :3], motion.velocities(stamps))[:, 0]
    exact = simulate_wheels(
        motion, np.arange(0.0, 200.0, 0.02), scale=1.03, offset_mps=0.1, latency_s=0.06, signed=signed
    )
    readings = read(exact, stamps + 0.06, in_imu)
    off, _ = misfit(in_imu, motion.turn_rates(stamps)[:, 2], readings, TRUTH)
    assert (readings.directions < 0).sum() > 20
    assert readings.rolling.sum() > 200
    moving = readings.rolling & (np.abs(in_imu) > 1.0)
    np.testing.assert_allclose(off[moving], 0.0, atol=5e-3)


def test_a_keyframe_without_samples_on_both_sides_or_beyond_the_log_has_no_reading():
    stamps = np.concatenate([np.arange(0.0, 10.0, 0.05), np.arange(20.0, 30.0, 0.05)])
    wheels = WheelSpeeds(stamps, np.full(len(stamps), 8.0))
    readings = read(wheels, np.array([-1.0, 5.0, 10.05, 15.0, 25.0, 31.0]), np.full(6, 8.0))
    np.testing.assert_array_equal(readings.rolling, [False, True, False, False, True, False])
    sparse = WheelSpeeds(np.arange(0.0, 100.0, 4.0), np.full(25, 8.0))
    assert not read(sparse, np.arange(1.0, 90.0), np.full(89, 8.0)).rolling.any()
    assert not read(WheelSpeeds(np.empty(0), np.empty(0)), np.arange(3.0), np.ones(3)).rolling.any()


@pytest.mark.parametrize("settings", [SmootherSettings(), NO_VEHICLE])
def test_covariances_are_those_of_gtsams_marginals(simulate, settings):
    drive = simulate(3, seconds=120.0, noise=ImuNoise(), moves=mounted)
    problem = pose_problem(drive.imu, drive.fixes, FRAME, settings, LEVER, None)
    fit, _, _, wheels = constrain(*fit_noise(problem), wheels_of(drive, 3, 120.0))
    assert wheels.held
    k = len(problem.intervals.keyframes)
    shared = [key for key in (M(k), W(k)) if fit.values.exists(key)]
    marginals = gtsam.Marginals(fit.graph, fit.values)
    pairs = [
        (ours, marginals.jointMarginalCovariance([X(i), V(i), B(i)]).fullMatrix())
        for i, ours in enumerate(keyframe_covariances(fit.graph, fit.values, k)[0])
    ]
    of_shared = keyframe_covariances(fit.graph, fit.values, k)[1]
    pairs.append((of_shared, marginals.jointMarginalCovariance(shared).fullMatrix()))
    for ours, theirs in pairs:
        stddevs = np.sqrt(theirs.diagonal())
        assert np.abs((ours - theirs) / np.outer(stddevs, stddevs)).max() < 1e-5


@pytest.mark.slow
@pytest.mark.integration
@pytest.mark.parametrize("settings", [SmootherSettings(), pytest.param(NO_VEHICLE, marks=pytest.mark.slow)])
def test_the_calibration_is_found_as_well_as_it_says(simulate, settings):
    for seed in (60, 61, 62):
        drive = simulate(seed, seconds=300.0, noise=ImuNoise(), moves=mounted)
        found = smooth(
            drive.imu, drive.fixes, FRAME, settings, LEVER, wheels=wheels_of(drive, seed, 300.0)
        ).wheels
        assert found.held
        assert found.scale == pytest.approx(1.03, rel=5e-3)
        np.testing.assert_array_less(np.abs(found.calibration - TRUTH), 3 * found.stddevs)
        assert np.all(found.stddevs < [0.005, 0.05, 0.02, 0.1])
        assert found.slip_share < 0.02


@pytest.mark.integration
@pytest.mark.parametrize(
    "slips",
    [
        pytest.param((), marks=pytest.mark.slow),
        ((70.0, 74.0, 0.3), (140.0, 146.0, 0.15), (165.0, 168.0, -1.0)),
    ],
)
def test_outages_are_better_with_wheels_even_where_they_slip(simulate, slips):
    off, squares = {"without": [], "with": []}, []
    for seed in range(3):
        drive = simulate(seed, seconds=240.0, noise=ImuNoise(), moves=mounted, outages=OUTAGES)
        wheels = wheels_of(drive, seed, 240.0, signed=False, slips=slips)
        off["without"].append(inside_outages(smooth(drive.imu, drive.fixes, FRAME, NO_VEHICLE, LEVER), drive))
        s = smooth(drive.imu, drive.fixes, FRAME, NO_VEHICLE, LEVER, wheels=wheels)
        off["with"].append(inside_outages(s, drive))
        truth = drive.motion.trajectory(s.keyframes.stamps)
        R, horizontal = s.keyframes.T_map_imu[:, :3, :3], errors(s.keyframes, truth).position[:, :2]
        P = R @ s.keyframes.covariances[:, 3:, 3:] @ np.swapaxes(R, 1, 2)
        squares.append(nees(horizontal, P[:, :2, :2]))
        assert s.wheels.held
        assert bool(slips) == (s.wheels.slip_share > 0.02)
    assert np.mean(off["with"]) < 0.85 * np.mean(off["without"])
    assert np.mean(np.concatenate(squares) < quantile(0.9, 2)) > 0.8


@pytest.mark.slow
@pytest.mark.integration
def test_the_drift_of_a_bad_imu_is_not_taken_for_slip(simulate):
    off = {"without": [], "with": []}
    for seed in range(3):
        noise = ImuNoise().scaled(20.0)
        drive = simulate(seed, seconds=240.0, noise=noise, moves=mounted, outages=OUTAGES)
        wheels = wheels_of(drive, seed, 240.0)
        for which, speeds in (("without", None), ("with", wheels)):
            s = smooth(drive.imu, drive.fixes, FRAME, None, LEVER, wheels=speeds)
            off[which].append(inside_outages(s, drive))
        assert s.wheels.held
        assert s.wheels.slip_share < 0.02
    assert np.mean(off["with"]) < 0.7 * np.mean(off["without"])


@pytest.mark.integration
def test_wheels_that_freeze_in_an_outage_are_not_believed(simulate):
    for seed in range(2):
        drive = simulate(seed, seconds=240.0, noise=ImuNoise(), moves=mounted, outages=OUTAGES)
        right = wheels_of(drive, seed, 240.0)
        frozen = (right.stamps > 128.0) & (right.stamps < 192.0)
        stuck = np.where(frozen, right.speeds[np.argmax(frozen)], right.speeds)
        without, with_stuck = (
            inside_outages(smooth(drive.imu, drive.fixes, FRAME, None, LEVER, wheels=wheels), drive)
            for wheels in (None, WheelSpeeds(right.stamps, stuck))
        )
        assert with_stuck < 1.2 * without


@pytest.mark.integration
def test_a_vehicle_that_reverses_is_no_trap_for_speeds_without_sign(simulate):
    off = {}
    for signed in (True, False):
        drive = simulate(80, seconds=240.0, noise=ImuNoise(), moves=shunting, outages=OUTAGES)
        wheels = wheels_of(drive, 80, 240.0, signed=signed, offset_mps=0.0)
        s = smooth(drive.imu, drive.fixes, FRAME, None, LEVER, wheels=wheels)
        assert s.wheels.held
        assert s.wheels.scale == pytest.approx(1.03, rel=5e-3)
        backwards = drive.motion.speed(s.keyframes.stamps) < -1.0
        assert np.mean(s.wheels.readings.directions[backwards] == -1.0) > 0.9
        off[signed] = inside_outages(s, drive)
    without = inside_outages(smooth(drive.imu, drive.fixes, FRAME, None, LEVER), drive)
    assert max(off.values()) < 1.05 * without


@pytest.mark.integration
def test_wheels_that_do_not_fit_are_left_alone_and_told_why(simulate):
    drive = simulate(60, seconds=150.0, noise=ImuNoise(), moves=mounted)
    right = wheels_of(drive, 60, 150.0)
    spoilt = {
        "km/h": WheelSpeeds(right.stamps, 3.6 * right.speeds),
        "mph": WheelSpeeds(right.stamps, right.speeds / 0.44704),
        "backwards": WheelSpeeds(right.stamps, -right.speeds),
        "clock": WheelSpeeds(right.stamps + 20.0, right.speeds),
        "0 s": WheelSpeeds(right.stamps + 1e5, right.speeds),
        "for 0 s": WheelSpeeds(right.stamps, 0.0 * right.speeds),
    }
    without = smooth(drive.imu, drive.fixes, FRAME, None, LEVER)
    assert without.wheels is None
    for word, speeds in spoilt.items():
        s = smooth(drive.imu, drive.fixes, FRAME, None, LEVER, wheels=speeds)
        assert not s.wheels.held
        assert s.wheels.verdict.startswith("wheel speed off: ")
        assert word in s.wheels.verdict
        assert "\n" not in s.wheels.verdict
        np.testing.assert_array_equal(s.trajectory.T_map_imu, without.trajectory.T_map_imu)
        np.testing.assert_array_equal(s.state_covariances, without.state_covariances)


@pytest.mark.integration
def test_settings_overrule_the_evidence(simulate):
    drive = simulate(60, seconds=150.0, noise=ImuNoise(), moves=mounted)
    right = wheels_of(drive, 60, 150.0)
    asked, refused = (
        smooth(
            drive.imu, drive.fixes, FRAME, SmootherSettings(wheel_speed=wanted), LEVER,
            wheels=WheelSpeeds(right.stamps, 3.6 * right.speeds),
        )
        for wanted in ("on", "off")
    )  # fmt: skip
    assert asked.wheels.held
    assert asked.wheels.scale == pytest.approx(1.03 / 3.6, rel=5e-3)
    assert "km/h" in asked.wheels.verdict
    assert refused.wheels is None


@pytest.mark.integration
def test_wheels_that_are_partly_missing_help_where_they_are(simulate):
    drive = simulate(5, seconds=240.0, noise=ImuNoise(), moves=mounted, outages=OUTAGES)
    whole = wheels_of(drive, 5, 240.0)
    there = (whole.stamps < 50.0) | (whole.stamps > 125.0)
    part = WheelSpeeds(whole.stamps[there], whole.speeds[there])
    without, with_part = (
        smooth(drive.imu, drive.fixes, FRAME, NO_VEHICLE, LEVER, wheels=w) for w in (None, part)
    )
    assert with_part.wheels.held
    stddevs = [s.keyframes.covariances[:, 3, 3] ** 0.5 for s in (without, with_part)]
    stamps = without.keyframes.stamps
    gone, said = (stamps > 70.0) & (stamps < 80.0), (stamps > 150.0) & (stamps < 170.0)
    assert np.all(stddevs[1][said] < 0.8 * stddevs[0][said])
    assert np.all(stddevs[1][gone] < 1.2 * stddevs[0][gone])


@pytest.mark.integration
def test_the_wheels_of_another_vehicle_are_not_believed(simulate):
    drive, other = (simulate(seed, seconds=150.0, noise=ImuNoise(), moves=mounted) for seed in (70, 71))
    wheels = smooth(drive.imu, drive.fixes, FRAME, None, LEVER, wheels=wheels_of(other, 70, 150.0)).wheels
    assert not wheels.held
    assert "differ from the speed" in wheels.verdict


def test_wheels_that_fit_only_until_they_are_held_are_left_out(simulate):
    """A message that freezes for the last third of the drive; then all is as without wheels."""
    outages = [(60.0, 90.0), (150.0, 190.0)]
    drive = simulate(1, seconds=240.0, noise=ImuNoise(), outages=outages)
    wheels = wheels_of(drive, 1, 240.0, scale=1.0, offset_mps=0.0, latency_s=0.0)
    frozen = wheels.speeds[np.searchsorted(wheels.stamps, 155.0)]
    wheels = WheelSpeeds(wheels.stamps, np.where(wheels.stamps > 155.0, frozen, wheels.speeds))
    with_wheels = smooth(drive.imu, drive.fixes, FRAME, None, LEVER, wheels=wheels)
    without = smooth(drive.imu, drive.fixes, FRAME, None, LEVER)
    assert with_wheels.wheels.verdict.startswith("wheel speed off: they differ from the speed")
    np.testing.assert_array_equal(with_wheels.trajectory.T_map_imu, without.trajectory.T_map_imu)
