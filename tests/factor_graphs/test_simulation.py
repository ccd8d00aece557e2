import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from factor_graphs.errors import MeasurementError
from factor_graphs.geodesy import LocalFrame
from factor_graphs.measurements import ImuNoise
from factor_graphs.rigid_motion import Mounted, RigidMotion, drone, hand_held
from factor_graphs.simulation import (
    Motion,
    follow,
    random_drive,
    simulate_biases,
    simulate_gnss,
    simulate_imu,
)

FRAME = LocalFrame(49.0, 8.4, 115.0)
STEP = 1e-4


@pytest.fixture(scope="module")
def motion() -> Motion:
    return random_drive(120.0, np.random.default_rng(1))


def mounted(seconds: float, rng: np.random.Generator) -> Mounted:
    T_body_imu = np.eye(4)
    T_body_imu[:3, :3] = Rotation.from_euler("ZYX", [20.0, 10.0, 5.0], degrees=True).as_matrix()
    T_body_imu[:3, 3] = 1.2, -0.4, 0.7
    return Mounted(random_drive(seconds, rng), T_body_imu)


def there_and_back(seconds: float, rng: np.random.Generator) -> Motion:
    waypoints = np.column_stack([np.linspace(0, 200, 21), 10 * np.sin(np.linspace(0, 6, 21)), np.zeros(21)])
    return follow(waypoints, [0.0, 30.0, 60.0, 120.0], [0.0, 5.0, -2.0, 0.5], suspension_deg=0.3)


@pytest.fixture(scope="module", params=[random_drive, there_and_back, mounted, hand_held, drone])
def any_motion(request: pytest.FixtureRequest) -> RigidMotion:
    return request.param(120.0, np.random.default_rng(1))


def stamps_of(motion: RigidMotion) -> np.ndarray:
    return np.linspace(motion.start + 1, motion.end - 1, 501) + 0.0123


def test_velocity_is_the_derivative_of_position(any_motion):
    t = stamps_of(any_motion)
    difference = (any_motion.poses(t + STEP) - any_motion.poses(t - STEP))[:, :3, 3] / (2 * STEP)
    np.testing.assert_allclose(any_motion.velocities(t), difference, atol=1e-6)


def test_specific_force_is_acceleration_against_gravity_in_the_turning_frame(any_motion):
    t = stamps_of(any_motion)
    acceleration = (any_motion.velocities(t + STEP) - any_motion.velocities(t - STEP)) / (2 * STEP)
    coriolis = 2 * np.cross(FRAME.earth_rate, any_motion.velocities(t))
    gravity = FRAME.gravity_at(any_motion.poses(t)[:, :3, 3])
    in_map = np.einsum("nij,nj->ni", any_motion.poses(t)[:, :3, :3], any_motion.specific_force(t, FRAME))
    np.testing.assert_allclose(in_map, acceleration + coriolis - gravity, atol=1e-3)


def test_angular_rate_is_the_turn_of_the_body_and_of_the_earth(any_motion):
    t = stamps_of(any_motion)
    before, after = (any_motion.poses(t + d)[:, :3, :3] for d in (-STEP, STEP))
    turn = Rotation.from_matrix(np.swapaxes(before, 1, 2) @ after).as_rotvec() / (2 * STEP)
    earth = np.swapaxes(any_motion.poses(t)[:, :3, :3], 1, 2) @ FRAME.earth_rate
    np.testing.assert_allclose(any_motion.angular_rate(t, FRAME), turn + earth, atol=1e-6)


def test_the_vehicle_drives_forward_at_the_speed_asked_for_and_stands_when_it_stands():
    waypoints = np.column_stack([np.linspace(0, 200, 21), 10 * np.sin(np.linspace(0, 6, 21)), np.zeros(21)])
    motion = follow(waypoints, [0.0, 5.0, 10.0, 15.0, 20.0], [0.0, 10.0, 0.0, 0.0, 8.0])
    t = np.linspace(0.0, 20.0, 401)
    speed = np.linalg.norm(motion.velocities(t), axis=1)
    np.testing.assert_allclose(speed, motion.speed(t), atol=2e-3)
    in_imu = np.einsum("nji,nj->ni", motion.poses(t)[:, :3, :3], motion.velocities(t))
    np.testing.assert_allclose(in_imu[:, 1:], 0.0, atol=1e-9)
    stop = (t > 10.0) & (t < 15.0)
    assert np.all(motion.velocities(t[stop]) == 0)
    np.testing.assert_allclose(
        motion.poses(t[stop]), np.broadcast_to(motion.poses([10.0]), (stop.sum(), 4, 4)), atol=1e-12
    )
    still = LocalFrame(49.0, 8.4, 0.0)
    np.testing.assert_allclose(
        np.linalg.norm(motion.specific_force(t[stop], still), axis=1), still.gravity, atol=1e-9
    )


def test_the_path_goes_through_its_waypoints_and_climbs_nose_up():
    waypoints = np.column_stack([np.linspace(0, 100, 11), np.zeros(11), 5 * np.sin(np.linspace(0, 3, 11))])
    motion = follow(waypoints, [0.0, 10.0], [9.0, 9.0])
    path = motion.path(np.linspace(0, motion.path.t[-1], 5001))
    distance = np.min(np.linalg.norm(path[None] - waypoints[:, None], axis=2), axis=1)
    assert distance.max() < 0.02
    forward = motion.poses([1.0])[0, :3, 0]
    assert forward[2] > 0.05


@pytest.mark.parametrize("seed", range(5))
def test_a_random_drive_is_drivable_and_stops(seed):
    motion = random_drive(300.0, np.random.default_rng(seed))
    t = np.arange(0.0, 300.0, 0.1)
    assert motion.end >= 300.0
    assert np.linalg.norm(motion.accelerations(t), axis=1).max() < 6.0
    assert np.mean(motion.speed(t) == 0) > 0.02
    assert np.linalg.norm(motion.poses(t)[-1, :3, 3]) > 10.0


def test_speeds_that_leave_the_path_and_impossible_waypoints_are_refused():
    line = np.column_stack([np.arange(0.0, 60.0, 10.0), np.zeros(6), np.zeros(6)])
    with pytest.raises(MeasurementError, match=r"drive 100\.0 m but the path is 50\.0 m"):
        follow(line, [0.0, 10.0], [10.0, 10.0])
    with pytest.raises(MeasurementError, match=r"back 50\.0 m beyond the first"):
        follow(line, [0.0, 10.0], [-5.0, -5.0])
    with pytest.raises(MeasurementError, match="n >= 6"):
        follow(line[:4], [0.0, 1.0], [1.0, 1.0])
    with pytest.raises(MeasurementError, match="waypoint 3 repeats"):
        follow(line[[0, 1, 2, 2, 3, 4, 5]], [0.0, 1.0], [1.0, 1.0])
    with pytest.raises(MeasurementError, match="leave the motion"):
        follow(line, [0.0, 1.0], [1.0, 1.0]).poses([2.0])


def test_noise_has_the_densities_it_was_given(motion):
    noise = ImuNoise(accelerometer_bias_stddev=1e-9, gyroscope_bias_stddev=1e-9)
    quiet = noise.model_copy(update={"accelerometer_bias_walk": 1e-12, "gyroscope_bias_walk": 1e-12})
    t = np.arange(0.0, 100.0, 0.005)
    off = simulate_imu(motion, t, FRAME, quiet, np.random.default_rng(0))
    exact = simulate_imu(motion, t, FRAME)
    for shown, true, density in (
        (off.specific_force, exact.specific_force, noise.accelerometer_noise_density),
        (off.angular_rate, exact.angular_rate, noise.gyroscope_noise_density),
    ):
        assert np.std(shown - true) * np.sqrt(0.005) == pytest.approx(density, rel=0.02)


def test_biases_walk_as_fast_as_they_should():
    noise = ImuNoise()
    ends = np.array(
        [simulate_biases([0.0, 50.0, 100.0], noise, np.random.default_rng(i)) for i in range(600)]
    )
    assert np.std(ends[:, 0, :3]) == pytest.approx(noise.accelerometer_bias_stddev, rel=0.06)
    assert np.std(ends[:, 2, :3] - ends[:, 0, :3]) == pytest.approx(
        10 * noise.accelerometer_bias_walk, rel=0.06
    )
    assert np.std(ends[:, 2, 3:] - ends[:, 0, 3:]) == pytest.approx(10 * noise.gyroscope_bias_walk, rel=0.06)


def test_fixes_are_of_the_antenna_late_by_the_offset_and_absent_in_outages(motion):
    t = np.arange(0.0, 100.0)
    fixes = simulate_gnss(
        motion, t, (1.0, 1.0, 2.0), (0.5, 0.3, 1.0), time_offset_s=0.2, outages=[(10.0, 19.5)]
    )
    assert len(fixes) == 90
    T = motion.poses(fixes.stamps + 0.2)
    np.testing.assert_allclose(fixes.positions, T[:, :3, 3] + T[:, :3, :3] @ [0.5, 0.3, 1.0], atol=1e-12)
    np.testing.assert_array_equal(fixes.stddevs[0], [1.0, 1.0, 2.0])


def test_outliers_are_as_many_and_as_far_as_asked_and_the_slow_error_is_slow(motion):
    t = np.linspace(0.0, 119.0, 4000)
    truth = simulate_gnss(motion, t, 1e-6)
    fixes = simulate_gnss(motion, t, 1e-6, rng=np.random.default_rng(2), outlier_share=0.3)
    off = np.linalg.norm(fixes.positions - truth.positions, axis=1)
    assert np.mean(off > 1.0) == pytest.approx(0.3, abs=0.03)
    assert off.max() < 20.0
    assert off[off > 1.0].min() > 5.0
    slow = simulate_gnss(
        motion, t, 1e-6, rng=np.random.default_rng(3), correlated_stddevs=(2, 2, 2), correlation_time_s=5
    )
    drift = (slow.positions - truth.positions)[:, 0]
    lag = int(5 / (t[1] - t[0]))
    assert np.corrcoef(drift[:-lag], drift[lag:])[0, 1] == pytest.approx(np.exp(-1), abs=0.2)
    assert np.corrcoef(drift[:-1], drift[1:])[0, 1] > 0.98


def test_the_same_seed_gives_the_same_drive_and_noise_needs_a_generator(motion):
    again = random_drive(120.0, np.random.default_rng(1))
    t = stamps_of(motion)
    np.testing.assert_array_equal(again.poses(t), motion.poses(t))
    with pytest.raises(MeasurementError, match="give rng"):
        simulate_imu(motion, t, FRAME, ImuNoise())
