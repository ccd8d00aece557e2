"""How far to believe every keyframe: its covariance, from a QR elimination of the whole graph.

GTSAM's `Marginals` goes through Cholesky, which squares the condition of the problem, and throws where a
stiff IMU meets a weak prior: an ordinary short drive. Here the graph is eliminated by QR, keyframe by
keyframe, into conditionals R x = d - S y on later keyframes y, and the covariances follow backwards:
cov(x) = R⁻¹ R⁻ᵀ + W cov(y) Wᵀ with W = R⁻¹ S (Kaess and Dellaert 2009).
"""

from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, M, V, X
from numpy.typing import NDArray
from scipy.linalg.lapack import dtrtri

Array = NDArray[np.float64]

# Numbers of a keyframe: tangent of its pose, velocity, biases.
SIZE = 15
# A key of GTSAM holds its letter above so many bits of its index.
INDEX_BITS = 56
# Keyframes that are eliminated in one call; more take memory, fewer take time.
TOGETHER = 20
# Where pose, velocity and bias stand in the 15 numbers of a keyframe, mounting and wheels in those that all share.
PLACES = {
    ord("x"): slice(0, 6), ord("v"): slice(6, 9), ord("b"): slice(9, 15),
    ord("m"): slice(0, 4), ord("w"): slice(4, 8),
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Conditional:
    """R x = d - S y: one variable x given later ones y; `keys` are theirs, in the order of the columns of R and S."""

    keys: list[int]
    R: Array
    S: Array
    d: Array


def eliminate(graph: gtsam.GaussianFactorGraph, k: int, last: tuple[int, ...] = ()) -> Iterator[Conditional]:
    """The graph of k keyframes as conditionals, X V B of each in order, then the keys in `last`.

    GTSAM's own hold all rows that their elimination began with, 100 kB per keyframe. So it eliminates a few keyframes
    at a time, from their factors and what the ones before them left, and only R, S and d are kept.
    """
    waiting, remaining = factors_by_first_keyframe(graph, k), gtsam.GaussianFactorGraph()
    for begin in range(0, k + 1, TOGETHER):
        window = range(begin, min(begin + TOGETHER, k + 1))
        for factor in [factor for i in window for factor in waiting.pop(i, [])]:
            remaining.push_back(factor)
        keys = [key for i in window for key in (state_keys(i) if i < k else last)]
        net, remaining = remaining.eliminatePartialSequential(ordering_of(keys), gtsam.EliminateQR)
        for part in (net.at(n) for n in range(net.size())):
            # GTSAM returns views into the conditional, which do not keep it alive
            yield Conditional(list(part.keys()), part.R().copy(), part.S().copy(), part.d().copy())


def factors_by_first_keyframe(
    graph: gtsam.GaussianFactorGraph, k: int
) -> dict[int, list[gtsam.GaussianFactor]]:
    """The factors of a graph by the first keyframe that they bind; k where they bind none."""
    found = defaultdict(list)
    for factor in (graph.at(n) for n in range(graph.size())):
        keyframes = [index for letter, index in map(split_key, factor.keys()) if letter in PLACES]
        found[min(keyframes, default=k)].append(factor)
    return found


def state_keys(i: int) -> tuple[int, int, int]:
    """Keys of pose, velocity and biases of keyframe i."""
    return X(i), V(i), B(i)


def ordering_of(keys: Iterable[int]) -> gtsam.Ordering:
    """These keys, in this order."""
    ordering = gtsam.Ordering()
    for key in keys:
        ordering.push_back(key)
    return ordering


def split_key(key: int) -> tuple[int, int]:
    """Letter and index of a key."""
    return key >> INDEX_BITS, key & (1 << INDEX_BITS) - 1


class SumVariance:
    """Variance of sums of G x over the keyframes of a window, and of G s of what all keyframes share.

    `rows` (k, m, 15) are G of every keyframe and `windows` (k,) its window, -1 for none; `of_shared` (w, m, 4) are G of
    the mounting. `found` (w, m) is known once `keyframe_covariances` has gone through all keyframes.
    """

    def __init__(self, rows: Array, windows: NDArray[np.intp], of_shared: Array) -> None:
        self.found = np.zeros(of_shared.shape[:2])
        self._rows, self._windows, self._of_shared = rows, windows, of_shared
        self._first = {int(w): int(i) for i, w in reversed(list(enumerate(windows))) if w >= 0}
        self._sum = np.zeros((rows.shape[1], rows.shape[1]))
        self._beside = np.empty((0, rows.shape[1]))
        """Covariance of the keyframes known, in their order, and the sum."""

    def add(self, i: int, W: Array, rows: NDArray[np.intp], joint: Array, known: list[int]) -> None:
        """Keyframe i of x_i = -W y + noise, with y at `rows` of those known before; now they are `known`."""
        later = self._beside[rows] if len(self._beside) else np.zeros((len(rows), len(self._sum)))
        own, window = -W @ later, int(self._windows[i])
        if window >= 0:
            G = self._rows[i]
            both = G @ own
            self._sum += G @ joint[:SIZE, :SIZE] @ G.T + both + both.T
            own, later = own + joint[:SIZE, :SIZE] @ G.T, later + joint[SIZE:, :SIZE] @ G.T
        self._beside = np.vstack([own, later])
        if window >= 0 and self._first[window] == i:
            self._finish(window, joint, known)

    def _finish(self, window: int, joint: Array, known: list[int]) -> None:
        G = self._of_shared[window]
        place = SIZE * known.index(len(self._windows)) + np.arange(G.shape[1])
        both = G @ self._beside[place]
        total = self._sum + G @ joint[np.ix_(place, place)] @ G.T + both + both.T
        self.found[window] = total.diagonal()
        self._sum[:], self._beside = 0.0, np.empty((0, len(self._sum)))


def keyframe_covariances(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, k: int, sums: SumVariance | None = None
) -> tuple[Array, Array]:
    """Covariance of (pose tangent, velocity, biases) of every keyframe, (k, 15, 15); of M(k) and W(k), where they are.

    M(k) and W(k), the mounting of the IMU and the calibration of the wheels, are what all keyframes share: they are
    eliminated last, as if they were one more keyframe. `sums` finds the variance of sums over keyframes on the way.
    """
    shared = tuple(key for key in (M(k), gtsam.symbol("w", k)) if values.exists(key))
    net = list(eliminate(graph.linearize(values), k, shared))
    covariances = np.empty((k, SIZE, SIZE))
    # The joint covariance of a keyframe and of those it depends on. The IMU binds each keyframe to the next, so those
    # of the one before it are among them, and memory does not grow with the drive.
    known: list[int] = []
    joint = np.empty((0, 0))
    of_shared = np.empty((0, 0))
    if shared:
        R, _, _ = _of_keyframe(k, net[3 * k :])
        there = np.flatnonzero(R.diagonal())
        root = np.linalg.inv(R[np.ix_(there, there)])
        of_shared = root @ root.T
        known, joint = [k], np.zeros((SIZE, SIZE))
        joint[np.ix_(there, there)] = of_shared
    for i in reversed(range(k)):
        R, later, S = _of_keyframe(i, net[3 * i : 3 * i + 3])
        own, _ = dtrtri(R)
        W, rows = own @ S, _rows(later, known)
        joint = joint[np.ix_(rows, rows)]
        cross = -W @ joint
        covariance = own @ own.T - cross @ W.T
        covariances[i] = (covariance + covariance.T) / 2
        joint = np.vstack([np.hstack([covariances[i], cross]), np.hstack([cross.T, joint])])
        known = [i, *later]
        if sums is not None:
            sums.add(i, W, rows, joint, known)
    return covariances, of_shared


def _rows(keyframes: list[int], known: list[int]) -> NDArray[np.intp]:
    """Where some of the keyframes stand in the joint covariance of those known."""
    first = SIZE * np.array([known.index(i) for i in keyframes], np.intp)
    return (first[:, None] + np.arange(SIZE)).ravel()


def _of_keyframe(i: int, parts: list[Conditional]) -> tuple[Array, list[int], Array]:
    """Keyframe i given later ones: R (15, 15) upper triangular, those keyframes, and S (15, 15 each)."""
    keys = [[split_key(key) for key in part.keys] for part in parts]
    later = sorted({index for row in keys for _, index in row} - {i})
    start = {index: SIZE * (1 + n) for n, index in enumerate(later)} | {i: 0}
    columns = np.zeros((SIZE, SIZE * (1 + len(later))))
    for part, row in zip(parts, keys, strict=True):
        matrix, column, rows = np.hstack([part.R, part.S]), 0, PLACES[row[0][0]]
        for letter, index in row:
            place, first = PLACES[letter], start[index]
            width = place.stop - place.start
            columns[rows, first + place.start : first + place.stop] = matrix[:, column : column + width]
            column += width
    return columns[:, :SIZE], later, columns[:, SIZE:]
