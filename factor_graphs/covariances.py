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
# Where pose, velocity and bias stand in the 15 numbers of a keyframe, mounting and wheels in those that all share.
PLACES = {
    ord("x"): range(6), ord("v"): range(6, 9), ord("b"): range(9, 15),
    ord("m"): range(4), ord("w"): range(4, 8),
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Conditional:
    """R x = d - S y: the numbers x of a keyframe given those y of later ones.

    `later` are the keys of y, in the order of the columns of S.
    """

    later: list[int]
    R: Array
    S: Array
    d: Array


def eliminate(graph: gtsam.GaussianFactorGraph, k: int, last: tuple[int, ...] = ()) -> Iterator[Conditional]:
    """The graph of k keyframes as conditionals, one of every keyframe in order, then one of the keys in `last`.

    A keyframe is one dense QR of its factors and of what the ones before it left: a third of the time that GTSAM's own
    elimination takes, variable by variable. GTSAM's conditionals hold all rows that their elimination began with,
    100 kB per keyframe, so only R, S and d are kept.
    """
    waiting, left = factors_by_first_keyframe(graph, k), None
    for i in range(k + 1 if last else k):
        factors, keys = gtsam.GaussianFactorGraph(), state_keys(i) if i < k else last
        for factor in waiting.pop(i, []) if left is None else [*waiting.pop(i, []), left]:
            factors.push_back(factor)
        found, left = gtsam.EliminateQR(factors, ordering_of(keys))
        # GTSAM returns views into the conditional, which do not keep it alive
        yield Conditional(
            list(found.keys())[len(keys) :], found.R().copy(), found.S().copy(), found.d().copy()
        )


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
        there = np.concatenate([np.r_[PLACES[split_key(key)[0]]] for key in shared])
        root = np.linalg.inv(net[k].R)
        of_shared = root @ root.T
        known, joint = [k], np.zeros((SIZE, SIZE))
        joint[np.ix_(there, there)] = of_shared
    for i in reversed(range(k)):
        later, S = _of_keyframes(net[i])
        own, _ = dtrtri(net[i].R)
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


def _of_keyframes(conditional: Conditional) -> tuple[list[int], Array]:
    """The later keyframes that a conditional is given, and its S with 15 columns for each of them."""
    keys = [split_key(key) for key in conditional.later]
    later = sorted({index for _, index in keys})
    first = {index: SIZE * n for n, index in enumerate(later)}
    S = np.zeros((SIZE, SIZE * len(later)))
    columns = [first[index] + column for letter, index in keys for column in PLACES[letter]]
    S[:, columns] = conditional.S
    return later, S
