"""Forward-backward separation: how far a solution of what was before and one of what comes after lie apart.

As post-processing of inertial navigation shows it. Both are of the graph's own factors, linearised at its solution:
forward of those up to a keyframe, its own fix included, backward of those from it on, without its own. So their errors
are independent, and the separation scatters as both covariances together say, where these are honest. Joined, the two
are the solution. Factors that span the keyframe are in neither; mounting and wheels are held.
"""

from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from factor_graphs.elimination import (
    OF_KEYFRAME,
    SIZE,
    Group,
    ordering_of,
    shared_keys,
    split_key,
    state_keys,
)
from factor_graphs.measurements import ImuNoise
from factor_graphs.model import from_values

Array = NDArray[np.float64]

# The backward solution begins knowing no more than this: rad, m, m/s.
LOOSE = (1.0, 1e3, 1e2)
# What all keyframes share is held as if known to this.
HELD = 1e-6


@dataclass(frozen=True, eq=False)
class Separation:
    """Forward less backward, and the standard deviations of that: east, north, up m, turn about up rad.

    `stamps` (k,) s of the keyframes, `off` and `stddevs` (k, 4).
    """

    stamps: Array
    off: Array
    stddevs: Array


def separation_of(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, stamps: Array, noise: ImuNoise
) -> Separation:
    """The separation at k keyframes of a graph at its solution; `noise` tells what is known of biases before."""
    k = len(stamps)
    T, _, biases = from_values(values, k)
    linear = graph.linearize(values)
    factors = [linear.at(n) for n in range(linear.size())]
    spans = np.array([_span(factor, k) for factor in factors])
    stddevs = np.repeat([*LOOSE, noise.accelerometer_bias_stddev, noise.gyroscope_bias_stddev], 3)
    mean, A = np.concatenate([np.zeros(9), -biases[-1]]), np.diag(1 / stddevs)
    x, v, b = state_keys(k - 1)
    at_end = gtsam.JacobianFactor(x, A[:, :6], v, A[:, 6:9], b, A[:, 9:], A @ mean, _unit(SIZE))
    sizes = {key: len(values.atVector(key)) for key in shared_keys(values, k)}
    held = [gtsam.JacobianFactor(key, np.eye(n) / HELD, np.zeros(n), _unit(n)) for key, n in sizes.items()]
    means, covariances = _swept(factors, spans, k, held)
    # the same, counted from the last keyframe on
    after = _swept(factors, k - 1 - spans[:, ::-1], k, [*held, at_end], is_backward=True)
    means, covariances = means - after[0][::-1], covariances + after[1][::-1]
    R = T[:, :3, :3]
    rows = np.zeros((k, 4, SIZE))
    rows[:, :3, 3:6], rows[:, 3, :3] = R, R[:, 2]
    variances = np.einsum("kij,kjl,kil->ki", rows, covariances, rows)
    return Separation(stamps, np.einsum("kij,kj->ki", rows, means), np.sqrt(variances))


def _span(factor: gtsam.GaussianFactor, k: int) -> tuple[int, int]:
    """First and last keyframe of a factor; k for one of what all k keyframes share alone."""
    numbers = [i for i in (split_key(key)[1] for key in list(factor.keys())) if i < k] or [k]
    return min(numbers), max(numbers)


def _unit(size: int) -> gtsam.noiseModel.Unit:
    return gtsam.noiseModel.Unit.Create(size)


def _swept(
    factors: list[gtsam.GaussianFactor],
    spans: NDArray[np.int_],
    k: int,
    known: list[gtsam.JacobianFactor],
    is_backward: bool = False,
) -> tuple[Array, Array]:
    """Error (k, 15) and covariance (k, 15, 15) of every keyframe by what is `known` and the factors of those up to it.

    `spans` (n, 2) are the first and the last keyframe of each factor, in the order of the sweep. Backward, a factor of
    a keyframe alone counts for those behind it. A keyframe is eliminated when no factor to come needs it.
    """
    first, last = spans.T
    needed = np.arange(k + 1)
    np.maximum.at(needed, first, last)
    order = np.lexsort((first == last, last))
    bounds = np.searchsorted(last[order], np.arange(k + 1))
    means, covariances = np.empty((k, SIZE)), np.empty((k, SIZE, SIZE))
    active, graph = list[int](), gtsam.GaussianFactorGraph()
    shared = {key for one in known for key in list(one.keys()) if split_key(key)[0] not in OF_KEYFRAME}
    for one in known:
        graph.push_back(one)
    for n in range(k):
        here = order[bounds[n] : bounds[n + 1]].tolist()
        alone = [f for f in here if is_backward and first[f] == last[f]]
        for f in here[: len(here) - len(alone)]:
            graph.push_back(factors[f])
        if done := [j for j in active if needed[j] <= n]:
            keys = [key for j in done for key in _keys(j, k, is_backward)]
            _, left = gtsam.EliminateQR(graph, ordering_of(keys))
            graph = gtsam.GaussianFactorGraph()
            graph.push_back(left)
        active = [j for j in active if needed[j] > n] + [n]
        keys = [*shared, *(key for j in active for key in _keys(j, k, is_backward))]
        means[n], covariances[n] = _of_last(graph.augmentedJacobian(ordering_of(keys)))
        for f in alone:
            graph.push_back(factors[f])
    return means, covariances


def _keys(n: int, k: int, is_backward: bool) -> Group:
    return state_keys(k - 1 - n if is_backward else n)


def _of_last(rows: Array) -> tuple[Array, Array]:
    """Mean and covariance of the last SIZE unknowns of the least-squares problem A x = b, by its rows [A b]."""
    R = np.asarray(np.linalg.qr(rows, mode="r"))[: rows.shape[1] - 1][-SIZE:]
    inverse = np.linalg.inv(R[:, -SIZE - 1 : -1])
    return inverse @ R[:, -1], inverse @ inverse.T
