"""Systematic (view-correlated) label errors: their rate, estimated from the map itself, without ground truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from gnss_sem_map.refinement.potts_mrf import PottsSettings, mean_field
from gnss_sem_map.refinement.state import WHOLE_MAP, MapState, StepSettings

MOST = 0.5
"""Upper limit of the estimate."""
COUPLING_NAT: float = PottsSettings().coupling_nat


class SystematicErrorSettings(StepSettings):
    """How often images err in all views alike."""

    rate: float | None = Field(
        default=None,
        ge=0,
        le=0.5,
        description="Share of observations that are wrong in all views alike, so that looking again makes no voxel"
        " surer; default: estimated from the map itself, by how often geometry and neighbours overrule the images.",
    )


def reach_m(settings: SystematicErrorSettings, voxel_size_m: float) -> float:
    """One figure for the whole map."""
    return WHOLE_MAP


def apply(state: MapState, settings: SystematicErrorSettings) -> MapState:
    """What is set, or what geometry and neighbours, each for itself, say of the images."""
    if settings.rate is not None:
        return replace(state, systematic_error=settings.rate)
    voxels, seen = state.voxels, state.voxels.observed
    with_neighbours = mean_field(voxels.keys, state.images, seen, COUPLING_NAT)
    called, by_geometry, by_neighbours = (
        scores[seen].argmax(axis=1) for scores in (state.images, state.scores, with_neighbours)
    )
    first, second = by_geometry != called, by_neighbours != called
    return replace(state, systematic_error=systematic_errors(first, second, state.observations[seen]))


def systematic_errors(
    first: NDArray[np.bool_], second: NDArray[np.bool_], observations: NDArray[np.floating]
) -> float:
    """Share of observations, 0 to 0.5, that are wrong in all views alike, by capture and recapture.

    `first` and `second` (v,) are the voxels in which two independent sources (geometry and neighbours) overrule the
    images; a voxel is weighted with its `observations` (v,). The first source finds the same share of all errors as of
    those that the second one finds: all = first * second / both. With one source only, its errors are the estimate.
    Source: Chapman, "Some properties of the hypergeometric distribution" (1951), which is unbiased for small numbers.
    """
    if not len(observations):
        return 0.0
    weight = observations / observations.mean()
    by_first, by_second, by_both = (float(weight[found].sum()) for found in (first, second, first & second))
    errors = (by_first + 1) * (by_second + 1) / (by_both + 1) - 1
    return min(errors / len(observations), MOST)


def doubted(
    probabilities: NDArray[np.float32], systematic: float | NDArray[np.float32]
) -> NDArray[np.float32]:
    """Class probabilities (v, c), mixed with the uniform distribution by the rate of systematic errors.

    `systematic` is that rate, one for all or (v, 1).
    """
    uniform = np.float32(1 / probabilities.shape[1])
    return np.asarray(probabilities + systematic * (uniform - probabilities), np.float32)
