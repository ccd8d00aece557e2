"""One graph over condensed drives: places that were passed twice are bound, and what does not fit is left out.

The corrections x minimise |A x - b|² over the rows of all drives, plus the whitened residuals of the pairs, with
truncated loss (Gauss-Newton; the pairs alone are not linear). Fixes of an inertial unit drift, so those of a drive are
all wrong together: its anchors are at T Exp(x), moved by a shift c, which is unknown but for its standard deviation. So
drives that are bound weigh by what each knows of the place, and not by how many fixes it has.

A wrong pair has to pass three tests: it is as near to what the drives themselves say as their covariance allows; it
agrees with the other pairs; and another one beside it says the same.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import SuperLU, splu

from factor_graphs.chi_square import quantile
from factor_graphs.condensing import CondensedDrive
from factor_graphs.corrections import Correction
from factor_graphs.elimination import SIZE
from factor_graphs.errors import EstimationError

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# 99.9 % of right pairs lie below, and where the loss of the others begins to grow slower.
REJECTION, HUBER = quantile(0.999, 6), quantile(0.8, 6)
# The drives' own covariance is believed up to this factor of a standard deviation when a pair is held against it.
BELIEVED = 1.5
# Pairs support each other that are at most so many anchors apart, on both ways.
NEIGHBOURS = 12
# Rounds of weights and of solutions; corrections stand still when they move less, m and rad.
ROUNDS, STILL = 30, 1e-4
# Covariances are computed at every so many anchors: they change slowly, and to compute all would take most of the time.
EVERY_NTH = 4
# Stands for the standard deviation of what does not shift, m.
NONE_M = 1e-6
# Columns that are solved for at once.
TOGETHER = 240


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
    system = _System(drives)
    alone = system.solve(pairs, np.zeros(len(pairs)), system.start)
    expected = _expected(system, pairs, alone)
    used = expected <= REJECTION
    while True:
        found, weights, squares = _robust(system, pairs, used, alone)
        supported = _supported(pairs, used & (weights > 0.0))
        if np.array_equal(supported, used):
            break
        used = supported
    corrections = [
        Correction(drive.stamps, drive.T_map_imu, T, covariances)
        for drive, T, covariances in zip(drives, found.poses, system.pose_covariances(found), strict=True)
    ]
    return Bound(corrections, used, expected, squares)


@dataclass(frozen=True, eq=False)
class _State:
    """Corrections x, shifts being the last, the poses with them, and the factors of the normal equations they solve."""

    x: Array
    poses: list[Array]
    factors: SuperLU
    scale: Array


class _System:
    """The equations of all drives, stacked; columns that no equation speaks of are left out, but for the shifts."""

    def __init__(self, drives: Sequence[CondensedDrive]) -> None:
        self.drives = drives
        self._first = np.cumsum([0, *(SIZE * (len(drive) + 1) for drive in drives)])
        A, b = _stacked(drives, self._first)
        by_column = A.tocsc()
        there = np.flatnonzero(np.diff(by_column.indptr))
        self._column = np.full(A.shape[1], -1)
        self._column[there] = np.arange(len(there))
        spoken_of = by_column[:, there]
        # without a variance there is no shift: the prior keeps it at zero
        variances = np.concatenate([drive.position_variances for drive in drives])
        shifts = sparse.diags(1.0 / np.maximum(variances, NONE_M**2))
        self._H = sparse.block_diag([spoken_of.T @ spoken_of, shifts], format="csc")
        self._g = np.append(spoken_of.T @ b, np.zeros(len(variances)))
        self.start = np.zeros(len(self._g))

    def columns_of(self, drive: int, anchor: int) -> NDArray[np.intp]:
        """Where the pose of an anchor stands among the corrections, (6,), and the shift of its drive, (3,)."""
        first, shift = self._first[drive] + SIZE * anchor, len(self._g) + 3 * (drive - len(self.drives))
        return np.append(self._column[first : first + 6], shift + np.arange(3))

    def solve(self, pairs: AnchorPairs, weights: Array, x: Array) -> _State:
        """One step of Gauss-Newton from the corrections x."""
        J, r = self.residuals(pairs, self._poses(x))
        J = sparse.diags(np.repeat(np.sqrt(weights), 6)) @ J
        r = r * np.sqrt(weights)[:, None]
        H = (self._H + J.T @ J).tocsc()
        g = self._g - J.T @ (r.ravel() - J @ x)
        # columns are scaled, for biases and positions differ by a factor of a million
        scale = 1.0 / np.sqrt(H.diagonal())
        scaled = sparse.diags(scale)
        try:
            factors = splu(
                (scaled @ H @ scaled).tocsc(),
                "MMD_AT_PLUS_A",
                diag_pivot_thresh=0.0,
                options={"SymmetricMode": True},
            )
        except RuntimeError as error:
            raise EstimationError(f"the equations of the drives have no solution: {error}") from error
        x = scale * factors.solve(scale * g)
        return _State(x, self._poses(x), factors, scale)

    def residuals(self, pairs: AnchorPairs, poses: Sequence[Array]) -> tuple[sparse.csr_array, Array]:
        """Jacobian of the whitened residuals of the pairs by the corrections, (6 p, c), and these residuals, (p, 6)."""
        r, rows, columns, values = np.empty((len(pairs), 6)), [], [], []
        for n, (of_drives, of_anchors) in enumerate(zip(pairs.drives, pairs.anchors, strict=True)):
            (a, b), (i, j) = of_drives.tolist(), of_anchors.tolist()
            first, second = gtsam.Pose3(poses[a][i]), gtsam.Pose3(poses[b][j])
            whiten = np.linalg.inv(np.linalg.cholesky(pairs.covariances[n]))
            off = gtsam.Pose3.Logmap(gtsam.Pose3(pairs.T[n]).inverse() * first.inverse() * second)
            r[n] = whiten @ off
            own = -whiten @ second.between(first).AdjointMap()
            for J, T, place in (
                (own, first, self.columns_of(a, i)),
                (whiten, second, self.columns_of(b, j)),
            ):
                rows.append(np.repeat(6 * n + np.arange(6), 9))
                columns.append(np.tile(place, 6))
                values.append((J @ _tangent(T.rotation().matrix())).ravel())
        data, row, column = (np.concatenate([*part, np.empty(0)]) for part in (values, rows, columns))
        return sparse.csr_array(
            (data, (row.astype(int), column.astype(int))), (6 * len(pairs), len(self.start))
        ), r

    def variances(self, state: _State, J: sparse.csr_array) -> Array:
        """Covariance of every six rows of J x, (p, 6, 6)."""
        found = np.empty((J.shape[0] // 6, 6, 6))
        for begin in range(0, J.shape[0], TOGETHER):
            some = J[begin : begin + TOGETHER]
            half = state.factors.solve(state.scale[:, None] * some.T.toarray()) * state.scale[:, None]
            for n in range(some.shape[0] // 6):
                own = slice(6 * n, 6 * n + 6)
                found[begin // 6 + n] = some[own] @ half[:, own]
        return (found + np.swapaxes(found, 1, 2)) / 2

    def pose_covariances(self, state: _State) -> Iterator[Array]:
        """Covariances (a, 6, 6) of the poses of each drive's anchors."""
        for drive, condensed in enumerate(self.drives):
            chosen = np.unique(np.append(np.arange(0, len(condensed), EVERY_NTH), len(condensed) - 1))
            columns = np.concatenate([np.tile(self.columns_of(drive, n), 6) for n in chosen.tolist()])
            values = np.concatenate([_tangent(state.poses[drive][n][:3, :3]).ravel() for n in chosen])
            rows = np.repeat(np.arange(6 * len(chosen)), 9)
            J = sparse.csr_array((values, (rows, columns)), (6 * len(chosen), len(self.start)))
            yield _between(chosen, self.variances(state, J), state.poses[drive])

    def _poses(self, x: Array) -> list[Array]:
        found = []
        for drive, condensed in enumerate(self.drives):
            of_anchors = [x[self.columns_of(drive, anchor)] for anchor in range(len(condensed))]
            moved = np.array([gtsam.Pose3.Expmap(of_anchor[:6]).matrix() for of_anchor in of_anchors])
            poses = condensed.T_map_imu @ moved
            poses[:, :3, 3] += of_anchors[0][6:]
            found.append(poses)
        return found


def _tangent(R: Array) -> Array:
    """The tangent of a pose of this rotation (3, 3) from its correction and the shift of its drive, (6, 9)."""
    found = np.zeros((6, 9))
    found[:, :6], found[3:, 6:] = np.eye(6), R.T
    return found


def _between(chosen: NDArray[np.intp], covariances: Array, poses: Array) -> Array:
    """Covariances of all poses (a, 4, 4) from those (c, 6, 6) of the chosen ones: linear in between, in map axes."""
    axes = np.zeros((len(poses), 6, 6))
    axes[:, :3, :3] = axes[:, 3:, 3:] = poses[:, :3, :3]
    in_map = axes[chosen] @ covariances @ np.swapaxes(axes[chosen], 1, 2)
    places = np.arange(len(poses))
    i = np.clip(np.searchsorted(chosen, places, side="right") - 1, 0, max(len(chosen) - 2, 0))
    after = np.minimum(i + 1, len(chosen) - 1)
    u = ((places - chosen[i]) / np.maximum(chosen[after] - chosen[i], 1))[:, None, None]
    found: Array = np.swapaxes(axes, 1, 2) @ ((1 - u) * in_map[i] + u * in_map[after]) @ axes
    return found


def _stacked(drives: Sequence[CondensedDrive], first: NDArray[np.intp]) -> tuple[sparse.csr_array, Array]:
    data, row, column, b, count = [], [], [], [], 0
    for start, drive in zip(first, drives, strict=False):
        for part in drive.rows:
            m, places = len(part.b), (start + SIZE * part.anchors[:, None] + np.arange(SIZE)).ravel()
            r, c = np.nonzero(part.A)
            data.append(part.A[r, c])
            row.append(count + r)
            column.append(places[c])
            b.append(part.b)
            count += m
    entries = (np.concatenate(data), (np.concatenate(row), np.concatenate(column)))
    return sparse.csr_array(entries, (count, int(first[-1]))), np.concatenate(b)


def _expected(system: _System, pairs: AnchorPairs, alone: _State) -> Array:
    """Squared distance (p,) of each pair from what the drives alone say, in units of its covariance."""
    J, r = system.residuals(pairs, alone.poses)
    S = BELIEVED**2 * system.variances(alone, J) + np.eye(6)
    for n, (of_drives, of_anchors) in enumerate(zip(pairs.drives, pairs.anchors, strict=True)):
        (a, b), j = of_drives.tolist(), int(of_anchors[1])
        if a != b:  # how wrong an inertial unit may be is believed as it is
            whiten = np.linalg.inv(np.linalg.cholesky(pairs.covariances[n]))[:, 3:]
            R = alone.poses[b][j][:3, :3]
            both = system.drives[a].position_variances + system.drives[b].position_variances
            S[n] -= (BELIEVED**2 - 1.0) * whiten @ (R.T * both) @ R @ whiten.T
    found: Array = np.einsum("pi,pi->p", r, np.linalg.solve(S, r[..., None])[..., 0])
    return found


def _robust(system: _System, pairs: AnchorPairs, used: Mask, start: _State) -> tuple[_State, Array, Array]:
    """The solution, weights (p,) and squared residuals (p,) of the pairs: Huber's loss first, then truncated."""
    state = start
    for loss in (_huber, _truncated):
        weights = np.full(len(pairs), -1.0)
        for _ in range(ROUNDS):
            squares = np.sum(system.residuals(pairs, state.poses)[1] ** 2, axis=1)
            before, weights = weights, used * loss(squares)
            x, state = state.x, system.solve(pairs, weights, state.x)
            if np.abs(state.x - x).max(initial=0.0) < STILL and np.allclose(weights, before, atol=0.01):
                break
    return state, weights, np.sum(system.residuals(pairs, state.poses)[1] ** 2, axis=1)


def _huber(squares: Array) -> Array:
    return np.minimum(1.0, np.sqrt(HUBER / np.maximum(squares, HUBER)))


def _truncated(squares: Array) -> Array:
    return np.where(squares <= REJECTION, 1.0, 0.0)


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
