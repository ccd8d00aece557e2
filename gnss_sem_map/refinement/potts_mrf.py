"""Space as evidence: neighbouring voxels tend to be of one class (mean field of a Potts model)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numba import njit, uint64
from numpy.typing import NDArray
from pydantic import Field

from gnss_sem_map.refinement.neighbours import pairs_of_neighbours
from gnss_sem_map.refinement.state import MapState, Scores, StepSettings
from gnss_sem_map.voxels.voxel_map import softmax

LEAST_PROBABILITY = 1e-12
TEMPER = 0.5
"""A voxel's own evidence is multiplied by this, or neighbours have no say."""
ITERATIONS = 5
"""Mean-field updates, all voxels at once; each reaches one voxel farther."""


class PottsSettings(StepSettings):
    """How much the neighbours of a voxel have to say."""

    coupling_nat: float = Field(
        default=0.3, ge=0, description="What a neighbour that is sure of a class adds to it, nat."
    )


def reach_m(settings: PottsSettings, voxel_size_m: float) -> float:
    """One voxel per iteration."""
    return ITERATIONS * voxel_size_m


def apply(state: MapState, settings: PottsSettings) -> MapState:
    """Neighbours as evidence for each other; see `mean_field`."""
    voxels = state.voxels
    return replace(
        state, scores=mean_field(voxels.keys, state.scores, voxels.observed, settings.coupling_nat)
    )


def mean_field(
    keys: NDArray[np.int64],
    scores: Scores,
    observed: NDArray[np.bool_],
    coupling_nat: float,
    temper: float = TEMPER,
    iterations: int = ITERATIONS,
) -> Scores:
    """Log probabilities (v, c) in which every voxel has received messages from its 26 neighbours.

    `keys` (v,) sorted packed voxels, `scores` (v, c) log scores; what no camera `observed` (v,) has no say and stays as
    it is. q = softmax(U + coupling * sum of q over the neighbours), U = temper * scores, starting from softmax(U).
    Source: Krähenbühl, Koltun, "Efficient inference in fully connected CRFs" (2011), with neighbours only.
    """
    seen = np.flatnonzero(observed)
    if len(seen) == 0:
        return scores
    own = np.float32(temper) * scores[seen]
    pairs = pairs_of_neighbours(keys[seen])
    q = softmax(own)
    for _ in range(iterations):
        messages = np.zeros_like(q)
        sum_of_neighbours(pairs, q, messages, tuple(range(q.shape[1])))
        _add_scaled(own, np.float32(coupling_nat), messages)
        q = softmax(messages)
    result = scores.copy()
    result[seen] = np.log(np.maximum(q, LEAST_PROBABILITY))
    return result


@njit(cache=True, nogil=True)
def sum_of_neighbours(pairs, q, messages, classes):
    """Add q (v, c) of the neighbours of every voxel to its messages (v, c); a tuple of classes is unrolled."""
    for pair in range(len(pairs)):
        i, j = uint64(pairs[pair, 0]), uint64(pairs[pair, 1])
        for c in classes:
            messages[i, c] += q[j, c]
            messages[j, c] += q[i, c]


@njit(cache=True, nogil=True)
def _add_scaled(own, coupling, messages):
    """Own evidence (v, c), plus messages times their coupling, in place of the messages."""
    for i in range(len(own)):
        for c in range(own.shape[1]):
            messages[i, c] = own[i, c] + coupling * messages[i, c]
