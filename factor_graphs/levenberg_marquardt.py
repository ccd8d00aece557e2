"""Levenberg-Marquardt over keyframes that relative poses bind, section by section of the drive.

GTSAM's optimiser finds the same to 1e-11 m, but holds all rows of the whole graph: 200 MB for a drive of 480 s with ten
keyframes per second.
"""

from collections.abc import Iterator, Sequence

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dtrtrs

from factor_graphs.elimination import PLACES, Group, by_sections, eliminate, shared_keys, split, split_key

Array = NDArray[np.float64]

# The damping of a step after one that does not help, how much it grows from there to the next, and the most.
LEAST_DAMPING, DAMPING_FACTOR, MOST_DAMPING = 1e-5, 10.0, 1e5
# The cost stands still, too, when it changes by less than this.
ABSOLUTE_TOLERANCE = 1e-5


def minimise(
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
            moved = values.retract(_step(parts, groups, values, damping))
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


def _step(
    parts: Sequence[gtsam.NonlinearFactorGraph],
    groups: Sequence[Group],
    values: gtsam.Values,
    damping: float,
) -> gtsam.VectorValues:
    """The damped step from these values: the groups eliminated in order, then solved for in reverse."""

    def linear() -> Iterator[gtsam.GaussianFactorGraph]:
        for part, keys in zip(parts, groups, strict=False):
            of_group = part.linearize(values)
            for key in keys if damping else ():
                size = len(_place(key))
                stays = np.sqrt(damping) * np.eye(size)
                of_group.add(key, stays, np.zeros(size), gtsam.noiseModel.Unit.Create(size))
            yield of_group

    net = list(eliminate(linear(), groups))
    found: dict[int, Array] = {}
    step = gtsam.VectorValues()
    for keys, one in zip(reversed(groups), reversed(net), strict=True):
        given = one.d - one.S @ np.concatenate([found[key] for key in one.later]) if one.later else one.d
        x, singular = dtrtrs(one.R, given)
        if singular:
            raise RuntimeError("the graph does not hold all keyframes")
        for key in keys:
            found[key], x = np.split(x, [len(_place(key))])
            step.insert(key, found[key])
    return step


def _place(key: int) -> range:
    return PLACES[split_key(key)[0]]
