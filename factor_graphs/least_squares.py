"""Least squares over the keyframes of a drive: Gauss-Newton, and Levenberg-Marquardt where steps must be damped.

The graph of every step is linearised and eliminated by QR keyframe by keyframe. GTSAM's optimisers find the same to
1e-11 m, but hold all rows of the whole graph, 200 MB for a drive of 480 s with ten keyframes per second; and what all
keyframes share costs them time that grows with the square of the drive.
"""

from collections.abc import Iterator, Sequence

import gtsam
import numpy as np

from factor_graphs.elimination import (
    PLACES,
    Group,
    by_sections,
    eliminate,
    in_time,
    shared_keys,
    split,
    split_key,
)

# The damping of a step after one that does not help, how much it grows from there to the next, and the most.
LEAST_DAMPING, DAMPING_FACTOR, MOST_DAMPING = 1e-5, 10.0, 1e5
# The cost stands still, too, when it changes by less than this.
ABSOLUTE_TOLERANCE = 1e-5


def gauss_newton(
    graph: gtsam.NonlinearFactorGraph, start: gtsam.Values, k: int, limit: int, tolerance: float
) -> tuple[gtsam.Values, int] | None:
    """Undamped steps, until one gains what the linear graph says that it gains; None where one gains nothing.

    Where the two agree to `tolerance` of the cost, the next step would hardly gain more than that: it need not be made
    to see it. Not for a graph of k keyframes that relative poses bind: it has directions in which a centimetre costs
    less than the tolerance. Returns the values and the number of steps.
    """
    involved = graph.keys()
    groups = in_time(k, tuple(key for key in shared_keys(start, k) if involved.count(key)))
    parts = split(graph, groups)
    values, cost = start, graph.error(start)
    try:
        for iteration in range(1, limit + 1):
            net = _eliminated(parts, groups, values)
            expected, before = net.error(values.zeroVectors()), cost
            values = values.retract(net.optimize())
            cost = graph.error(values)
            if not cost <= before:
                return None
            if abs(before - cost - expected) <= tolerance * cost:
                return values, iteration
    except RuntimeError:  # a graph that only damping makes regular
        return None
    return None


def levenberg_marquardt(
    graph: gtsam.NonlinearFactorGraph, start: gtsam.Values, k: int, limit: int, tolerance: float
) -> tuple[gtsam.Values, int]:
    """The values of least cost of a graph of k keyframes, and the number of iterations; `limit` if it is not found.

    They are found when the cost changes by less than `tolerance` of itself. Raises RuntimeError where the equations
    have no solution.
    """
    groups = by_sections(graph, k, shared_keys(start, k))
    parts = split(graph, groups)
    values, cost, damping = start, graph.error(start), 0.0
    for iteration in range(1, limit):
        while True:
            moved = values.retract(_eliminated(parts, groups, values, damping).optimize())
            gained = cost - graph.error(moved)
            if gained > 0.0:
                break
            if abs(gained) <= tolerance * cost or damping >= MOST_DAMPING:
                return values, iteration
            damping = max(LEAST_DAMPING, DAMPING_FACTOR * damping)
        stands_still = gained <= max(tolerance * cost, ABSOLUTE_TOLERANCE)
        values, cost = moved, cost - gained
        damping = damping / DAMPING_FACTOR if damping > LEAST_DAMPING else 0.0
        if stands_still:
            return values, iteration
    return values, limit


def _eliminated(
    parts: Sequence[gtsam.NonlinearFactorGraph],
    groups: Sequence[Group],
    values: gtsam.Values,
    damping: float = 0.0,
) -> gtsam.GaussianBayesNet:
    """The graph linearised at these values and damped, as conditionals in the order of the groups."""

    def linear() -> Iterator[gtsam.GaussianFactorGraph]:
        for part, keys in zip(parts, groups, strict=False):
            of_group = part.linearize(values)
            for key in keys if damping else ():
                size = len(PLACES[split_key(key)[0]])
                stays = np.sqrt(damping) * np.eye(size)
                of_group.add(key, stays, np.zeros(size), gtsam.noiseModel.Unit.Create(size))
            yield of_group

    net = gtsam.GaussianBayesNet()
    for conditional in eliminate(linear(), groups):
        net.push_back(conditional)
    return net
