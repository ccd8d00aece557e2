import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import M, V, X
from scipy.spatial.transform import Rotation

from factor_graphs.accuracy import errors
from factor_graphs.constraints import creeping, non_holonomic_factors, quiet_intervals, resting, standing
from factor_graphs.geodesy import LocalFrame
from factor_graphs.intervals import split
from factor_graphs.measurements import GnssFixes, ImuNoise
from factor_graphs.settings import SmootherSettings
from factor_graphs.simulation import Motion, follow
from factor_graphs.smoothing import smooth
from factor_graphs.vehicle import BodyMotion

FRAME = LocalFrame(49.0, 8.4, 115.0)
LEVER = np.array([0.5, 0.3, 1.0])


def test_the_linearised_constraint_agrees_with_differences_of_the_real_one():
    rng, step, stddevs = np.random.default_rng(0), 1e-6, np.array([[0.1, 0.2]])
    pose, velocity = (
        gtsam.Pose3(gtsam.Rot3(Rotation.random(random_state=3).as_matrix()), rng.standard_normal(3)),
        5 * rng.standard_normal(3),
    )
    mounting, rates = np.array([0.03, -0.02, 1.2, -0.004, 1.8]), np.array([0.1, -0.2, 0.4])

    def sliding(change: np.ndarray) -> tuple[np.ndarray, BodyMotion]:
        R_imu_map = pose.retract(change[:6]).rotation().matrix().T
        motion = BodyMotion(
            R_imu_map[None], (R_imu_map @ (velocity + change[6:9]))[None], rates[None], np.ones(1)
        )
        return (motion.sliding(mounting + change[9:]) / stddevs)[0], motion

    at = gtsam.Values()
    at.insert(X(0), pose)
    at.insert(V(0), velocity)
    at.insert(M(1), mounting)
    off, motion = sliding(np.zeros(14))
    row = next(iter(non_holonomic_factors(at, motion, stddevs)))
    jacobian, b = row.linearize(at).jacobian()
    numeric = np.column_stack([(sliding(step * e)[0] - off) / step for e in np.eye(14)])
    columns = {X(0): numeric[:, :6], V(0): numeric[:, 6:9], M(1): numeric[:, 9:]}
    np.testing.assert_allclose(b, -off)
    np.testing.assert_allclose(jacobian, np.hstack(list(map(columns.get, row.keys()))), atol=1e-3)


def test_a_vehicle_is_seen_to_stand_only_where_it_stands(simulate):
    for seed in range(3):
        drive = simulate(40 + seed, noise=ImuNoise())
        cut = split(drive.imu, drive.fixes.stamps)
        found = standing(quiet_intervals(cut), drive.motion.velocities(cut.keyframes))
        speed = drive.motion.speed(cut.keyframes)
        assert not np.any(found & (speed > 0.05))
        assert found.sum() > 0.5 * np.sum(speed == 0)


def test_stops_and_the_axle_each_improve_an_outage(simulate):
    gains = {"standing": [], "vehicle": []}
    for seed in range(3):
        drive = simulate(50 + seed, noise=ImuNoise(), outages=[(30.0, 80.0)])
        worst = {}
        for name, settings in {
            "plain": SmootherSettings(standing_stddev_mps=None, vehicle_constraint="off"),
            "standing": SmootherSettings(vehicle_constraint="off"),
            "vehicle": SmootherSettings(standing_stddev_mps=None),
        }.items():
            s = smooth(drive.imu, drive.fixes, FRAME, settings, LEVER)
            e = errors(s.keyframes, drive.motion.trajectory(s.keyframes.stamps)).within([(30.0, 80.0)])
            worst[name] = e.horizontal_rms_m
        for name in gains:
            gains[name].append(worst[name] / worst["plain"])
    assert np.mean(gains["standing"]) < 1.0
    assert np.mean(gains["vehicle"]) < 0.8


def stops_for_a_minute(seconds: float, rng: np.random.Generator) -> Motion:
    x = np.linspace(0, 3000, 60)
    way = np.column_stack([x, 60 * np.sin(x / 150), 0 * x])
    return follow(way, [0, 10, 60, 70, 130, 140, 200, 210, 240], [0, 10, 10, 0, 0, 10, 10, 0, 0])


@pytest.mark.slow
def test_a_stop_shows_the_bias_of_the_gyroscope_about_the_vertical(simulate):
    noise = ImuNoise(gyroscope_bias_walk=10 * ImuNoise().gyroscope_bias_walk)
    off: dict[float, list[float]] = {1e-4: [], 100.0: []}
    for seed in range(6):
        drive = simulate(seed, 240.0, noise, stops_for_a_minute, outages=[(70.0, 200.0)])
        for rate, found in off.items():
            settings = SmootherSettings(imu_noise=noise, standing_stddev_radps=rate, vehicle_constraint="off")
            s = smooth(drive.imu, drive.fixes, FRAME, settings, LEVER)
            k = np.searchsorted(s.keyframes.stamps, 130.0)  # the end of the stop
            wrong = (
                s.biases[k, 3:] - drive.biases[np.searchsorted(drive.imu.stamps, s.keyframes.stamps[k]), 3:]
            )
            found.append(abs(wrong[2]))
            assert np.all(np.abs(wrong) < 3.5 * np.sqrt(np.diag(s.state_covariances[k])[12:]))
    assert np.mean(off[1e-4]) < 0.6 * np.mean(off[100.0]), off


def test_what_turns_on_the_spot_is_not_held_in_its_attitude():
    stamps, stands = np.arange(60.0), np.ones(60, dtype=bool)
    stands[25:30] = False
    rates = np.where(stamps < 27, 0.0, np.where((stamps > 40) & (stamps < 45), 0.02, 0.0))
    noise = 1e-3 * np.random.default_rng(5).standard_normal(60)
    R = Rotation.from_euler("z", np.cumsum(rates + noise)[:, None]).as_matrix()
    rests = resting(stands, R, stamps, 1e-3)
    np.testing.assert_array_equal(rests, (stamps < 24)[:-1])
    still = Rotation.from_euler("z", np.cumsum(noise)[:, None]).as_matrix()
    np.testing.assert_array_equal(resting(stands, still, stamps, 1e-3), (stands[1:] & stands[:-1]))
    assert not resting(~stands & False, still, stamps, 1e-3).any()


@pytest.mark.slow
def test_what_creeps_as_quietly_as_it_stands_is_not_held_still(simulate):
    """A boat or a lift: an IMU without vibrations, at 0.2 m/s. Held still, it was metres off, or without a solution."""

    def creep(seconds: float, rng: np.random.Generator) -> Motion:
        return follow(
            np.column_stack([np.linspace(0, 60, 20), np.zeros(20), np.zeros(20)]),
            [0.0, 1.0, seconds], [0.2, 0.2, 0.2],
        )  # fmt: skip

    for seed in range(2):
        drive = simulate(70 + seed, noise=ImuNoise(), moves=creep)
        s = smooth(drive.imu, drive.fixes, FRAME, None, np.zeros(3))
        still = smooth(drive.imu, drive.fixes, FRAME, SmootherSettings(standing_stddev_mps=None), np.zeros(3))
        np.testing.assert_allclose(s.keyframes.positions, still.keyframes.positions, atol=1e-3)


@pytest.mark.parametrize("speed", [0.0, 0.03, 0.2])
def test_only_a_stand_whose_fixes_go_on_surely_creeps(speed):
    rng, stamps = np.random.default_rng(4), np.arange(120.0)
    positions = speed * np.column_stack([stamps, 0 * stamps, 0 * stamps]) + rng.standard_normal((120, 3))
    fixes = GnssFixes(stamps, positions, np.ones((120, 3)))
    slow = np.ones(120, dtype=bool)
    slow[40:45] = False
    found = creeping(slow, fixes, np.arange(120))
    assert np.array_equal(found, slow & (speed > 0.1))
    assert not creeping(np.zeros(120, dtype=bool), fixes, np.arange(120)).any()
