"""How far to believe every keyframe: its covariance, from a QR elimination of the whole graph.

GTSAM's `Marginals` goes through Cholesky, which squares the condition of the problem, and throws where a
stiff IMU meets a weak prior: an ordinary short drive. Here the graph is eliminated by QR, keyframe by
keyframe, into conditionals R x = d - S y on later keyframes y, and the covariances follow backwards:
cov(x) = R⁻¹ R⁻ᵀ + W cov(y) Wᵀ with W = R⁻¹ S (Kaess and Dellaert 2009).
"""

from collections import Counter
from typing import Protocol

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dtrtri

from factor_graphs.elimination import (
    PLACES,
    SIZE,
    Conditional,
    by_sections,
    eliminate,
    in_time,
    shared_keys,
    split,
    split_key,
)

Array = NDArray[np.float64]


class Visitor(Protocol):
    """Sees every keyframe i of x_i = -W y + noise, with y at `rows` of those known before; now they are `known`."""

    def add(self, i: int, W: Array, rows: NDArray[np.intp], joint: Array, known: list[int]) -> None: ...


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
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, k: int, also: Visitor | None = None
) -> tuple[Array, Array]:
    """Covariance of (pose tangent, velocity, biases) of every keyframe, (k, 15, 15); of M(k) and W(k), where they are.

    M(k) and W(k), the mounting of the IMU and the calibration of the wheels, are what all keyframes share: they are
    eliminated last, as if they were one more keyframe. `also` is shown the joint covariance of each with those it is
    given, from the last keyframe to the first.
    """
    shared = shared_keys(values, k)
    groups = by_sections(graph, k, shared) if also is None else in_time(k, shared)
    linear = (part.linearize(values) for part in split(graph, groups))
    order = [split_key(keys[0])[1] for keys in groups]
    given = {i: (one.R, *_by_keyframe(one)) for i, one in zip(order, eliminate(linear, groups), strict=True)}
    # Of what a keyframe is given, its parent is eliminated first, and is given all the rest.
    place = {i: n for n, i in enumerate(order)}
    parents = {i: min(later, key=place.__getitem__) for i, (_, later, _) in given.items() if later}
    children = Counter(parents.values())
    covariances, of_shared = np.empty((k, SIZE, SIZE)), np.empty((0, 0))
    # The joint covariance of a keyframe and of those it is given, as long as it has children to come: memory does not
    # grow with the drive.
    joints: dict[int, tuple[list[int], Array]] = {}
    if shared:
        there = np.concatenate([PLACES[split_key(key)[0]] for key in shared])
        root, joint = np.linalg.inv(given.pop(order.pop())[0]), np.zeros((SIZE, SIZE))
        of_shared = joint[np.ix_(there, there)] = root @ root.T
        joints[k] = [k], joint
    for i in reversed(order):
        R, later, S = given.pop(i)
        known, joint = joints[parents[i]] if later else ([], np.empty((0, 0)))
        own, _ = dtrtri(R)
        W, rows = own @ S, _rows(later, known)
        joint = joint[np.ix_(rows, rows)]
        cross = -W @ joint
        covariance = own @ own.T - cross @ W.T
        covariances[i] = (covariance + covariance.T) / 2
        joints[i] = [i, *later], np.vstack([np.hstack([covariances[i], cross]), np.hstack([cross.T, joint])])
        if also is not None:
            also.add(i, W, rows, joints[i][1], joints[i][0])
        if later:
            children[parents[i]] -= 1
        for j in (i, parents.get(i, i)):
            if not children[j]:
                joints.pop(j, None)
    return covariances, of_shared


def _rows(keyframes: list[int], known: list[int]) -> NDArray[np.intp]:
    """Where some of the keyframes stand in the joint covariance of those known."""
    first = SIZE * np.array([known.index(i) for i in keyframes], np.intp)
    return (first[:, None] + np.arange(SIZE)).ravel()


def _by_keyframe(conditional: Conditional) -> tuple[list[int], Array]:
    """The later keyframes that a conditional is given, and its S with 15 columns for each of them."""
    keys = [split_key(key) for key in conditional.later]
    later = sorted({index for _, index in keys})
    first = {index: SIZE * n for n, index in enumerate(later)}
    S = np.zeros((len(conditional.S), SIZE * len(later)))
    columns = [first[index] + column for letter, index in keys for column in PLACES[letter]]
    S[:, columns] = conditional.S
    return later, S
