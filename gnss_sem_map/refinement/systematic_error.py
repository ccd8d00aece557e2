"""How often the images err in all views alike: estimated from the map itself, without any truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from gnss_sem_map.refinement.potts_mrf import PottsSettings, mean_field
from gnss_sem_map.refinement.state import WHOLE_MAP, MapState, StepSettings

MOST = 0.5
"""A map that is wrong more often than right cannot tell."""
NEIGHBOURS = PottsSettings()


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
    with_neighbours = mean_field(voxels.keys, state.images, seen, NEIGHBOURS)
    called, by_geometry, by_neighbours = (
        scores[seen].argmax(axis=1) for scores in (state.images, state.scores, with_neighbours)
    )
    first, second = by_geometry != called, by_neighbours != called
    return replace(state, systematic_error=systematic_errors(first, second, state.observations[seen]))


def systematic_errors(
    first: NDArray[np.bool_], second: NDArray[np.bool_], looks: NDArray[np.floating]
) -> float:
    """Share of looks, 0 to 0.5, whose class is wrong however often the place is looked at: capture and recapture.

    `first` and `second` (v,) are the voxels in which two witnesses that know nothing of each other (say, geometry and
    neighbours) overrule the images; a voxel counts with its `looks` (v,). Of the errors that the second one finds, the
    first finds a share, and so it finds that share of all errors: all = first * second / both. Without a second witness
    what the one finds is all that is known.
    Source: Chapman, "Some properties of the hypergeometric distribution" (1951), which is unbiased for small numbers.
    """
    if not len(looks):
        return 0.0
    weight = looks / looks.mean()
    by_first, by_second, by_both = (float(weight[found].sum()) for found in (first, second, first & second))
    errors = (by_first + 1) * (by_second + 1) / (by_both + 1) - 1
    return min(errors / len(looks), MOST)


def doubted(
    probabilities: NDArray[np.float32], systematic: float | NDArray[np.float32]
) -> NDArray[np.float32]:
    """Class probabilities (v, c) where all views may err alike, and then any class is as likely as another.

    `systematic` is the share of such errors, one for all or (v, 1).
    """
    uniform = np.float32(1 / probabilities.shape[1])
    return np.asarray(probabilities + systematic * (uniform - probabilities), np.float32)
