"""Count grids (section 3.3.1): a column of voxels is building or vegetation as a whole, more or less."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Literal

import numpy as np
from numba import int64, njit
from numpy.typing import NDArray
from pydantic import Field
from scipy.special import gammaln

from gnss_sem_map.labels.roles import Role
from gnss_sem_map.process.machine import threads
from gnss_sem_map.process.thread_pools import thread_pool
from gnss_sem_map.refinement.figures import FIXED_POINT, PSEUDO_COUNTS, Sums
from gnss_sem_map.refinement.state import MapState, StepSettings, classes_of
from gnss_sem_map.voxels.kernels import AXIS_BITS, AXIS_MASK

WHOLE_COLUMN = 1 << 21
"""Layer height, in voxels, that holds every column in one layer."""
THREADS = threads()
LEAST_AT_ONCE = 1 << 18
"""Fewer voxels are not worth a thread."""
OWN_LIMIT_NAT = 1.0
"""A voxel's own evidence counts at most this much: a column may then overrule it."""


class CountGridSettings(StepSettings):
    """How the voxels above and below speak for building or vegetation."""

    method: Literal["evidence", "paper"] = Field(
        default="evidence", description="Weigh a column's labels, or overwrite them as section 3.3.1 does."
    )
    cell_m: float = Field(
        default=1.0, gt=0, le=20, description="Edge of a cell of the count grid, m (the paper: one voxel)."
    )
    reach_m: float = Field(
        default=4.0,
        gt=0,
        description="Voxels at most about this much higher or lower count, m: votes stay within one storey.",
    )
    error_rate: float = Field(
        default=0.2,
        gt=0,
        lt=0.5,
        description="Method `paper`: share of building and vegetation voxels that are labelled wrongly.",
    )


def reach_m(settings: CountGridSettings, voxel_size_m: float) -> float:
    """A cell wide; the paper's are one voxel."""
    return settings.cell_m if settings.method == "evidence" else voxel_size_m


def apply(state: MapState, settings: CountGridSettings) -> MapState:
    """Building against vegetation, column by column (eq. 8 to 11)."""
    voxels, scores, labels = state.voxels, state.scores, state.labels
    first, second = classes_of(voxels.label_set, Role.BUILDING, Role.VEGETATION)
    if settings.method == "paper":
        prior = state.figures.building_log_odds
        log_odds = paper_log_odds(voxels.keys, labels, (first, second), settings, prior)
    else:
        own = scores[:, first] - scores[:, second]
        rate = state.figures.column_error_rate
        log_odds = evidence_log_odds(
            voxels.keys, labels, own, (first, second), _columns(state, settings), rate
        )
    undecided = (labels == first) | (labels == second)
    return replace(state, scores=decide(scores, undecided, (first, second), log_odds))


def measure(state: MapState, settings: CountGridSettings, own: NDArray[np.bool_]) -> Sums:
    """How often two voxels of one column disagree, at a map's `own` voxels (v,), and the number of either class."""
    labels = state.labels
    first, second = classes_of(state.voxels.label_set, Role.BUILDING, Role.VEGETATION)
    is_first, is_second = own & (labels == first), own & (labels == second)
    sums = Sums(buildings=int(is_first.sum()), vegetation=int(is_second.sum()))
    if settings.method == "paper":
        return sums
    counts = count_grid(state.voxels.keys, labels, (first, second), *_columns(state, settings))
    return sums + pairs(counts[is_first | is_second])


def pairs(counts: NDArray[np.int32]) -> Sums:
    """How many pairs of voxels disagree, where (v, 2) of two classes stand in the column of each of v voxels.

    Every voxel of n counts once: n voxels with n1 n2 / n of the pairs that disagree.
    """
    first, second = counts.T.astype(np.int64)
    both = first + second
    disagreeing = np.rint(2 * FIXED_POINT * first * second / np.maximum(both, 1)).astype(np.int64)
    return Sums(
        column_pairs=int(np.maximum(both - 1, 0).sum()), disagreeing_pairs=int(disagreeing[both > 1].sum())
    )


def _columns(state: MapState, settings: CountGridSettings) -> tuple[int, int, int]:
    """Edge and height of a cell of the grid, in voxels, and layers to each side that count."""
    cell = max(round(settings.cell_m / state.voxels.voxel_size_m), 1)
    return cell, cell, max(round(settings.reach_m / settings.cell_m), 0)


def count_grid(
    keys: NDArray[np.int64],
    labels: NDArray[np.int8],
    classes: tuple[int, int],
    cell_voxels: int,
    layer_voxels: int = WHOLE_COLUMN,
    reach_layers: int = 0,
) -> NDArray[np.int32]:
    """How many voxels of each of two classes stand in every voxel's column (eq. 8): (v, 2).

    `keys` (v,) sorted packed voxels, `labels` (v,). On 51 million voxels this takes an eighth of the time that
    `np.bincount` takes, see `benchmarks/refinement.py`. A column is a square of `cell_voxels`, whole or, with
    `layer_voxels`, the layers within `reach_layers` of the voxel's own.
    """
    votes, counts = np.zeros((256, 2), np.int32), np.empty((len(keys), 2), np.int32)
    for k in (0, 1):
        votes[np.uint8(classes[k]), k] = 1
    pairs = [array.view(np.int64)[:, 0] for array in (votes, counts)]  # two counts add as one integer

    def count(part: slice) -> None:
        _count(
            keys[part], labels.view(np.uint8)[part], pairs[0], cell_voxels, layer_voxels, reach_layers, pairs[1][part]
        )  # fmt: skip

    slabs = list(_slabs(keys, cell_voxels))
    if len(slabs) == 1:
        count(slabs[0])
        return counts
    with thread_pool(THREADS) as pool:
        list(pool.map(count, slabs))  # a list: raises what a slab raised
    return counts


def _slabs(keys: NDArray[np.int64], cell: int) -> Iterator[slice]:
    """Parts of the sorted voxels, no fewer than the threads, that no cell is in two of."""
    start = 0
    while start < len(keys):
        last = keys[min(start + max(len(keys) // THREADS, LEAST_AT_ONCE), len(keys)) - 1]
        end = int(np.searchsorted(keys, _last_beside(last, cell), side="right"))
        yield slice(start, end)
        start = end


@njit(cache=True, nogil=True, error_model="numpy")
def _ends(keys, layer):
    """Ends of the runs of sorted voxels that share a column and a layer: (r + 1,), from 0."""
    ends = np.zeros(len(keys) + 1, np.int64)
    count, i = 0, 0
    while i < len(keys):
        z = keys[i] & AXIS_MASK
        last = keys[i] - z + min((z // layer + 1) * layer - 1, AXIS_MASK)
        while i + 8 <= len(keys) and keys[i + 7] <= last:  # keys are sorted: the eighth decides for eight
            i += 8
        while i < len(keys) and keys[i] <= last:
            i += 1
        count += 1
        ends[count] = i
    return ends[: count + 1]


@njit(cache=True, nogil=True)
def _last_beside(key, cell):
    """The largest key in the same cells along x: the first one past them may be too large for 64 bits."""
    x = ((key >> (2 * AXIS_BITS)) // cell + 1) * cell - 1
    return min(x, AXIS_MASK) << (2 * AXIS_BITS) | ((1 << (2 * AXIS_BITS)) - 1)


@njit(cache=True, nogil=True)
def _count(keys, labels, votes, cell, layer, reach, counts):
    """One slab of cells at a time, run by run, on a grid of its cells (y, z) with room for the reach."""
    start = 0
    while start < len(keys):
        last = _last_beside(keys[start], cell)
        slab = slice(start, start + np.searchsorted(keys[start:], last, side="right"))
        start = slab.stop
        _count_slab(
            keys[slab], labels[slab], votes, cell, layer, reach, _ends(keys[slab], layer), counts[slab]
        )


@njit(cache=True, nogil=True, error_model="numpy")
def _count_slab(keys, labels, votes, cell, layer, reach, ends, counts):
    runs = len(ends) - 1
    y, z = np.empty(runs, np.int64), np.empty(runs, np.int64)
    low_y = low_z = AXIS_MASK
    high_y = high_z = 0
    for run in range(runs):
        y[run] = ((keys[ends[run]] >> AXIS_BITS) & AXIS_MASK) // cell
        z[run] = (keys[ends[run]] & AXIS_MASK) // layer
        low_y, high_y = min(low_y, y[run]), max(high_y, y[run])
        low_z, high_z = min(low_z, z[run]), max(high_z, z[run])
    low_z -= reach
    grid = np.zeros((high_y - low_y + 1, high_z + reach - low_z + 1), np.int64)
    for run in range(runs):
        pair = int64(0)
        for label in labels[ends[run] : ends[run + 1]]:
            pair += votes[label]
        grid[y[run] - low_y, z[run] - low_z] += pair
    for run in range(runs):
        layers = grid[y[run] - low_y, z[run] - low_z - reach : z[run] - low_z + reach + 1]
        counts[ends[run] : ends[run + 1]] = layers.sum()


def paper_log_odds(
    keys: NDArray[np.int64],
    labels: NDArray[np.int8],
    classes: tuple[int, int],
    settings: CountGridSettings,
    prior: float,
) -> NDArray[np.float64]:
    """Log odds of the first class against the second for every voxel's column (eq. 8 to 10): (v,).

    The paper names neither factor of eq. 9. Here the `prior` log odds are those of each class's share of the voxels of
    both, and the likelihood says that every voxel of a column is an independent observation, wrong at `error_rate`.
    """
    first, second = count_grid(keys, labels, classes, cell_voxels=1).T
    return np.asarray(prior + (first - second) * np.log(1 / settings.error_rate - 1), np.float64)


def evidence_log_odds(
    keys: NDArray[np.int64],
    labels: NDArray[np.int8],
    own: NDArray[np.float32],
    classes: tuple[int, int],
    columns: tuple[int, int, int],
    error_rate: float,
) -> NDArray[np.float64]:
    """Log odds of the first class against the second for every voxel, from its column and itself: (v,).

    `own` (v,) nat is what the voxel's own evidence says; `columns` are the last three arguments of `count_grid`.

    Prior: flat. Likelihood of the *other* voxels' labels: beta-binomial. In a column of one class the share
    of right labels is not a constant but itself random, Beta(a, b), since one bad view spoils a column as a
    whole; so a hundred voxels of one opinion count far less than a hundred independent ones. a + b is fixed, and
    b = `error_rate` (a + b). With a = 2, b = 1 the log odds are ln((n1 + 1) / (n2 + 1)).
    """
    counts = count_grid(keys, labels, classes, *columns)
    others = [np.maximum(counts[:, k] - (labels == classes[k]), 0) for k in (0, 1)]
    by_count = _log_gamma_ratio(int(counts.max(initial=0)), error_rate)
    return np.asarray(np.clip(own, -OWN_LIMIT_NAT, OWN_LIMIT_NAT) + by_count[others[0]] - by_count[others[1]])


def _log_gamma_ratio(most: int, error_rate: float) -> NDArray[np.float64]:
    """ln Gamma(n + a) - ln Gamma(n + b) for n from 0 to `most`."""
    n, b = np.arange(most + 1), PSEUDO_COUNTS * error_rate
    return np.asarray(gammaln(n + PSEUDO_COUNTS - b) - gammaln(n + b), np.float64)


def decide(
    scores: NDArray[np.float32],
    candidates: NDArray[np.bool_],
    classes: tuple[int, int],
    log_odds: NDArray[np.float64],
) -> NDArray[np.float32]:
    """Log scores (v, c) where the candidates' two classes differ by the log odds; the better keeps its score."""
    refined, rows, (first, second) = scores.copy(), np.flatnonzero(candidates), classes
    best, odds = np.maximum(scores[rows, first], scores[rows, second]), log_odds[rows]
    refined[rows, first] = best + np.minimum(odds, 0)
    refined[rows, second] = best - np.maximum(odds, 0)
    return refined
