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
    joint: dict[tuple[int, int], Array] = {}
    for i in reversed(range(k)):
        R, later, S = _conditional(net, i)
        own, _ = dtrtri(R)
        covariance = own @ own.T
        if later:
            W = own @ S
            cross = -W @ _joined(joint, later)
            covariance = covariance - cross @ W.T
            for n, j in enumerate(later):
                joint[i, j] = cross[:, 15 * n : 15 * n + 15]
                joint[j, i] = joint[i, j].T
        joint[i, i] = (covariance + covariance.T) / 2
    return np.array([joint[i, i] for i in range(k)])


def _joined(joint: dict[tuple[int, int], Array], keyframes: list[int]) -> Array:
    if len(keyframes) == 1:
        return joint[keyframes[0], keyframes[0]]
    return np.block([[joint[a, b] for b in keyframes] for a in keyframes])


def _conditional(net: gtsam.GaussianBayesNet, i: int) -> tuple[Array, list[int], Array]:
    """Keyframe i given later ones: R (15, 15) upper triangular, those keyframes, and S (15, 15 each)."""
    parts = [net.at(3 * i + n) for n in range(3)]
    keys = [[(key >> INDEX_BITS, key & (1 << INDEX_BITS) - 1) for key in part.keys()] for part in parts]  # noqa: SIM118
    later = sorted({index for row in keys for _, index in row} - {i})
    start = {index: 15 * (1 + n) for n, index in enumerate(later)} | {i: 0}
    columns = np.zeros((15, 15 * (1 + len(later))))
    for rows, part, row in zip(PLACES.values(), parts, keys, strict=True):
        matrix, column = np.hstack([part.R(), part.S()]), 0
        for letter, index in row:
            place, first = PLACES[letter], start[index]
            width = place.stop - place.start
            columns[rows, first + place.start : first + place.stop] = matrix[:, column : column + width]
            column += width
    return columns[:, :15], later, columns[:, 15:]
