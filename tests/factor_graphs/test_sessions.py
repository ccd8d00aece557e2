from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from factor_graphs.accuracy import errors
from factor_graphs.chi_square import quantile
from factor_graphs.condensing import CondensedDrive
from factor_graphs.covariances import SIZE
from factor_graphs.geodesy import LocalFrame
from factor_graphs.measurements import GnssFixes, ImuNoise
from factor_graphs.relative_poses import RelativePoses
from factor_graphs.rigid_motion import RigidMotion
from factor_graphs.sessions import AnchorPairs, bind
from factor_graphs.simulation import random_drive, simulate_biases, simulate_gnss, simulate_imu
from factor_graphs.smoothing import Solution, smooth
from factor_graphs.trajectory import Trajectory

FRAME = LocalFrame(49.0, 8.4, 115.0)
LEVER = np.array([0.5, 0.3, 1.0])
SECONDS, DRIFT_M = 60.0, 0.35
ODOMETRY = np.repeat([5e-4, 5e-3], 3)
MATCH = np.repeat([5e-4, 5e-3], 3)


def exp(tangent):
    T = np.tile(np.eye(4), (len(tangent), 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(tangent[:, :3]).as_matrix()
    T[:, :3, 3] = tangent[:, 3:]
    return T


def relative_poses(motion: RigidMotion, stamps: np.ndarray, rng: np.random.Generator) -> RelativePoses:
    """Odometry of ten sweeps a second, each bound to the one before and to the last of ten."""
    earlier = np.concatenate([np.arange(len(stamps) - 1), np.arange(len(stamps) - 1) // 10 * 10])
    later = np.concatenate([np.arange(1, len(stamps)), np.arange(1, len(stamps))])
    pairs = np.unique(np.column_stack([earlier, later]), axis=0)
    T = motion.poses(stamps)
    between = (
        np.linalg.inv(T[pairs[:, 0]]) @ T[pairs[:, 1]] @ exp(ODOMETRY * rng.standard_normal((len(pairs), 6)))
    )
    return RelativePoses(stamps[pairs], between, np.tile(np.diag(ODOMETRY**2), (len(pairs), 1, 1)))


def located(motion: RigidMotion, seed: int, more: RelativePoses | None = None) -> Solution:
    """A drive as a navigation unit and a LiDAR see it: ten fixes a second, which drift together."""
    rng = np.random.default_rng(seed)
    stamps, noise = np.arange(0.0, SECONDS, 0.01), ImuNoise()
    imu = simulate_imu(motion, stamps, FRAME, noise, rng, biases=simulate_biases(stamps, noise, rng))
    fixes = simulate_gnss(
        motion, np.arange(0.02, SECONDS - 0.1, 0.1), (0.002,) * 3, LEVER, rng,
        correlated_stddevs=(DRIFT_M,) * 3, correlation_time_s=120.0,
    )  # fmt: skip
    fixes = GnssFixes(fixes.stamps, fixes.positions, np.full_like(fixes.positions, DRIFT_M))
    relative = relative_poses(motion, np.arange(0.0, SECONDS - 0.1, 0.1), rng)
    return smooth(
        imu, fixes, FRAME, None, LEVER, None, relative if more is None else relative + more, condensed=True
    )


@pytest.fixture(scope="module")
def motion() -> RigidMotion:
    return random_drive(SECONDS, np.random.default_rng(5))


@pytest.fixture(scope="module")
def sessions(motion: RigidMotion) -> list[Solution]:
    """Three drives along one track."""
    return [located(motion, seed) for seed in (11, 12, 13)]


def condensed(solution: Solution) -> CondensedDrive:
    assert solution.condensed is not None
    return solution.condensed


def pairs_of(motion, drives, rng, every=8) -> AnchorPairs:
    """What registration says of the same places of the first drive and of each other one."""
    rows = []
    for other in range(1, len(drives)):
        for anchor in range(2, len(drives[other]) - 2, every):
            stamp = drives[other].stamps[anchor]
            first = int(np.abs(drives[0].stamps - stamp).argmin())
            T = motion.poses(np.array([drives[0].stamps[first], stamp]))
            noise = exp(MATCH * rng.standard_normal((1, 6)))[0]
            rows.append(((0, other), (first, anchor), np.linalg.inv(T[0]) @ T[1] @ noise, np.diag(MATCH**2)))
    columns = [np.array(column) for column in zip(*rows, strict=True)]
    return AnchorPairs(*columns)


def test_a_condensed_drive_says_of_its_anchors_what_the_graph_says(sessions):
    solution = sessions[0]
    drive = condensed(solution)
    count = SIZE * (len(drive) + 1)
    H = np.zeros((count, count))
    for part in drive.rows:
        places = (SIZE * part.anchors[:, None] + np.arange(SIZE)).ravel()
        H[np.ix_(places, places)] += part.A.T @ part.A
    there = np.flatnonzero(H.diagonal())
    scale = 1 / np.sqrt(H.diagonal()[there])
    covariance = np.linalg.inv(H[np.ix_(there, there)] * np.outer(scale, scale)) * np.outer(scale, scale)
    at = np.searchsorted(solution.keyframes.stamps, drive.stamps)
    ours = np.array(
        [covariance[SIZE * n : SIZE * n + SIZE, SIZE * n : SIZE * n + SIZE] for n in range(len(drive))]
    )
    theirs = solution.state_covariances[at]
    stddevs = np.sqrt(np.einsum("kii->ki", theirs))
    assert np.abs((ours - theirs) / stddevs[:, :, None] / stddevs[:, None]).max() < 1e-4


def test_a_condensed_drive_comes_back_from_its_bytes(sessions):
    drive = condensed(sessions[0])
    again = CondensedDrive.from_bytes(drive.to_bytes())
    assert np.array_equal(again.stamps, drive.stamps)
    assert np.array_equal(again.T_map_imu, drive.T_map_imu)
    assert len(again.rows) == len(drive.rows)
    for one, other in zip(again.rows, drive.rows, strict=True):
        assert np.array_equal(one.anchors, other.anchors)
        assert np.array_equal(one.A, other.A)
        assert np.array_equal(one.b, other.b)


def test_a_drive_bound_to_itself_is_where_the_smoother_puts_it(motion):
    """The oracle: one graph of all keyframes, with the pair as one more relative pose."""
    alone = located(motion, 21)
    drive = condensed(alone)
    i, j = 5, len(drive) - 5
    stamps = drive.stamps[[i, j]]
    shift = exp(np.array([[0.002, -0.001, 0.003, 0.08, -0.06, 0.04]]))[0]  # what the drive errs by, or so
    T = np.linalg.inv(alone.trajectory.at(stamps[:1])[0]) @ alone.trajectory.at(stamps[1:])[0] @ shift
    covariance = np.diag(MATCH**2)
    whole = located(motion, 21, RelativePoses(stamps[None], T[None], covariance[None]))
    twice = AnchorPairs(
        np.zeros((2, 2), np.intp), np.array([[i, j]] * 2), np.array([T, T]), np.array([covariance] * 2) * 2
    )
    bound = bind([drive], twice)  # one that counts half is supported by another
    assert bound.used.all()
    ours, theirs = bound.corrections[0].of(alone.trajectory), whole.trajectory
    moved = np.abs(theirs.positions - alone.trajectory.positions).max()
    # the smoother weighs its fixes and relative poses anew, so the whole drive lies some mm elsewhere
    assert moved > 0.03
    assert np.abs(ours.positions - theirs.positions).max() < 0.25 * moved
    (first, second), (third, fourth) = ours.at(stamps), theirs.at(stamps)
    assert np.abs((np.linalg.inv(first) @ second - np.linalg.inv(third) @ fourth)[:3, 3]).max() < 2e-3
    turned = np.swapaxes(ours.T_map_imu[:, :3, :3], 1, 2) @ theirs.T_map_imu[:, :3, :3]
    assert np.degrees(Rotation.from_matrix(turned).magnitude()).max() < 5e-3
    assert np.abs(ours.velocities - theirs.velocities).max() < 2e-3
    assert np.allclose(ours.position_stddevs, theirs.position_stddevs, rtol=0.02)


def test_drives_of_one_track_come_together(motion, sessions):
    drives = [condensed(solution) for solution in sessions]
    bound = bind(drives, pairs_of(motion, drives, np.random.default_rng(1)))
    assert bound.used.all()
    before = [solution.trajectory for solution in sessions]
    after = [correction.of(track) for correction, track in zip(bound.corrections, before, strict=True)]
    stamps = np.arange(1.0, SECONDS - 1.0, 0.5)

    def apart(tracks: list[Trajectory]) -> float:
        first = tracks[0].at(stamps)[:, :3, 3]
        return max(np.linalg.norm(track.at(stamps)[:, :3, 3] - first, axis=1).max() for track in tracks[1:])

    assert apart(before) > 0.3
    assert apart(after) < 0.03


@pytest.mark.slow
def test_what_binding_gains_is_what_the_mean_of_independent_errors_gains(motion):
    """Over many draws: the error of three drives together, and the share of errors inside 90 % ellipsoids."""
    before, after, inside = [], [], []
    for seed in range(30, 60, 3):
        solutions = [located(motion, seed + n) for n in range(3)]
        drives = [condensed(solution) for solution in solutions]
        bound = bind(drives, pairs_of(motion, drives, np.random.default_rng(seed)))
        reference = Trajectory(solutions[0].trajectory.stamps, motion.poses(solutions[0].trajectory.stamps))
        track = bound.corrections[0].of(solutions[0].trajectory)
        before.append(errors(solutions[0].trajectory, reference).ate_m)
        after.append(errors(track, reference).ate_m)
        off = errors(track, reference).position[::100]
        R = track.T_map_imu[::100, :3, :3]
        in_map = R @ track.covariances[::100, 3:, 3:] @ np.swapaxes(R, 1, 2)
        squares = np.einsum("ki,ki->k", off, np.linalg.solve(in_map, off[..., None])[..., 0])
        inside.append(np.mean(squares < quantile(0.9, 3)))
    gain = np.sqrt(np.mean(np.square(after)) / np.mean(np.square(before)))
    assert 0.4 < gain < 0.8  # 0.58 for ever many draws
    assert np.mean(inside) > 0.75


@pytest.mark.parametrize("metres", [3.0, 8.0, 30.0], ids=["a bay", "a facade", "a street"])
def test_a_wrong_pair_bends_nothing(motion, sessions, metres):
    """Facades look alike some metres on; every third pair is shifted along the street or across it."""
    drives, rng = [condensed(solution) for solution in sessions], np.random.default_rng(2)
    right = pairs_of(motion, drives, rng, every=6)
    good = bind(drives, right)
    for wrong in range(0, len(right), 3):
        T = right.T.copy()
        T[wrong, :2, 3] += metres * rng.permutation([1.0, 0.0]) * rng.choice([-1, 1])
        bound = bind(drives, replace(right, T=T))
        assert not bound.used[wrong]
        assert bound.used[np.arange(len(right)) != wrong].all()
        for ours, theirs in zip(bound.corrections, good.corrections, strict=True):
            assert np.abs(ours.after[:, :3, 3] - theirs.after[:, :3, 3]).max() < 0.02


def test_a_pair_that_nothing_beside_it_supports_is_left_out(motion, sessions):
    drives = [condensed(solution) for solution in sessions[:2]]
    pairs = pairs_of(motion, drives, np.random.default_rng(3))
    alone = np.arange(len(pairs)) == 0
    bound = bind(drives, pairs[alone])
    assert not bound.used.any()
    for correction in bound.corrections:
        assert np.abs(correction.after - correction.before).max() < 1e-3


def test_a_row_of_pairs_that_all_err_alike_fits_no_gnss(motion, sessions):
    drives = [condensed(solution) for solution in sessions[:2]]
    pairs = pairs_of(motion, drives, np.random.default_rng(4))
    T = pairs.T.copy()
    T[:, 0, 3] += 8.0
    assert not bind(drives, replace(pairs, T=T)).used.any()


def test_the_order_of_the_pairs_does_not_matter(motion, sessions):
    drives = [condensed(solution) for solution in sessions]
    pairs = pairs_of(motion, drives, np.random.default_rng(6))
    one = bind(drives, pairs)
    other = bind(drives, pairs[np.arange(len(pairs))[::-1]])
    for a, b in zip(one.corrections, other.corrections, strict=True):
        assert np.abs(a.after - b.after).max() < 1e-6


def test_without_pairs_nothing_moves(sessions):
    drive = condensed(sessions[0])
    none = AnchorPairs(
        np.empty((0, 2), np.intp), np.empty((0, 2), np.intp), np.empty((0, 4, 4)), np.empty((0, 6, 6))
    )
    correction = bind([drive], none).corrections[0]
    assert np.abs(correction.after - correction.before).max() < 1e-3
    track = sessions[0].trajectory
    assert np.allclose(correction.of(track).position_stddevs, track.position_stddevs, rtol=0.02)


def test_what_stands_draws_drives_to_it_and_makes_them_sure(motion, sessions):
    drive, rng = condensed(sessions[0]), np.random.default_rng(7)
    rows = []
    for anchor in range(2, len(drive) - 2, 6):
        T = motion.poses(drive.stamps[[anchor]])[0] @ exp(MATCH * rng.standard_normal((1, 6)))[0]
        rows.append(((1, 0), (0, anchor), T, np.diag(MATCH**2)))
    bound = bind([drive, CondensedDrive.fixed()], AnchorPairs(*map(np.array, zip(*rows, strict=True))))
    assert bound.used.all()
    assert np.abs(bound.corrections[1].after - np.eye(4)).max() < 1e-3
    track = bound.corrections[0].of(sessions[0].trajectory)
    off = track.positions - motion.poses(track.stamps)[:, :3, 3]
    assert np.abs(off).max() < 0.05
    assert track.position_stddevs.max() < 0.05
