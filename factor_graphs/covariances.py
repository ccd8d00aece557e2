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
from scipy.linalg import solve_triangular

Array = NDArray[np.float64]

# Where pose, velocity and bias stand in the 15 numbers of a keyframe.
PLACES = {"x": slice(0, 6), "v": slice(6, 9), "b": slice(9, 15)}


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
        own = solve_triangular(R, np.eye(15))
        covariance = own @ own.T
        if later:
            W = own @ S
            cross = -W @ np.block([[joint[a, b] for b in later] for a in later])
            covariance = covariance - cross @ W.T
            for n, j in enumerate(later):
                joint[i, j] = cross[:, 15 * n : 15 * n + 15]
                joint[j, i] = joint[i, j].T
        joint[i, i] = (covariance + covariance.T) / 2
    return np.array([joint[i, i] for i in range(k)])


def _conditional(net: gtsam.GaussianBayesNet, i: int) -> tuple[Array, list[int], Array]:
    """Keyframe i given later ones: R (15, 15) upper triangular, those keyframes, and S (15, 15 each)."""
    parts = [net.at(3 * i + n) for n in range(3)]
    symbols = [[gtsam.Symbol(key) for key in part.keys()] for part in parts]  # noqa: SIM118
    later = sorted({s.index() for row in symbols for s in row} - {i})
    columns = np.zeros((15, 15 * (1 + len(later))))
    for place, part, row in zip(PLACES.values(), parts, symbols, strict=True):
        matrix, start = np.hstack([part.R(), part.S()]), 0
        for symbol in row:
            there = PLACES[chr(symbol.chr())]
            width = there.stop - there.start
            offset = 0 if symbol.index() == i else 15 * (1 + later.index(symbol.index()))
            columns[place, offset + there.start : offset + there.stop] = matrix[:, start : start + width]
            start += width
    return columns[:, :15], later, columns[:, 15:]
