"""Poses that are given in place of a solution: how fixes and gyroscope see them, and what relative poses add."""

from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from factor_graphs.corrections import Correction
from factor_graphs.errors import MeasurementError
from factor_graphs.measurements import GnssFixes, ImuSamples
from factor_graphs.model import relative_pose_factors
from factor_graphs.problem import RELATIVE_LOSSES
from factor_graphs.relative_poses import RelativePoses
from factor_graphs.trajectory import Trajectory

Array = NDArray[np.float64]

# Fixes are not taken to be better than this, m: the lever arm and the clock are in it.
LEAST_CLAIM_M = 0.3
# The usual fix is within so many of its standard deviations of the poses that it belongs to.
FITTING = 3.0
# A heading that is known worse than this, rad, tells no direction.
UNKNOWN_HEADING = 0.05
# A fit of roll and pitch, too, is taken where it leaves less than this share of the distances.
TILTED = 0.7
REWEIGHTED = 10
# A vehicle that turns less, rad/s, shows nothing; of what it turns, so much may differ.
STRAIGHT, DIFFERENT = 0.02, 0.5
# Turns are compared over this long, s, and clocks that differ by as much.
WINDOW_S, LATEST_S, LATE_STEP_S = 0.5, 1.0, 0.05


def misses(trajectory: Trajectory, fixes: GnssFixes, p_imu_antenna: ArrayLike) -> tuple[Array, Array]:
    """How far, m, the antenna is from each fix within the trajectory (m,), and as how much they count themselves."""
    inside = fixes[(fixes.stamps >= trajectory.start) & (fixes.stamps <= trajectory.end)]
    off = np.linalg.norm(_antenna(trajectory, inside, p_imu_antenna) - inside.positions, axis=1)
    return off, np.maximum(np.linalg.norm(inside.stddevs, axis=1), LEAST_CLAIM_M)


def do_fit(off: Array, claimed: Array) -> bool:
    """Whether distances to fixes (m,) m are those that the fixes' own errors explain."""
    return bool(np.median(off / claimed) <= FITTING)


def pose_by_fixes(trajectory: Trajectory, fixes: GnssFixes, p_imu_antenna: ArrayLike) -> Array | None:
    """T_map_other (4, 4) of a trajectory in a frame of its own: a turn about up, or any where that fits far better.

    Fixes that lie far off count less. None where the way within the fixes is too short to tell the heading.
    """
    inside = fixes[(fixes.stamps >= trajectory.start) & (fixes.stamps <= trajectory.end)]
    if len(inside) < 3:
        return None
    p, claimed = _antenna(trajectory, inside, p_imu_antenna), misses(trajectory, fixes, p_imu_antenna)[1]
    spread = np.sqrt(np.maximum(np.linalg.eigvalsh(np.cov(p.T)), 0.0))
    if np.median(claimed) > UNKNOWN_HEADING * spread[-1] * np.sqrt(len(p)):
        return None
    level, tilted = (_robust(p, inside.positions, claimed, is_level) for is_level in (True, False))
    off = [
        np.median(np.linalg.norm(p @ T[:3, :3].T + T[:3, 3] - inside.positions, axis=1))
        for T in (level, tilted)
    ]
    # along a straight way a roll is free
    return tilted if off[1] < TILTED * off[0] and spread[1] > np.median(claimed) else level


def _antenna(trajectory: Trajectory, fixes: GnssFixes, p_imu_antenna: ArrayLike) -> Array:
    T = trajectory.at(fixes.stamps)
    return np.asarray(T[:, :3, :3] @ np.asarray(p_imu_antenna, np.float64) + T[:, :3, 3])


def _robust(p: Array, q: Array, claimed: Array, is_level: bool) -> Array:
    """T with q = T p, by weights that fall where points are farther off than usual."""
    weights = claimed**-2
    for _ in range(REWEIGHTED):
        T = _rigid(p, q, weights, is_level)
        off = np.linalg.norm(p @ T[:3, :3].T + T[:3, 3] - q, axis=1) / claimed
        weights = claimed**-2 / np.maximum(1.0, off / max(2 * float(np.median(off)), 1e-9)) ** 2
    return T


def _rigid(p: Array, q: Array, weights: Array, is_level: bool) -> Array:
    """The best T with q = T p, or the best that turns about z alone."""
    p0, q0 = (np.average(some, axis=0, weights=weights) for some in (p, q))
    if is_level:
        H = (weights[:, None] * (q - q0)).T @ (p - p0)
        turn = Rotation.from_rotvec([0.0, 0.0, np.arctan2(H[1, 0] - H[0, 1], H[0, 0] + H[1, 1])])
    else:
        turn, _ = Rotation.align_vectors(q - q0, p - p0, weights)
    T = np.eye(4)
    T[:3, :3] = turn.as_matrix()
    T[:3, 3] = q0 - T[:3, :3] @ p0
    return T


@dataclass(frozen=True)
class TurnsSeen:
    """How the turns of poses fit those of a gyroscope."""

    turning: float
    """Root mean square of what the gyroscope turns, rad/s."""
    off: float
    """That of the difference, its bias left out, rad/s."""
    late_s: float
    """With stamps this much earlier the poses fit best."""
    off_then: float
    """The difference then, rad/s."""

    @property
    def is_known(self) -> bool:
        """Whether the vehicle turned enough to tell."""
        return self.turning > STRAIGHT

    def fits(self, off: float) -> bool:
        """Whether a difference, rad/s, is small beside what is turned."""
        return off <= DIFFERENT * self.turning


def turns_seen(trajectory: Trajectory, imu: ImuSamples, lates_s: ArrayLike = ()) -> TurnsSeen | None:
    """Compare the turns of poses with the gyroscope's, in the axes of the imu; None without some seconds in common.

    Clocks that differ by up to a second are tried, and by `lates_s`, s.
    """
    lates = np.append(np.arange(-LATEST_S, LATEST_S + LATE_STEP_S / 2, LATE_STEP_S), lates_s)
    step = max(WINDOW_S, 2 * float(np.median(np.diff(trajectory.stamps))))
    found = [(_off(trajectory, imu, step, late), float(late)) for late in (0.0, *lates)]
    known = [(off[0], late) for off, late in found if off is not None]
    if found[0][0] is None:
        return None
    best, late = min(known)
    return TurnsSeen(found[0][0][1], found[0][0][0], late, best)


def _off(trajectory: Trajectory, imu: ImuSamples, step: float, late: float) -> tuple[float, float] | None:
    """Root mean squares, rad/s, of gyroscope minus poses, stamped `late`, and of the gyroscope."""
    first, last = max(trajectory.start - late, imu.stamps[0]), min(trajectory.end - late, imu.stamps[-1])
    ends = np.arange(first, last, step)
    if len(ends) < 4:
        return None
    middles, steps = (imu.angular_rate[1:] + imu.angular_rate[:-1]) / 2, np.diff(imu.stamps)[:, None]
    summed = np.vstack([np.zeros((1, 3)), np.cumsum(middles * steps, axis=0)])
    seen = np.diff(np.column_stack([np.interp(ends, imu.stamps, axis) for axis in summed.T]), axis=0)
    R = trajectory.at(np.clip(ends + late, trajectory.start, trajectory.end))[:, :3, :3]
    turned = Rotation.from_matrix(np.swapaxes(R[:-1], 1, 2) @ R[1:]).as_rotvec()
    off, own = ((one - np.median(one, axis=0)) / step for one in (seen - turned, seen))
    return float(np.sqrt((off**2).sum(axis=1).mean())), float(np.sqrt((own**2).sum(axis=1).mean()))


def held_by(
    trajectory: Trajectory, relative: RelativePoses, stddevs: tuple[float, float], correlation_time_s: float
) -> Trajectory:
    """The most probable trajectory, where its poses and `relative` poses are measurements of the same motion.

    `stddevs` (rad, m) are those of its poses where it has no covariances. Poses within `correlation_time_s` share their
    errors: together they weigh as one. Raises MeasurementError for a covariance that is not positive definite.
    """
    stamps = np.unique(relative.stamps)
    stamps = stamps[(stamps >= trajectory.start) & (stamps <= trajectory.end)]
    known = relative[np.flatnonzero(np.isin(relative.stamps, stamps).all(axis=1))]
    if len(stamps) < 2:
        return trajectory
    before = trajectory.at(stamps)
    covariances = _covariances(trajectory, stamps, stddevs)
    shared = np.maximum(1.0, correlation_time_s / np.gradient(stamps))[:, None, None]
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for i, (pose, covariance) in enumerate(zip(before, covariances * shared, strict=True)):
        model = gtsam.noiseModel.Gaussian.Covariance(covariance)
        graph.add(gtsam.PriorFactorPose3(X(i), gtsam.Pose3(pose), model))
        values.insert(X(i), pose3=gtsam.Pose3(pose))
    for factor in relative_pose_factors(
        known, np.searchsorted(stamps, known.stamps), RELATIVE_LOSSES["huber"]
    ):
        graph.add(factor)
    values = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    marginals, numbers = gtsam.Marginals(graph, values), range(len(stamps))
    after = np.array([values.atPose3(X(i)).matrix() for i in numbers])
    covariances = np.array([marginals.marginalCovariance(X(i)) for i in numbers])
    return Correction(stamps, before, after, covariances).of(trajectory)


def _covariances(trajectory: Trajectory, stamps: Array, stddevs: tuple[float, float]) -> Array:
    if trajectory.covariances is None:
        return np.tile(np.diag(np.repeat(np.square(stddevs), 3)), (len(stamps), 1, 1))
    found = trajectory.covariances[np.searchsorted(trajectory.stamps, stamps).clip(max=len(trajectory) - 1)]
    if not (np.linalg.eigvalsh(found) > 0).all():
        raise MeasurementError(
            "found a covariance of a pose that is not positive definite; leave covariances out"
        )
    return np.asarray(found)
