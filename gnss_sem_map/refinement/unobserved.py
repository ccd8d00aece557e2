"""Voxels that no camera saw, labelled from their neighbours and marked as inferred."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from gnss_sem_map.refinement.neighbours import pairs_of_neighbours
from gnss_sem_map.refinement.potts_mrf import sum_of_neighbours
from gnss_sem_map.refinement.state import MapState, Scores, StepSettings
from gnss_sem_map.voxels.voxel_map import softmax

COUPLING_NAT = 0.3
"""What a neighbour that is sure of a class says for it: little, so that what is inferred stays unsure."""


class UnobservedSettings(StepSettings):
    """How far labels spread to what no camera saw."""

    enabled: bool = Field(default=False, description="Whether this step is done.")
    iterations: int = Field(default=5, ge=1, le=100, description="Each reaches one voxel farther.")


def reach_m(settings: UnobservedSettings, voxel_size_m: float) -> float:
    """One voxel per iteration."""
    return settings.iterations * voxel_size_m


def apply(state: MapState, settings: UnobservedSettings) -> MapState:
    """Repeat what the 26 neighbours say, observed ones first."""
    scores, inferred = infer(state.voxels.keys, state.scores, state.voxels.observed, settings)
    return replace(state, scores=scores, inferred=inferred)


def infer(
    keys: NDArray[np.int64], scores: Scores, observed: NDArray[np.bool_], settings: UnobservedSettings
) -> tuple[Scores, NDArray[np.bool_]]:
    """Log scores (v, c) in which voxels without an observation repeat what their 26 neighbours say, and which (v,) do.

    Messages come from observed neighbours first, then from inferred ones.
    """
    scores, known, pairs = scores.copy(), observed.copy(), pairs_of_neighbours(keys)
    for _ in range(settings.iterations):
        q = np.where(known[:, None], softmax(scores), np.float32(0))
        messages = np.zeros_like(q)
        sum_of_neighbours(pairs, q, messages, tuple(range(q.shape[1])))
        reached = ~known & messages.any(axis=1)
        if not reached.any():
            break
        scores[reached] = np.float32(COUPLING_NAT) * messages[reached]
        known |= reached
    return scores, known & ~observed
