"""Count grids (section 3.3.1): a column of voxels is building or vegetation as a whole, more or less."""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Literal

import numpy as np
from numba import int64, njit
from numpy.typing import NDArray
from pydantic import Field
from scipy.special import gammaln

from gnss_sem_map.refinement.state import WHOLE_MAP, MapState, StepSettings, classes_of
from gnss_sem_map.voxels.kernels import AXIS_BITS, AXIS_MASK

WHOLE_COLUMN = 1 << 21
"""Layer height, in voxels, that holds every column in one layer."""
THREADS = os.cpu_count() or 1
LEAST_AT_ONCE = 1 << 18
"""Fewer voxels are not worth a thread."""
LEAST_ERROR_RATE, MOST_ERROR_RATE = 0.05, 1 / 3
"""Limits of the error rate that is estimated from the map: self-agreement is not accuracy."""

OWN_LIMIT_NAT = 1.0
"""A voxel's own evidence counts at most this much: a column may then overrule it."""
PSEUDO_COUNTS = 3.0
"""Overdispersion: a column's share of right labels is Beta with so many pseudo-counts, since views err as a whole."""


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
    """A cell wide; the paper's columns have no end in height, and evidence needs the map's own error rate."""
    return WHOLE_MAP


def apply(state: MapState, settings: CountGridSettings) -> MapState:
    """Building against vegetation, column by column (eq. 8 to 11)."""
    voxels, scores, labels = state.voxels, state.scores, state.labels
    first, second = classes_of(voxels.label_set, "building", "vegetation")
    if settings.method == "paper":
        log_odds = paper_log_odds(voxels.keys, labels, (first, second), settings)
    else:
        own = scores[:, first] - scores[:, second]
        log_odds = evidence_log_odds(voxels.keys, labels, own, (first, second), settings, voxels.voxel_size_m)
    undecided = np.isin(labels, (first, second))
    return replace(state, scores=decide(scores, undecided, (first, second), log_odds))


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

    with ThreadPoolExecutor(THREADS) as pool:
        list(pool.map(count, _slabs(keys, cell_voxels)))  # a list: raises what a slab raised
    return counts


def _slabs(keys: NDArray[np.int64], cell: int) -> Iterator[slice]:
    """Parts of the sorted voxels, no fewer than the threads, that no cell is in two of."""
    start = 0
    while start < len(keys):
        last = keys[min(start + max(len(keys) // THREADS, LEAST_AT_ONCE), len(keys)) - 1] >> (2 * AXIS_BITS)
        end = int(np.searchsorted(keys, (last // cell + 1) * cell << (2 * AXIS_BITS)))
        yield slice(start, end)
        start = end


@njit(cache=True, nogil=True, error_model="numpy")
def _ends(keys, layer):
    """Ends of the runs of sorted voxels that share a column and a layer: (r + 1,), from 0."""
    ends = np.zeros(len(keys) + 1, np.int64)
    count, i = 0, 0
    while i < len(keys):
        z = keys[i] & AXIS_MASK
        past = keys[i] - z + (z // layer + 1) * layer
        while i + 8 <= len(keys) and keys[i + 7] < past:  # keys are sorted: the eighth decides for eight
            i += 8
        while i < len(keys) and keys[i] < past:
            i += 1
        count += 1
        ends[count] = i
    return ends[: count + 1]


@njit(cache=True, nogil=True)
def _count(keys, labels, votes, cell, layer, reach, counts):
    """One slab of cells at a time, run by run, on a grid of its cells (y, z) with room for the reach."""
    start = 0
    while start < len(keys):
        past = ((keys[start] >> (2 * AXIS_BITS)) // cell + 1) * cell << (2 * AXIS_BITS)
        slab = slice(start, start + np.searchsorted(keys[start:], past))
        start = slab.stop
        _count_slab(
            keys[slab], labels[slab], votes, cell, layer, reach, _ends(keys[slab], layer), counts[slab]
        )


@njit(cache=True, nogil=True, error_model="numpy")
def _count_slab(keys, labels, votes, cell, layer, reach, ends, counts):
    runs = len(ends) - 1
    y, z = np.empty(runs, np.int64), np.empty(runs, np.int64)
    for run in range(runs):
        y[run] = ((keys[ends[run]] >> AXIS_BITS) & AXIS_MASK) // cell
        z[run] = (keys[ends[run]] & AXIS_MASK) // layer
    low_y, low_z = y.min(), z.min() - reach
    grid = np.zeros((y.max() - low_y + 1, z.max() + reach - low_z + 1), np.int64)
    for run in range(runs):
        pair = int64(0)
        for label in labels[ends[run] : ends[run + 1]]:
            pair += votes[label]
        grid[y[run] - low_y, z[run] - low_z] += pair
    for run in range(runs):
        layers = grid[y[run] - low_y, z[run] - low_z - reach : z[run] - low_z + reach + 1]
        counts[ends[run] : ends[run + 1]] = layers.sum()


def paper_log_odds(
    keys: NDArray[np.int64], labels: NDArray[np.int8], classes: tuple[int, int], settings: CountGridSettings
) -> NDArray[np.float64]:
    """Log odds of the first class against the second for every voxel's column (eq. 8 to 10): (v,).

    The paper names neither factor of eq. 9. Here the prior is each class's share of the voxels of both, and
    the likelihood says that every voxel of a column is an independent observation, wrong at `error_rate`.
    """
    first, second = count_grid(keys, labels, classes, cell_voxels=1).T
    total = [np.count_nonzero(labels == c) for c in classes]
    prior = np.log((total[0] + 1) / (total[1] + 1))
    return np.asarray(prior + (first - second) * np.log(1 / settings.error_rate - 1), np.float64)


def evidence_log_odds(
    keys: NDArray[np.int64],
    labels: NDArray[np.int8],
    own: NDArray[np.float32],
    classes: tuple[int, int],
    settings: CountGridSettings,
    voxel_size_m: float,
) -> NDArray[np.float64]:
    """Log odds of the first class against the second for every voxel, from its column and itself: (v,).

    `own` (v,) nat is what the voxel's own evidence says.

    Prior: flat. Likelihood of the *other* voxels' labels: beta-binomial. In a column of one class the share
    of right labels is not a constant but itself random, Beta(a, b), since one bad view spoils a column as a
    whole; so a hundred voxels of one opinion count far less than a hundred independent ones. a + b is fixed, and
    a and b follow from how often two voxels of one column of this map disagree, which is 2 a b / ((a + b) (a
    + b + 1)). With a = 2, b = 1 the log odds are ln((n1 + 1) / (n2 + 1)).
    """
    cell = max(round(settings.cell_m / voxel_size_m), 1)
    reach = max(round(settings.reach_m / settings.cell_m), 0)
    counts = count_grid(keys, labels, classes, cell, cell, reach).astype(np.float64)
    a, b = _beta_of(counts[np.isin(labels, classes)], PSEUDO_COUNTS)
    others = [np.maximum(counts[:, k] - (labels == classes[k]), 0) for k in (0, 1)]
    columns = (
        gammaln(others[0] + a) + gammaln(others[1] + b) - gammaln(others[0] + b) - gammaln(others[1] + a)
    )
    return np.asarray(np.clip(own, -OWN_LIMIT_NAT, OWN_LIMIT_NAT) + columns)


def _beta_of(counts: NDArray[np.float64], pseudo_counts: float) -> tuple[float, float]:
    """Beta(a, b) of a column's share of right labels, from how often pairs of its voxels disagree."""
    pairs = counts.sum(1) - 1
    # every voxel of n counts once: n voxels with n1 n2 / n of the pairs that disagree
    disagreeing = 2 * counts[:, 0] * counts[:, 1] / np.maximum(counts.sum(1), 1)
    disagreement = disagreeing[pairs > 0].sum() / max(pairs[pairs > 0].sum(), 1.0)
    product = disagreement * (pseudo_counts + 1) / (2 * pseudo_counts)
    error_rate = np.clip((1 - np.sqrt(max(1 - 4 * product, 0.0))) / 2, LEAST_ERROR_RATE, MOST_ERROR_RATE)
    return pseudo_counts * (1 - error_rate), pseudo_counts * error_rate


def decide(
    scores: NDArray[np.float32],
    candidates: NDArray[np.bool_],
    classes: tuple[int, int],
    log_odds: NDArray[np.float64],
) -> NDArray[np.float32]:
    """Log scores (v, c) where the candidates' two classes differ by the log odds; the better keeps its score."""
    refined = scores.copy()
    best = scores[:, classes].max(axis=1)
    refined[candidates, classes[0]] = (best + np.minimum(log_odds, 0))[candidates]
    refined[candidates, classes[1]] = (best - np.maximum(log_odds, 0))[candidates]
    return refined
