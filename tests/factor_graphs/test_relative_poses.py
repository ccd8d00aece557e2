"""Relative poses: what is refused, and what they do to the trajectory, in batch and in the stream."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from factor_graphs.alignment import AttitudePrior
from factor_graphs.doubts import NOTABLE_REJECTION
from factor_graphs.errors import MeasurementError
from factor_graphs.geodesy import LocalFrame
from factor_graphs.measurements import GnssFixes, ImuNoise, ImuSamples
from factor_graphs.relative_poses import NO_RELATIVE_POSES, RelativePoses
from factor_graphs.settings import SmootherSettings
from factor_graphs.simulation import Motion, follow, simulate_gnss
from factor_graphs.smoothing import Solution, smooth
from factor_graphs.streaming import StreamingSmoother

Array = NDArray[np.float64]
FRAME = LocalFrame(49.0, 8.4, 115.0)
LEVER = np.array([0.5, 0.3, 1.0])
STDDEVS = np.repeat([5e-4, 5e-3], 3)


def measured(
    motion: Motion, first: float, last: float, rng: np.random.Generator | None, step: float = 0.2
) -> RelativePoses:
    """Relative poses from step to step, noisy as they say; exact without `rng`."""
    stamps = np.arange(first, last, step)
    pairs = np.column_stack([stamps[:-1], stamps[1:]])
    T = np.linalg.inv(motion.poses(pairs[:, 0])) @ motion.poses(pairs[:, 1])
    noise = np.zeros((len(pairs), 6)) if rng is None else rng.standard_normal((len(pairs), 6)) * STDDEVS
    off = np.tile(np.eye(4), (len(pairs), 1, 1))
    off[:, :3, :3] = Rotation.from_rotvec(noise[:, :3]).as_matrix()
    off[:, :3, 3] = noise[:, 3:]
    return RelativePoses(pairs, T @ off, np.tile(np.diag(STDDEVS**2), (len(pairs), 1, 1)))


def horizontal(solution: Solution, motion: Motion, stamps: Array) -> Array:
    return np.linalg.norm((solution.trajectory.at(stamps) - motion.poses(stamps))[:, :2, 3], axis=1)


def test_an_outage_is_bridged(simulate):
    drive = simulate(31, seconds=100.0, noise=ImuNoise(), outages=[(20.0, 80.0)])
    relative = measured(drive.motion, 0.5, 99.0, np.random.default_rng(0))
    without = smooth(drive.imu, drive.fixes, FRAME, None, LEVER)
    bound = smooth(drive.imu, drive.fixes, FRAME, None, LEVER, relative_poses=relative)
    inside, outside = np.arange(21.0, 79.0), np.array([10.0, 90.0])
    assert horizontal(bound, drive.motion, inside).max() < 1.0
    assert (
        horizontal(bound, drive.motion, inside).mean()
        < 0.5 * horizontal(without, drive.motion, inside).mean()
    )
    assert horizontal(bound, drive.motion, outside).max() < 1.0
    assert bound.relative_weights.shape == (len(relative),)
    assert bound.relative_weights.mean() > 0.9
    assert without.relative_weights.shape == (0,)


def test_covariances_know_of_relative_poses(simulate):
    drive = simulate(32, seconds=60.0, noise=ImuNoise())
    relative = measured(drive.motion, 0.5, 59.0, np.random.default_rng(0))
    bound = smooth(drive.imu, drive.fixes, FRAME, None, LEVER, relative_poses=relative)
    assert 0.8 < bound.chi2_per_dof < 1.3
    stamps = np.arange(5.0, 55.0)
    off = (bound.trajectory.at(stamps) - drive.motion.poses(stamps))[:, :3, 3]
    rows = np.searchsorted(bound.trajectory.stamps, stamps)
    stddevs = bound.trajectory.position_stddevs[rows]
    without = smooth(drive.imu, drive.fixes, FRAME, None, LEVER)
    assert np.all(stddevs.mean(axis=0) < without.trajectory.position_stddevs.mean(axis=0))
    assert (np.abs(off) / stddevs).max() < 5


@pytest.mark.parametrize("late_s", [-0.02, 0.005, 0.02])
def test_fixes_beside_relative_poses_are_carried_to_them_along_the_exact_motion(simulate, late_s):
    drive = simulate(33, seconds=40.0)
    relative = measured(drive.motion, 0.5, 39.0, None)
    stamps = relative.stamps[5::5, 0] + late_s
    fixes = simulate_gnss(drive.motion, stamps, (0.01, 0.01, 0.01), LEVER, None)
    bound = smooth(drive.imu, fixes, FRAME, None, LEVER, relative_poses=relative)
    assert not np.isin(stamps, bound.keyframes.stamps).any()
    off = (bound.trajectory.at(stamps) - drive.motion.poses(stamps))[:, :3, 3]
    assert np.abs(off).max() < 2e-3
    np.testing.assert_allclose(bound.fix_residuals, 0.0, atol=2e-3)
    assert bound.fix_weights.min() == 1.0


def test_a_fix_far_from_relative_poses_has_a_keyframe_of_its_own(simulate):
    drive = simulate(33, seconds=20.0)
    relative = measured(drive.motion, 0.5, 19.0, None)
    stamps = relative.stamps[5::5, 0] + 0.1
    fixes = simulate_gnss(drive.motion, stamps, (0.01, 0.01, 0.01), LEVER, None)
    bound = smooth(drive.imu, fixes, FRAME, None, LEVER, relative_poses=relative)
    distance = np.abs(bound.keyframes.stamps[:, None] - stamps).min(axis=0)
    assert distance.max() < 1e-3


def test_wrong_relative_poses_lose_their_weight(simulate):
    drive = simulate(33, seconds=60.0, noise=ImuNoise())
    right = measured(drive.motion, 0.5, 59.0, np.random.default_rng(0))
    T = right.T_imu_imu.copy()
    wrong = np.arange(20, len(T), 40)
    T[wrong, :3, 3] += [0.8, -0.5, 0.2]
    spoilt = RelativePoses(right.stamps, T, right.covariances)
    stamps = np.arange(5.0, 55.0)
    good = smooth(drive.imu, drive.fixes, FRAME, None, LEVER, relative_poses=right)
    robust = smooth(drive.imu, drive.fixes, FRAME, None, LEVER, relative_poses=spoilt)
    trusting = smooth(
        drive.imu, drive.fixes, FRAME, SmootherSettings(robust=False), LEVER, relative_poses=spoilt
    )
    assert robust.relative_weights[wrong].max() < 0.1
    assert np.delete(robust.relative_weights, wrong).mean() > 0.9
    assert any(f"{len(wrong)} of {len(T)} relative poses rejected" in note for note in robust.notes)
    error, best, worst = (horizontal(s, drive.motion, stamps).mean() for s in (robust, good, trusting))
    assert error < best + 0.05
    assert error < worst


def test_a_single_wrong_relative_pose_is_rejected_without_a_word(simulate):
    """To reject one of many is what a robust loss is for; the test above has one in forty, which is a note."""
    drive = simulate(33, seconds=60.0, noise=ImuNoise())
    right = measured(drive.motion, 0.5, 59.0, np.random.default_rng(0))
    T = right.T_imu_imu.copy()
    T[20, :3, 3] += [0.8, -0.5, 0.2]
    spoilt = RelativePoses(right.stamps, T, right.covariances)
    solution = smooth(drive.imu, drive.fixes, FRAME, None, LEVER, relative_poses=spoilt)
    assert solution.relative_rejected[20]
    assert 0 < solution.relative_rejected.sum() <= NOTABLE_REJECTION * len(T)
    assert not any("relative poses rejected" in note for note in solution.notes)


def test_relative_poses_outside_the_imu_have_no_weight(simulate):
    drive = simulate(34, seconds=30.0, noise=ImuNoise())
    relative = measured(drive.motion, 0.5, 29.0, np.random.default_rng(0))
    late = RelativePoses(relative.stamps + 20.0, relative.T_imu_imu, relative.covariances)
    beyond = late.stamps[:, 1] > drive.imu.stamps[-1]
    solution = smooth(drive.imu, drive.fixes, FRAME, None, LEVER, relative_poses=late[beyond])
    assert solution.relative_weights.tolist() == [0.0] * int(beyond.sum())
    assert solution.relative_rejected.all()


def test_a_short_curved_track_of_drifting_fixes_does_not_turn_the_heading():
    """An inertial unit's track that slips sideways by 20 mrad against its own heading, 5 s long (as seen on KITTI)."""
    x = np.linspace(-15, 75, 30)
    motion = follow(np.column_stack([x, 4e-3 * x**2, np.zeros(30)]), [-1.0, 6.5], [10.7, 10.7])
    stamps = np.arange(0.0, 5.0, 0.1)
    imu = ImuSamples(
        np.arange(-0.1, 5.2, 0.01),
        motion.specific_force(np.arange(-0.1, 5.2, 0.01), FRAME),
        motion.angular_rate(np.arange(-0.1, 5.2, 0.01), FRAME),
    )
    exact = simulate_gnss(motion, stamps, (0.1, 0.1, 0.1))
    T = motion.poses(stamps)
    slip = 0.020 * 10.7 * stamps[:, None] * T[:, :3, 1]
    fixes = GnssFixes(stamps, exact.positions + slip, np.full((50, 3), 0.3))
    relative = measured(motion, 0.05, 5.0, np.random.default_rng(1), step=0.1)
    prior = AttitudePrior(motion.poses([-0.1])[0, :3, :3], np.array([0.005, 0.005, 0.01]))

    def turned(settings: SmootherSettings) -> float:
        solution = smooth(imu, fixes, FRAME, settings, (0, 0, 0), prior, relative)
        off = np.swapaxes(motion.poses(stamps)[:, :3, :3], 1, 2) @ solution.trajectory.at(stamps)[:, :3, :3]
        return float(np.abs(Rotation.from_matrix(off).as_rotvec()[:, 2]).mean())

    assert turned(SmootherSettings()) < 0.006
    assert turned(SmootherSettings()) < 0.5 * turned(SmootherSettings(drift_correlation_time_s=1.0))


def test_a_stream_bridges_an_outage_with_relative_poses(simulate):
    drive = simulate(35, seconds=90.0, noise=ImuNoise(), outages=[(40.0, 70.0)])
    relative = measured(drive.motion, 0.5, 89.0, np.random.default_rng(0))
    early = drive.fixes[drive.fixes.stamps < 30.0]
    bound = relative[relative.stamps[:, 1] < 29.9]
    begin = smooth(upto(drive.imu, 30.0), early, FRAME, None, LEVER, relative_poses=bound)
    errors = {}
    for name, given in (("without", NO_RELATIVE_POSES), ("with", relative)):
        online = StreamingSmoother(begin, FRAME, LEVER)
        for i in np.flatnonzero(drive.fixes.stamps > online.state.stamp):
            fix, now = drive.fixes[i : i + 1], online.state.stamp
            rows = slice(
                max(np.searchsorted(drive.imu.stamps, now) - 1, 0),
                np.searchsorted(drive.imu.stamps, fix.stamps[0]) + 1,
            )
            imu = ImuSamples(
                drive.imu.stamps[rows], drive.imu.specific_force[rows], drive.imu.angular_rate[rows]
            )
            fitting = (given.stamps[:, 1] > now) & (given.stamps[:, 1] <= fix.stamps[0])
            state = online.add(imu, fix, given[fitting])
            if 69.0 < now < 73.0 or 39.0 < now < 41.0:
                off = state.T_map_imu - drive.motion.poses([state.stamp])[0]
                errors.setdefault(name, []).append(np.linalg.norm(off[:2, 3]))
        assert online.restarts == 0
        assert online.unbound <= 1  # the first begins before the stream does
    assert np.mean(errors["with"]) < np.mean(errors["without"])
    assert max(errors["with"]) < 1.5


def test_a_stream_refuses_relative_poses_that_end_elsewhere(simulate):
    drive = simulate(36, seconds=40.0, noise=ImuNoise())
    relative = measured(drive.motion, 0.5, 39.0, None)
    begin = smooth(upto(drive.imu, 30.0), drive.fixes[:29], FRAME, None, LEVER)
    online = StreamingSmoother(begin, FRAME, LEVER)
    with pytest.raises(MeasurementError, match=r"relative poses end at 0\.700"):
        online.add(drive.imu, drive.fixes[32:33], relative[:1])


def upto(imu: ImuSamples, stamp: float) -> ImuSamples:
    n = np.searchsorted(imu.stamps, stamp)
    return ImuSamples(imu.stamps[:n], imu.specific_force[:n], imu.angular_rate[:n])


def some(k: int = 3) -> dict[str, Array]:
    stamps = np.column_stack([np.arange(k) * 1.0, np.arange(k) + 1.0])
    return {
        "stamps": stamps,
        "T_imu_imu": np.tile(np.eye(4), (k, 1, 1)),
        "covariances": np.tile(np.eye(6), (k, 1, 1)),
    }


def test_relative_poses_are_frozen_and_can_be_selected():
    poses = RelativePoses(**some())
    assert len(poses[np.array([True, False, True])]) == 2
    assert len(NO_RELATIVE_POSES) == 0
    with pytest.raises(ValueError, match="read-only"):
        poses.stamps[0, 0] = 1.0


@pytest.mark.parametrize(
    ("field", "value", "what"),
    [
        ("stamps", np.array([[0.0, 1.0], [3.0, 2.0], [4.0, 5.0]]), r"RelativePoses\[1\].*forward in time"),
        ("T_imu_imu", np.tile(2 * np.eye(4), (3, 1, 1)), "no rigid transform"),
        ("T_imu_imu", np.tile(np.diag([1.0, 1.0, -1.0, 1.0]), (3, 1, 1)), "no rigid transform"),
        ("T_imu_imu", np.eye(4)[None], "shape"),
        ("covariances", np.zeros((3, 6, 6)), "not positive definite"),
        ("covariances", np.full((3, 6, 6), np.nan), "all finite"),
    ],
)
def test_what_is_no_relative_pose_is_refused(field: str, value: Array, what: str):
    with pytest.raises(MeasurementError, match=what):
        RelativePoses(**(some() | {field: value}))
