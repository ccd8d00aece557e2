"""One graph over condensed drives: places that were passed twice are bound, and what does not fit is left out.

Its factors are the equations of all drives, which are linear, and the pairs, with truncated loss. Fixes of an inertial
unit drift, so those of a drive are all wrong together: its poses are moved by a shift, which is unknown but for its
standard deviation. So drives that are bound weigh by what each knows of the place, and not by how many fixes it has.

A wrong pair has to pass three tests: it is as near to what the drives themselves say as their covariance allows; it
agrees with the other pairs; and another one beside it says the same.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, M, S, V, W, X
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from factor_graphs.arrays import Array, Mask
from factor_graphs.chi_square import RARE, quantile
from factor_graphs.condensing import CondensedDrive, Rows
from factor_graphs.corrections import Correction
from factor_graphs.elimination import factor_of
from factor_graphs.errors import EstimationError
from factor_graphs.least_squares import minimise
from factor_graphs.model import relative_pose_factors
from factor_graphs.problem import RELATIVE_LOSSES
from factor_graphs.relative_poses import RelativePoses
from factor_graphs.trajectory import turned

REJECTION = quantile(RARE, 6)
# The drives' own covariance is believed up to this factor of a standard deviation when a pair is held against it.
BELIEVED = 1.5
# Pairs support each other that are at most so many anchors apart, on both ways.
NEIGHBOURS = 12
# As in `least_squares.minimise`.
MOST_ITERATIONS, TOLERANCE = 30, 1e-10
# Covariances are computed at every so many anchors: they change slowly, and to compute all would take most of the time.
EVERY_NTH = 4
# Stands for the standard deviation of what does not shift, m.
NONE_M = 1e-6


@dataclass(frozen=True, eq=False)
class AnchorPairs:
    """Relative poses between anchors, of two drives or of one.

    `drives` (p, 2) and `anchors` (p, 2) number them; `T` (p, 4, 4): p_first = T p_second, in imu axes; `covariances`
    (p, 6, 6) of the tangent with T Exp(tangent), rotation rad before translation m, in the axes of the second.
    """

    drives: NDArray[np.intp]
    anchors: NDArray[np.intp]
    T: Array
    covariances: Array

    def __len__(self) -> int:
        return len(self.drives)

    def __getitem__(self, rows: Mask) -> "AnchorPairs":
        return AnchorPairs(self.drives[rows], self.anchors[rows], self.T[rows], self.covariances[rows])


@dataclass(frozen=True, eq=False)
class Bound:
    """The anchors of every drive once the pairs are known.

    `corrections`: how the anchors of each drive move; `used` (p,): the pairs that hold them;
    `expected` (p,) and `squares` (p,): squared whitened distance, chi2 of 6 dof, of every pair from what the drives
    alone say, and from the result.
    """

    corrections: list[Correction]
    used: Mask
    expected: Array
    squares: Array


def bind(drives: Sequence[CondensedDrive], pairs: AnchorPairs) -> Bound:
    """Bind the drives, which are in one map frame, by the pairs that prove right; raises EstimationError."""
    poses = _Poses.of(drives)
    start = _start(drives, poses)
    graph = _graph_of(drives, poses, start)
    alone = _solved(graph, start)
    expected = _expected(drives, poses, pairs, graph, alone)
    used = expected <= REJECTION
    while True:
        bound, found = graph, alone
        for loss in ("huber", "truncated"):
            bound = _graph_of(drives, poses, found)
            for factor in _between_factors(poses, pairs[used], RELATIVE_LOSSES[loss]):
                bound.push_back(factor)
            found = _solved(bound, found)
        factors = _between_factors(poses, pairs, None)
        squares = np.array([2 * factor.error(found) for factor in factors])
        supported = _supported(pairs, used & (squares <= REJECTION))
        if np.array_equal(supported, used):
            break
        used = supported
    marginals, corrections = gtsam.Marginals(bound, found), []
    for n, drive in enumerate(drives):
        T = np.array([found.atPose3(X(key)).matrix() for key in poses.of_drive(n)])
        covariances = _pose_covariances(marginals, poses.of_drive(n), T)
        corrections.append(Correction(drive.stamps, drive.T_map_imu, T, covariances))
    return Bound(corrections, used, expected, squares)


@dataclass(frozen=True)
class _Poses:
    """Numbers of the poses of all drives: `first` (d + 1,) is where those of each begin."""

    first: NDArray[np.intp]

    @classmethod
    def of(cls, drives: Sequence[CondensedDrive]) -> "_Poses":
        return cls(np.cumsum([0, *map(len, drives)]))

    def of_drive(self, drive: int) -> list[int]:
        return list(range(self.first[drive], self.first[drive + 1]))

    def of_pairs(self, pairs: AnchorPairs) -> NDArray[np.intp]:
        """(p, 2)."""
        return np.asarray(self.first[pairs.drives] + pairs.anchors)


def _start(drives: Sequence[CondensedDrive], poses: _Poses) -> gtsam.Values:
    """The drives as they are: nothing corrected, no shift."""
    values = gtsam.Values()
    for n, drive in enumerate(drives):
        values.insert(S(n), np.zeros(3))
        for key, T in zip(poses.of_drive(n), drive.T_map_imu, strict=True):
            values.insert(X(key), pose3=gtsam.Pose3(T))
        for part in drive.rows:
            for key, columns in _other_terms(part, poses.of_drive(n), n):
                if not values.exists(key):
                    values.insert(key, np.zeros(columns.shape[1]))
    return values


def _graph_of(
    drives: Sequence[CondensedDrive], poses: _Poses, at: gtsam.Values
) -> gtsam.NonlinearFactorGraph:
    """The equations of all drives, A x = b of the tangents x from the poses without the shift of their drive."""
    graph = gtsam.NonlinearFactorGraph()
    for n, drive in enumerate(drives):
        here, shift = poses.of_drive(n), at.atVector(S(n))
        stddevs = np.maximum(np.sqrt(drive.position_variances), NONE_M)
        graph.push_back(gtsam.PriorFactorVector(S(n), np.zeros(3), gtsam.noiseModel.Diagonal.Sigmas(stddevs)))
        tangents = []
        for key, T in zip(here, drive.T_map_imu, strict=True):
            pose = at.atPose3(X(key))
            off = gtsam.Pose3(T).inverse() * gtsam.Pose3(pose.rotation(), pose.translation() - shift)
            by_pose, R = gtsam.Pose3.LogmapDerivative(off), pose.rotation().matrix()
            tangents.append((gtsam.Pose3.Logmap(off), by_pose, -by_pose[:, 3:] @ R.T))
        for part in drive.rows:
            terms, b, by_shift = _other_terms(part, here, n), part.b, np.zeros((len(part.b), 3))
            b = b - sum((columns @ at.atVector(key) for key, columns in terms), np.zeros(len(b)))
            for anchor, A in _blocks(part):
                if anchor < len(drive):
                    x, by_pose, of_shift = tangents[anchor]
                    terms.append((X(here[anchor]), A[:, :6] @ by_pose))
                    b, by_shift = b - A[:, :6] @ x, by_shift + A[:, :6] @ of_shift
            graph.push_back(gtsam.LinearContainerFactor(factor_of([*terms, (S(n), by_shift)], b), at))
    return graph


def _blocks(part: Rows) -> Iterator[tuple[int, Array]]:
    """The anchors of some equations, and their columns."""
    return zip(part.anchors.tolist(), np.split(part.A, len(part.anchors), axis=1), strict=True)


def _other_terms(part: Rows, here: list[int], drive: int) -> list[tuple[int, Array]]:
    """Keys of what equations speak of beside poses, and their columns: all of it is linear."""
    found = []
    for anchor, A in _blocks(part):
        if anchor == len(here):
            found += [(M(drive), A[:, :5]), (W(drive), A[:, 5:9])]
        else:
            found += [(V(here[anchor]), A[:, 6:9]), (B(here[anchor]), A[:, 9:])]
    return [(key, columns) for key, columns in found if columns.any()]


def _between_factors(
    poses: _Poses, pairs: AnchorPairs, loss: gtsam.noiseModel.mEstimator.Base | None
) -> Iterator[gtsam.BetweenFactorPose3]:
    relative = RelativePoses(np.tile([0.0, 1.0], (len(pairs), 1)), pairs.T, pairs.covariances)
    return relative_pose_factors(relative, poses.of_pairs(pairs), loss)


def _solved(graph: gtsam.NonlinearFactorGraph, start: gtsam.Values) -> gtsam.Values:
    try:
        values, iterations = minimise(graph, start, False, MOST_ITERATIONS, TOLERANCE)
    except RuntimeError as error:
        raise EstimationError(f"the equations of the drives have no solution: {error}") from error
    if iterations == MOST_ITERATIONS:
        raise EstimationError(
            f"the drives are not bound after {iterations} iterations: are they of one place?"
        )
    return values


def _pose_covariances(marginals: gtsam.Marginals, keys: list[int], T: Array) -> Array:
    """Covariances (a, 6, 6) of all poses (a, 4, 4) from those of some: linear in between, in map axes."""
    chosen = np.unique(np.append(np.arange(0, len(keys), EVERY_NTH), len(keys) - 1))
    known = np.array([marginals.marginalCovariance(X(keys[n])) for n in chosen.tolist()])
    in_map = turned(known, T[chosen, :3, :3])
    places = np.arange(len(T))
    i = np.clip(np.searchsorted(chosen, places, side="right") - 1, 0, max(len(chosen) - 2, 0))
    after = np.minimum(i + 1, len(chosen) - 1)
    u = ((places - chosen[i]) / np.maximum(chosen[after] - chosen[i], 1))[:, None, None]
    return turned((1 - u) * in_map[i] + u * in_map[after], np.swapaxes(T[:, :3, :3], 1, 2))


def _expected(
    drives: Sequence[CondensedDrive],
    poses: _Poses,
    pairs: AnchorPairs,
    graph: gtsam.NonlinearFactorGraph,
    alone: gtsam.Values,
) -> Array:
    """Squared distance (p,) of each pair from what the drives alone say, in units of its covariance."""
    marginals, found = gtsam.Marginals(graph, alone), np.empty(len(pairs))
    for n, ((i, j), (a, b)) in enumerate(
        zip(poses.of_pairs(pairs).tolist(), pairs.drives.tolist(), strict=True)
    ):
        first, second = alone.atPose3(X(i)), alone.atPose3(X(j))
        off = gtsam.Pose3.Logmap(gtsam.Pose3(pairs.T[n]).inverse() * first.between(second))
        J = np.hstack([-second.between(first).AdjointMap(), np.eye(6)])
        P, as_it_is = np.zeros((12, 12)), np.zeros((6, 6))
        if a == b:
            joint = marginals.jointMarginalCovariance(gtsam.KeyVector([X(i), X(j)]))
            P = np.block([[joint.at(X(p), X(q)) for q in (i, j)] for p in (i, j)])
        else:  # how wrong an inertial unit may be is believed as it is
            P[:6, :6], P[6:, 6:] = (marginals.marginalCovariance(X(key)) for key in (i, j))
            R = second.rotation().matrix()
            both = drives[a].position_variances + drives[b].position_variances
            as_it_is[3:, 3:] = (R.T * both) @ R
        covariance = pairs.covariances[n] + BELIEVED**2 * (J @ P @ J.T - as_it_is) + as_it_is
        found[n] = off @ np.linalg.solve(covariance, off)
    return found


def _supported(pairs: AnchorPairs, fits: Mask) -> Mask:
    """The pairs that fit and have another one beside them, of the same drives, that fits."""
    places, supported = pairs.anchors, np.zeros(len(pairs), np.bool_)
    for n in np.flatnonzero(fits):
        beside = np.abs(places - places[n]).max(axis=1) <= NEIGHBOURS
        beside &= fits & (pairs.drives == pairs.drives[n]).all(axis=1)
        beside[n] = False
        supported[n] = beside.any()
    return supported


def components(count: int, edges: NDArray[np.intp]) -> list[list[int]]:
    """The groups of so many drives that edges (e, 2) connect, directly or by others, each in ascending order."""
    graph = sparse.coo_array((np.ones(len(edges)), tuple(edges.T)), (count, count))
    groups, of_drive = connected_components(graph, directed=False)
    return [np.flatnonzero(of_drive == group).tolist() for group in range(groups)]
