"""How far to believe every keyframe: its covariance, from a QR elimination of the whole graph.

GTSAM's `Marginals` goes through Cholesky, which squares the condition of the problem, and throws where a
stiff IMU meets a weak prior: an ordinary short drive. Here the graph is eliminated by QR, keyframe by
keyframe, into conditionals R x = d - S y on later keyframes y, and the covariances follow backwards:
cov(x) = R⁻¹ R⁻ᵀ + W cov(y) Wᵀ with W = R⁻¹ S (Kaess and Dellaert 2009).
"""

from collections import Counter
from functools import cache
from itertools import pairwise
from typing import Protocol

import gtsam
import numpy as np
from gtsam.symbol_shorthand import M
from numpy.typing import NDArray
from scipy.linalg.lapack import dtrtri

from factor_graphs.elimination import (
    PLACES,
    SIZE,
    by_sections,
    conditionals,
    in_time,
    shared_keys,
    split,
    split_key,
)

Array = NDArray[np.float64]
Places = dict[int, NDArray[np.intp]]
"""Where the numbers of a key stand in a joint covariance."""


class Visitor(Protocol):
    """Sees every keyframe i of x_i = -W y + noise, with y at `rows` of those known before; now they are `known`.

    `joint` is the covariance of all that are known now: the keyframe, in its 15 numbers, then y.
    """

    def add(self, i: int, W: Array, rows: NDArray[np.intp], joint: Array, known: Places) -> None: ...


class SumVariance:
    """Variance of sums of G x over the keyframes of a window, and of G s of what all keyframes share.

    `rows` (k, m, 15) are G of every keyframe and `windows` (k,) its window, -1 for none; `of_shared` (w, m, 5) are G of
    the mounting. `found` (w, m) is known once `keyframe_covariances` has gone through all keyframes.
    """

    def __init__(self, rows: Array, windows: NDArray[np.intp], of_shared: Array) -> None:
        self.found = np.zeros(of_shared.shape[:2])
        self._rows, self._windows, self._of_shared = rows, windows, of_shared
        self._first = {int(w): int(i) for i, w in reversed(list(enumerate(windows))) if w >= 0}
        self._sum = np.zeros((rows.shape[1], rows.shape[1]))
        self._beside = np.empty((0, rows.shape[1]))
        """Covariance of the keyframes known, in their order, and the sum."""

    def add(self, i: int, W: Array, rows: NDArray[np.intp], joint: Array, known: Places) -> None:
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

    def _finish(self, window: int, joint: Array, known: Places) -> None:
        G, place = self._of_shared[window], known[M(len(self._windows))]
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
    net = list(conditionals(linear, groups))
    children = Counter(one.parent for one in net)
    covariances, of_shared = np.empty((k, SIZE, SIZE)), np.empty((0, 0))
    # The joint covariance of a group and of those it is given, as long as it has children to come: memory does not
    # grow with the drive. Of what a group is given, its parent is eliminated first, and is given all the rest.
    joints: dict[int, tuple[Places, Array]] = {-1: ({}, np.empty((0, 0)))}
    for n in range(len(net) - 1, -1, -1):
        one, keys = net.pop(), groups[n]
        (known, of_parent), size = joints[one.parent], len(one.R)
        rows = np.concatenate([known[key] for key in one.later]) if one.later else np.empty(0, np.intp)
        own, _ = dtrtri(one.R)
        W, given = own @ one.S, of_parent[rows[:, None], rows]
        cross = -W @ given
        covariance = own @ own.T - cross @ W.T
        joint = np.empty((size + len(rows),) * 2)
        joint[:size, :size] = (covariance + covariance.T) / 2
        joint[:size, size:], joint[size:, :size], joint[size:, size:] = cross, cross.T, given
        known = _places([*keys, *one.later])
        if keys == shared:
            of_shared = joint[:size, :size]
        else:
            i = split_key(keys[0])[1]
            covariances[i] = joint[:size, :size]
            if also is not None:
                also.add(i, W, rows, joint, known)
        joints[n] = known, joint
        children[one.parent] -= 1
        for m in (n, one.parent):
            if not children[m]:
                joints.pop(m, None)
    return covariances, of_shared


def _places(keys: list[int]) -> Places:
    """Where the numbers of each of these keys stand, when they are put one after the other."""
    return dict(zip(keys, _ranges(tuple([split_key(key)[0] for key in keys])), strict=True))


@cache
def _ranges(letters: tuple[int, ...]) -> list[NDArray[np.intp]]:
    ends = np.cumsum([0, *(len(PLACES[letter]) for letter in letters)]).tolist()
    return [np.arange(*both) for both in pairwise(ends)]
