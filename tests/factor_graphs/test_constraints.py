import gtsam
import numpy as np
from gtsam.symbol_shorthand import V, X
from scipy.spatial.transform import Rotation

from factor_graphs.accuracy import errors
from factor_graphs.constraints import body_velocity_factors, standing
from factor_graphs.geodesy import LocalFrame
from factor_graphs.intervals import split
from factor_graphs.measurements import ImuNoise
from factor_graphs.settings import SmootherSettings
from factor_graphs.smoothing import smooth

FRAME = LocalFrame(49.0, 8.4, 115.0)
LEVER = np.array([0.5, 0.3, 1.0])


def test_the_linearised_constraint_agrees_with_differences_of_the_real_one():
    rng = np.random.default_rng(0)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.random(random_state=3).as_matrix(), rng.standard_normal(3)
    v, step = rng.standard_normal(3) * 5, 1e-6
    for axis in (1, 2):
        factor = next(iter(body_velocity_factors(T[None], v[None], axis, 0.1)))
        at = gtsam.Values()
        at.insert(X(0), gtsam.Pose3(T))
        at.insert(V(0), v)
        jacobian, b = factor.linearize(at).jacobian()
        np.testing.assert_allclose(b, -(T[:3, :3].T @ v)[axis] / 0.1)
        numeric = []
        for i in range(9):
            pose, velocity = gtsam.Pose3(T), v.copy()
            if i < 6:
                pose = pose.retract(step * np.eye(6)[i])
            else:
                velocity[i - 6] += step
            numeric.append(
                ((pose.rotation().matrix().T @ velocity)[axis] - (T[:3, :3].T @ v)[axis]) / step / 0.1
            )
        keys = list(factor.keys())
        by_key = (
            np.concatenate([numeric[:6], numeric[6:]])
            if keys == [X(0), V(0)]
            else np.concatenate([numeric[6:], numeric[:6]])
        )
        np.testing.assert_allclose(jacobian[0], by_key, atol=1e-4)


def test_a_vehicle_is_seen_to_stand_only_where_it_stands(simulate):
    for seed in range(3):
        drive = simulate(40 + seed, noise=ImuNoise())
        cut = split(drive.imu, drive.fixes.stamps)
        found = standing(cut, drive.motion.velocities(cut.keyframes))
        speed = drive.motion.speed(cut.keyframes)
        assert not np.any(found & (speed > 0.05))
        assert found.sum() > 0.5 * np.sum(speed == 0)


def test_stops_and_the_lateral_constraint_each_improve_an_outage(simulate):
    gains = {"standing": [], "lateral": []}
    for seed in range(3):
        drive = simulate(50 + seed, noise=ImuNoise(), outages=[(30.0, 80.0)])
        worst = {}
        for name, settings in {
            "plain": SmootherSettings(standing_stddev_mps=None),
            "standing": SmootherSettings(),
            "lateral": SmootherSettings(standing_stddev_mps=None, lateral_stddev_mps=0.1),
        }.items():
            s = smooth(drive.imu, drive.fixes, FRAME, settings, LEVER)
            e = errors(s.keyframes, drive.motion.trajectory(s.keyframes.stamps)).within([(30.0, 80.0)])
            worst[name] = e.horizontal_rms_m
        for name in gains:
            gains[name].append(worst[name] / worst["plain"])
    assert np.mean(gains["standing"]) < 1.0
    assert np.mean(gains["lateral"]) < 0.8
