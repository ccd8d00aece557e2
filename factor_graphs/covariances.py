"""How far to believe every keyframe: its covariance, from a QR elimination of the whole graph.

GTSAM's `Marginals` goes through Cholesky, which squares the condition of the problem, and throws where a
stiff IMU meets a weak prior: an ordinary short drive. Here the graph is eliminated by QR, keyframe by
keyframe, into conditionals R x = d - S y on later keyframes y, and the covariances follow backwards:
cov(x) = R⁻¹ R⁻ᵀ + W cov(y) Wᵀ with W = R⁻¹ S (Kaess and Dellaert 2009).
"""

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X
from numpy.typing import NDArray
from scipy.linalg.lapack import dtrtri

Array = NDArray[np.float64]

# Numbers of a keyframe: tangent of its pose, velocity, biases.
SIZE = 15
# A key of GTSAM holds its letter above so many bits of its index.
INDEX_BITS = 56
# Where pose, velocity and bias stand in the 15 numbers of a keyframe.
PLACES = {ord("x"): slice(0, 6), ord("v"): slice(6, 9), ord("b"): slice(9, 15)}


def eliminate(graph: gtsam.GaussianFactorGraph, k: int, last: tuple[int, ...] = ()) -> gtsam.GaussianBayesNet:
    """The graph of k keyframes as conditionals, X V B of each in order, then the keys in `last`."""
    ordering = gtsam.Ordering()
    for i in range(k):
        for key in (X(i), V(i), B(i)):
            ordering.push_back(key)
    for key in last:
        ordering.push_back(key)
    return graph.eliminateSequential(ordering, gtsam.EliminateQR)


def keyframe_covariances(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, k: int) -> Array:
    """Covariance of (pose tangent, velocity, biases) of every keyframe, (k, 15, 15)."""
    net = eliminate(graph.linearize(values), k)
    covariances = np.empty((k, SIZE, SIZE))
    # The joint covariance of a keyframe and of those it depends on. The IMU binds each keyframe to the next, so those
    # of the one before it are among them, and memory does not grow with the drive.
    known: list[int] = []
    joint = np.empty((0, 0))
    for i in reversed(range(k)):
        R, later, S = _conditional(net, i)
        own, _ = dtrtri(R)
        W = own @ S
        joint = _of(later, known, joint)
        cross = -W @ joint
        covariance = own @ own.T - cross @ W.T
        covariances[i] = (covariance + covariance.T) / 2
        joint = np.vstack([np.hstack([covariances[i], cross]), np.hstack([cross.T, joint])])
        known = [i, *later]
    return covariances


def _of(keyframes: list[int], known: list[int], joint: Array) -> Array:
    """The joint covariance of some of the keyframes."""
    first = SIZE * np.array([known.index(i) for i in keyframes], np.intp)
    rows = (first[:, None] + np.arange(SIZE)).ravel()
    return np.asarray(joint[np.ix_(rows, rows)], np.float64)


def _conditional(net: gtsam.GaussianBayesNet, i: int) -> tuple[Array, list[int], Array]:
    """Keyframe i given later ones: R (15, 15) upper triangular, those keyframes, and S (15, 15 each)."""
    parts = [net.at(3 * i + n) for n in range(3)]
    keys = [[(key >> INDEX_BITS, key & (1 << INDEX_BITS) - 1) for key in part.keys()] for part in parts]  # noqa: SIM118
    later = sorted({index for row in keys for _, index in row} - {i})
    start = {index: SIZE * (1 + n) for n, index in enumerate(later)} | {i: 0}
    columns = np.zeros((SIZE, SIZE * (1 + len(later))))
    for rows, part, row in zip(PLACES.values(), parts, keys, strict=True):
        matrix, column = np.hstack([part.R(), part.S()]), 0
        for letter, index in row:
            place, first = PLACES[letter], start[index]
            width = place.stop - place.start
            columns[rows, first + place.start : first + place.stop] = matrix[:, column : column + width]
            column += width
    return columns[:, :SIZE], later, columns[:, SIZE:]
