"""Mounting, slip, and whether it is a vehicle at all: found in exact motion, and in solutions of noisy drives."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation

from factor_graphs.accuracy import errors
from factor_graphs.geodesy import LocalFrame
from factor_graphs.measurements import ImuNoise
from factor_graphs.relative_poses import RelativePoses
from factor_graphs.rigid_motion import FreeMotion, Mounted, RigidMotion, drone, hand_held
from factor_graphs.settings import SmootherSettings
from factor_graphs.simulation import Motion, follow, random_drive
from factor_graphs.slip import LEAST_SLIP, Slip, explain
from factor_graphs.smoothing import heading_stddevs, smooth
from factor_graphs.vehicle import BodyMotion

FRAME = LocalFrame(49.0, 8.4, 115.0)
LEVER = np.array([0.5, 0.3, 1.0])
YAW_PITCH_DEG, AHEAD_M = np.array([2.0, 1.0]), 1.2
NO_GROWTH = np.array([1.0, 0.0, 0.0])


def mounted(seconds: float, rng: np.random.Generator) -> Mounted:
    return on_axle(random_drive(seconds, rng))


def on_axle(vehicle: RigidMotion) -> Mounted:
    T_vehicle_imu = np.eye(4)
    T_vehicle_imu[:3, :3] = Rotation.from_euler("ZYX", [*YAW_PITCH_DEG, 0.0], degrees=True).as_matrix()
    T_vehicle_imu[0, 3] = AHEAD_M
    return Mounted(vehicle, T_vehicle_imu)


def shunting(seconds: float, rng: np.random.Generator) -> Motion:
    """Forward along a winding road, back along half of it, and forward again, at up to 8 m/s."""
    t = np.linspace(0.0, seconds, 13)
    speeds = np.array([0.0, 8, 8, 8, 0, 0, -5, -5, -5, 0, 0, 8, 8])
    length = 8.0 * seconds
    way = np.linspace(0.0, length, int(length / 20))
    return follow(np.column_stack([way, 15 * np.sin(way / 30), 0 * way]), t, speeds, suspension_deg=0.3)


def skidding(seconds: float, rng: np.random.Generator) -> FreeMotion:
    """A random drive whose tail breaks out by 12° for a second or two, four times."""
    motion = random_drive(seconds, rng)
    t = np.arange(0.0, motion.end, 0.05)
    T, fast = motion.poses(t), np.linalg.norm(motion.velocities(t), axis=1) > 5.0
    euler = np.unwrap(Rotation.from_matrix(T[:, :3, :3]).as_euler("ZYX"), axis=0)
    for moment in rng.choice(t[fast & (t > 20.0) & (t < seconds - 20.0)], 4):
        euler[:, 0] += np.radians(12.0) * np.exp(-0.5 * ((t - moment) / 1.2) ** 2)
    return FreeMotion(make_interp_spline(t, T[:, :3, 3], k=5), make_interp_spline(t, euler, k=5))


def seen(motion: RigidMotion, stamps: np.ndarray) -> BodyMotion:
    R_imu_map = np.swapaxes(motion.poses(stamps)[:, :3, :3], 1, 2)
    velocity = np.einsum("kij,kj->ki", R_imu_map, motion.velocities(stamps))
    return BodyMotion(R_imu_map, velocity, motion.turn_rates(stamps), np.gradient(stamps))


def gauss_markov(k: int, keep: float, rng: np.random.Generator) -> np.ndarray:
    values = rng.standard_normal(k)
    for i in range(1, k):
        values[i] = keep * values[i - 1] + np.sqrt(1 - keep**2) * values[i]
    return values


def test_an_axle_that_does_not_slide_does_not_forward_or_backward_wherever_the_imu_sits():
    level = shunting(200.0, np.random.default_rng(0))
    motion = seen(on_axle(Motion(level.path, level.speed)), np.arange(1.0, 199.0, 0.5))
    assert motion.velocity[:, 0].min() < -4.0
    yaw, pitch = np.radians(YAW_PITCH_DEG)
    mounting = np.array([-np.tan(yaw) / np.cos(pitch), np.tan(pitch), AHEAD_M / np.cos(yaw), 0.0, 0.0])
    sliding = motion.sliding(mounting)
    assert np.abs(motion.velocity[:, 1]).max() > 0.2
    np.testing.assert_allclose(sliding, 0.0, atol=2e-3)


def lasting(slip, ahead, spacing):
    """By definition: the mean slope of every 20 s is taken away, then the variance of the means of 10 s is compared."""
    stamps = np.arange(len(slip)) * spacing
    left = slip.copy()
    for window in np.unique(stamps // 20.0):
        its = stamps // 20.0 == window
        left[its] -= (left[its] @ ahead[its]) / (ahead[its] @ ahead[its]) * ahead[its]
    each = left[:: max(round(1.0 / spacing), 1)]
    means = each[: len(each) // 10 * 10].reshape(-1, 10).mean(axis=1)
    return 10.0 * np.mean(means**2) / np.mean(left**2)


@pytest.mark.parametrize("skidding", [0.0, 0.05])
def test_slip_is_found_beside_skids_and_drift_with_its_size_and_its_duration(skidding):
    rng, k, spacing = np.random.default_rng(1), 3000, 0.5
    ahead = rng.uniform(5.0, 15.0, k)
    slip = 0.1 * gauss_markov(k, np.exp(-spacing / 1.0), rng)
    drift = 0.05 * np.sin(2 * np.pi * np.arange(k) * spacing / 300) * ahead
    pushed = np.where(rng.random(k) < skidding, 3.0, 0.0)
    by, grows_with = ahead[:, None], np.column_stack([np.ones(k), ahead**2, np.zeros(k)])
    y = 0.03 * ahead + slip + drift + pushed
    (slope,), found, skids = explain(y, by, np.array([0.2]), ahead, grows_with, np.full(k, spacing))
    assert slope == pytest.approx(0.03, abs=0.005)
    assert np.all(skids[pushed > 0] > 2.0)
    assert np.mean(skids[pushed == 0] == 0) > 0.97
    assert found.typical == pytest.approx(0.1, rel=0.3)
    assert found.lasting_s == pytest.approx(
        lasting(slip + drift, ahead, spacing), rel=0.5 if skidding else 0.25
    )


def test_slip_that_swings_to_and_fro_tells_more_than_slip_that_stays():
    """Oracle: sampled once a second, the sum of all autocovariances of e(t) - 0.8 e(t-1) is 0.2² of e's variance."""
    rng, k = np.random.default_rng(3), 6000
    e, ahead = rng.standard_normal(k + 1), rng.uniform(5.0, 15.0, k)
    grows_with = np.tile(NO_GROWTH, (k, 1))
    found = {}
    for name, y in (("swings", e[1:] - 0.8 * e[:-1]), ("stays", gauss_markov(k, np.exp(-0.25), rng))):
        y = 0.1 * y / np.std(y)
        found[name] = explain(y, ahead[:, None], np.array([0.2]), ahead, grows_with, np.ones(k))[1]
        assert found[name].lasting_s == pytest.approx(lasting(y, ahead, 1.0), rel=0.2)
    assert found["swings"].lasting_s < 0.3  # 0.2² / (1 + 0.8²), and what blocks of ten seconds add
    assert found["stays"].lasting_s > 2.0
    rows = {name: slip.stddevs(grows_with[:1], np.ones(1)) for name, slip in found.items()}
    assert rows["swings"] < 0.1 < rows["stays"]


def test_slip_that_grows_is_small_where_it_is_slow():
    rng, k = np.random.default_rng(2), 4000
    ahead = rng.uniform(2.0, 20.0, k)
    grows_with = np.column_stack([np.ones(k), ahead**2, np.zeros(k)])
    y = 0.01 * ahead * rng.standard_normal(k)
    _, slip, _ = explain(y, ahead[:, None], np.array([0.2]), ahead, grows_with, np.ones(k))
    slow, fast = np.array([[1.0, 0.0, 0.0], [1.0, 400.0, 0.0]]) @ slip.parts
    assert np.sqrt(fast) == pytest.approx(0.2, rel=0.15)
    assert np.sqrt(slow) < 2 * LEAST_SLIP


def test_a_second_tells_the_same_however_many_keyframes_it_has():
    slip = Slip(np.array([0.01, 0.0, 0.0]), 1.0, 0.1)
    information = {}
    for k in (2, 10, 20):
        stddevs = slip.stddevs(np.tile(NO_GROWTH, (k, 1)), np.full(k, 1 / k))
        information[k] = np.sum(stddevs**-2)
    assert information[2] == pytest.approx(information[10]) == pytest.approx(information[20])
    assert slip.stddevs(NO_GROWTH[None], np.array([5.0])) == pytest.approx(0.1)


@pytest.mark.integration
def test_the_mounting_is_found_as_well_as_it_says(simulate):
    for seed in (60, 61):
        drive = simulate(seed, seconds=300.0, noise=ImuNoise(), moves=mounted)
        vehicle = smooth(drive.imu, drive.fixes, FRAME, None, LEVER).vehicle
        assert vehicle.held
        assert not vehicle.doubt
        off = vehicle.yaw_pitch_deg - YAW_PITCH_DEG
        assert np.abs(off).max() < 0.1
        assert np.all(np.abs(off) < 4 * np.degrees(vehicle.mounting_stddevs[:2]))
        assert vehicle.mounting[2] == pytest.approx(AHEAD_M, abs=4 * vehicle.mounting_stddevs[2])
        assert vehicle.mounting_stddevs[2] < 0.2


@pytest.mark.integration
@pytest.mark.parametrize("moves", [hand_held, pytest.param(drone, marks=pytest.mark.slow)])
def test_what_is_no_vehicle_is_left_alone_and_told_why(simulate, moves):
    drive = simulate(70, seconds=150.0, noise=ImuNoise(), moves=moves)
    found, without = (
        smooth(drive.imu, drive.fixes, FRAME, SmootherSettings(vehicle_constraint=v), LEVER)
        for v in ("auto", "off")
    )
    assert not found.vehicle.held
    assert found.vehicle.verdict.startswith("vehicle constraint off: ")
    assert without.vehicle is None
    np.testing.assert_allclose(found.trajectory.positions, without.trajectory.positions)


@pytest.mark.integration
def test_a_vehicle_that_reverses_keeps_its_heading(simulate):
    drive = simulate(80, seconds=240.0, noise=ImuNoise(), moves=shunting)
    solution = smooth(drive.imu, drive.fixes, FRAME, None, LEVER)
    assert solution.vehicle.held
    e = errors(solution.keyframes, drive.motion.trajectory(solution.keyframes.stamps))
    assert np.degrees(np.abs(e.rotation[:, 2])).max() < 0.5


@pytest.mark.slow
@pytest.mark.integration
def test_a_skid_does_not_turn_the_heading(simulate):
    off, found = [], []
    for seed in (100, 101, 102):
        drive = simulate(seed, seconds=200.0, noise=ImuNoise(), moves=skidding)
        truth = drive.motion.trajectory
        for wanted, heading in (("off", off), ("auto", found)):
            s = smooth(drive.imu, drive.fixes, FRAME, SmootherSettings(vehicle_constraint=wanted), LEVER)
            heading.append(errors(s.keyframes, truth(s.keyframes.stamps)).heading_rms_deg)
        assert s.vehicle.held
        assert np.abs(s.vehicle.skids[:, 0]).max() > 1.0
    assert np.mean(found) < np.mean(off)


@pytest.mark.integration
def test_it_can_be_asked_for_where_nothing_shows_it(simulate):
    drive = simulate(90, seconds=25.0, noise=ImuNoise())
    auto, asked = (
        smooth(drive.imu, drive.fixes, FRAME, SmootherSettings(vehicle_constraint=v), LEVER)
        for v in ("auto", "on")
    )
    assert not auto.vehicle.held
    assert asked.vehicle.held
    assert "only" in asked.vehicle.doubt
    heading = [np.mean(s.keyframes.covariances[:, 2, 2]) for s in (auto, asked)]
    assert heading[1] < heading[0]


@pytest.mark.integration
def test_relative_poses_take_the_place_of_the_constraint(simulate):
    drive = simulate(60, seconds=120.0, noise=ImuNoise())
    stamps = np.arange(1.0, 119.0, 0.5)
    T = drive.motion.poses(stamps)
    bound = RelativePoses(
        np.column_stack([stamps[:-1], stamps[1:]]),
        np.linalg.inv(T[:-1]) @ T[1:],
        np.tile(1e-4 * np.eye(6), (len(T) - 1, 1, 1)),
    )
    held, alone, asked = (
        smooth(
            drive.imu,
            drive.fixes,
            FRAME,
            SmootherSettings(vehicle_constraint=wanted),
            LEVER,
            relative_poses=poses,
        ).vehicle
        for poses, wanted in ((bound, "auto"), (bound[stamps[:-1] < 50.0], "auto"), (bound, "on"))
    )
    assert held is None
    assert alone.held
    assert asked.held


def test_an_imu_on_a_roof_is_as_good_as_one_on_the_axle(simulate):
    """1.8 m up, on a body that sways by a degree."""
    T_axle_imu = np.eye(4)
    T_axle_imu[2, 3] = 1.8

    def on_roof(seconds: float, rng: np.random.Generator) -> Mounted:
        return Mounted(replace(random_drive(seconds, rng), suspension=np.radians(1.0)), T_axle_imu)

    drive = simulate(5, 240.0, ImuNoise(), on_roof, outages=[(100.0, 150.0)])
    vehicle = smooth(drive.imu, drive.fixes, FRAME, None, LEVER).vehicle
    assert vehicle.held
    assert vehicle.mounting[4] == pytest.approx(1.8, abs=max(4 * vehicle.mounting_stddevs[4], 0.05))
    assert vehicle.slip[0].typical < 0.03


@pytest.mark.slow
def test_on_a_roundabout_the_verdict_says_how_little_it_tells_of_the_mounting(simulate):
    """At one speed and one turn rate, yaw and distance to the axle cannot be told apart."""

    def around(seconds: float, rng: np.random.Generator) -> Motion:
        angle = np.arange(0.0, 8.0 * seconds / 15.0 + 1.0, 0.1)
        ring = np.column_stack([15 * np.cos(angle), 15 * np.sin(angle), 0 * angle])
        return follow(ring, [0.0, 2.0, 5.0, seconds], [0.0, 0.0, 8.0, 8.0])

    drive = simulate(62, seconds=100.0, noise=ImuNoise(), moves=around)
    vehicle = smooth(drive.imu, drive.fixes, FRAME, None, LEVER).vehicle
    yaw, its_stddev = re.search(r"mounted (\S+) ± (\S+)° in yaw", vehicle.verdict).groups()
    assert float(its_stddev) > 1.0
    assert abs(float(yaw)) < 3 * float(its_stddev)


def test_a_boat_that_drifts_sideways_all_the_time_is_no_vehicle(simulate):
    """11° off its course in gentle turns: the first solution knows its heading no better, so it shows no slip."""

    def ferry(seconds: float, rng: np.random.Generator) -> FreeMotion:
        t = np.linspace(-30.0, seconds + 30.0, 60)
        course = 2.0 + 0.01 * t + 0.1 * np.sin(t / 20)
        way = 5.0 * (t[1] - t[0]) * np.cumsum(np.column_stack([np.cos(course), np.sin(course)]), axis=0)
        position = np.column_stack([way, 0.3 * np.sin(t)])
        euler = np.column_stack([course + 0.2, 0.02 * np.sin(t / 2), 0.05 * np.sin(t / 1.5)])
        return FreeMotion(make_interp_spline(t, position, k=5), make_interp_spline(t, euler, k=5))

    drive = simulate(6, seconds=300.0, noise=ImuNoise(), moves=ferry)
    found = smooth(drive.imu, drive.fixes, FRAME, None, LEVER)
    assert not found.vehicle.held
    assert "heading is known to" in found.vehicle.verdict
    off = np.degrees(errors(found.keyframes, drive.motion.trajectory(found.keyframes.stamps)).rotation[:, 2])
    assert np.all(np.abs(off) < 3 * np.degrees(heading_stddevs(found.keyframes)))
