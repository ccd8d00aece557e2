"""Systematic (view-correlated) label errors: their rate, estimated from the map itself, without ground truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from gnss_sem_map.refinement import potts_mrf
from gnss_sem_map.refinement.figures import FIXED_POINT, MOST_SYSTEMATIC, Sums
from gnss_sem_map.refinement.potts_mrf import PottsSettings, mean_field
from gnss_sem_map.refinement.state import MapState, Scores, StepSettings
from gnss_sem_map.voxels.voxel_map import best_classes

COUPLING_NAT: float = PottsSettings().coupling_nat


class SystematicErrorSettings(StepSettings):
    """How often images err in all views alike."""

    rate: float | None = Field(
        default=None,
        ge=0,
        le=MOST_SYSTEMATIC,
        description="Share of observations that are wrong in all views alike, so that looking again makes no voxel"
        " surer; default: estimated from the map itself, by how often geometry and neighbours overrule the images.",
    )


def reach_m(settings: SystematicErrorSettings, voxel_size_m: float) -> float:
    """A voxel alone, and one figure for the whole map."""
    return 0.0


def apply(state: MapState, settings: SystematicErrorSettings) -> MapState:
    """What is set, or what geometry and neighbours, each for itself, say of the images of the whole map."""
    rate = state.figures.systematic_error if settings.rate is None else settings.rate
    return replace(state, systematic_error=rate)


def measure(
    state: MapState, images: Scores, settings: SystematicErrorSettings, own: NDArray[np.bool_]
) -> Sums:
    """How often geometry and neighbours overrule the images in a map's `own` voxels (v,); see `counted`.

    `images` (v, c) is what these alone say, the scores of `state` what geometry says as well.
    """
    if settings.rate is not None:
        return Sums()
    voxels, seen = state.voxels, state.voxels.observed & own
    with_neighbours = mean_field(voxels.keys, images, voxels.observed, COUPLING_NAT)
    called, by_geometry, by_neighbours = (
        best_classes(scores, seen) for scores in (images, state.scores, with_neighbours)
    )
    first, second = by_geometry != called, by_neighbours != called
    return counted(first[seen], second[seen], state.observations[seen])


def measure_reach_m(voxel_size_m: float) -> float:
    """How far from a voxel `measure` reads."""
    return potts_mrf.reach_m(PottsSettings(), voxel_size_m)


def counted(first: NDArray[np.bool_], second: NDArray[np.bool_], observations: NDArray[np.floating]) -> Sums:
    """The sums of voxels (v,) in which geometry and neighbours overrule the images, weighted by `observations` (v,)."""
    weight = np.rint(observations * FIXED_POINT).astype(np.int64)
    total, by_first, by_second, by_both = (
        int(weight[found].sum()) for found in (np.ones_like(first), first, second, first & second)
    )
    return Sums(
        observed=len(weight),
        observations=total,
        by_geometry=by_first,
        by_neighbours=by_second,
        by_both=by_both,
    )


def doubted(
    probabilities: NDArray[np.float32], systematic: float | NDArray[np.float32]
) -> NDArray[np.float32]:
    """Class probabilities (v, c), mixed with the uniform distribution by the rate of systematic errors.

    `systematic` is that rate, one for all or (v, 1).
    """
    uniform = np.float32(1 / probabilities.shape[1])
    return np.asarray(probabilities + systematic * (uniform - probabilities), np.float32)
