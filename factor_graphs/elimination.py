"""The graph of a drive eliminated by QR, keyframe by keyframe: what each one is, given those that come later.

A keyframe is one dense QR of its factors and of what the ones before it left, so time and memory grow with the length
of the drive. GTSAM's own eliminations hold all rows that they began with, 40 to 100 kB per keyframe.
"""

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TypeVar

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, M, V, W, X
from numpy.typing import NDArray

Array = NDArray[np.float64]
Graph = TypeVar("Graph", gtsam.NonlinearFactorGraph, gtsam.GaussianFactorGraph)
Group = tuple[int, ...]
"""Keys that are eliminated together: those of one keyframe, or of what all keyframes share."""

# Numbers of a keyframe: tangent of its pose, velocity, biases.
SIZE = 15
# A key of GTSAM holds its letter above so many bits of its index.
INDEX_BITS = 56
# Where pose, velocity and bias stand in the 15 numbers of a keyframe, mounting and wheels in those that all share.
OF_KEYFRAME = {ord("x"): range(6), ord("v"): range(6, 9), ord("b"): range(9, 15)}
PLACES = OF_KEYFRAME | {ord("m"): range(5), ord("w"): range(5, 9)}


@dataclass(frozen=True, eq=False)
class Conditional:
    """R x = d - S y: the numbers x of a group given those y of later ones.

    `later` are the keys of y, in the order of the columns of S; `parent` is the number of the group that is eliminated
    first of those which hold y, -1 where none does.
    """

    later: list[int]
    parent: int
    R: Array
    S: Array
    d: Array


def shared_keys(values: gtsam.Values, k: int) -> Group:
    """Keys of what all k keyframes share, where they are: the mounting of the IMU, the calibration of the wheels."""
    return tuple(key for key in (M(k), W(k)) if values.exists(key))


def in_time(k: int, last: Group = ()) -> list[Group]:
    """The keys of each of k keyframes in order of time, then those in `last`."""
    return [*map(state_keys, range(k)), *([last] if last else [])]


def by_sections(graph: gtsam.NonlinearFactorGraph, k: int, last: Group = ()) -> list[Group]:
    """As `in_time`, but a keyframe that factors bind to more than the next one waits for the next such keyframe.

    These are the anchors of LiDAR odometry. Eliminated before the keyframes that it leads to, an anchor would bind all
    of them to each other: on a drive of 480 s an iteration took twice as long.
    """
    first, reach = np.arange(k), np.arange(k)
    for n in range(graph.size()):
        keyframes = [i for letter, i in map(split_key, graph.at(n).keys()) if letter in OF_KEYFRAME]
        if keyframes:
            reach[min(keyframes)] = max(reach[min(keyframes)], max(keyframes))
    waits = reach > first + 1
    order = np.lexsort((first, waits, np.cumsum(waits)))
    return [*map(state_keys, order.tolist()), *([last] if last else [])]


def split(graph: Graph, groups: Sequence[Group]) -> list[Graph]:
    """The factors of a graph by the group in which they are first needed; last, those that no group needs."""
    first_needed, parts = _first_needed(groups), [type(graph)() for _ in range(len(groups) + 1)]
    # named, or the binding tries a factor as all that can be pushed: twice the time
    for factor in (graph.at(n) for n in range(graph.size())):
        parts[first_needed(list(factor.keys()))].push_back(factor=factor)
    return parts


def eliminate(
    parts: Iterable[gtsam.GaussianFactorGraph],
    groups: Sequence[Group],
    rest: list[gtsam.GaussianFactor] | None = None,
) -> Iterator[gtsam.GaussianConditional]:
    """Eliminate the groups in their order; `parts` as `split` makes them.

    What the groups leave of variables that are in none of them is appended to `rest`. Raises RuntimeError where GTSAM
    does.
    """
    first_needed = _first_needed(groups)
    left_for: defaultdict[int, list[gtsam.GaussianFactor]] = defaultdict(list)
    for n, (part, keys) in enumerate(zip(parts, groups, strict=False)):
        factors = gtsam.GaussianFactorGraph()
        factors.push_back(graph=part)
        for left in left_for.pop(n, []):
            factors.push_back(left)
        found, left = gtsam.EliminateQR(factors, ordering_of(keys))
        if later := list(found.keys())[len(keys) :]:
            left_for[first_needed(later)].append(left)
        yield found
    if rest is not None:
        rest += left_for[len(groups)]


def conditionals(
    parts: Iterable[gtsam.GaussianFactorGraph], groups: Sequence[Group]
) -> Iterator[Conditional]:
    """As `eliminate`, without what GTSAM's conditionals hold beside their numbers: half of the memory."""
    first_needed = _first_needed(groups)
    for keys, found in zip(groups, eliminate(parts, groups), strict=False):
        later = list(found.keys())[len(keys) :]
        rows = found.augmentedJacobian()
        size = len(rows)
        parent = first_needed(later) if later else -1
        yield Conditional(later, parent, rows[:, :size], rows[:, size:-1], rows[:, -1])


def _first_needed(groups: Sequence[Group]) -> Callable[[Iterable[int]], int]:
    """Tells which group needs some of these keys first; the number of groups where none does."""
    place = {key: n for n, keys in enumerate(groups) for key in keys}
    return lambda keys: min([place.get(key, len(groups)) for key in keys])


def state_keys(i: int) -> Group:
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
