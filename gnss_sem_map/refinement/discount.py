"""Observations of one voxel repeat each other's errors: n of them count as fewer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from pydantic import Field

from gnss_sem_map.refinement.state import MapState, StepSettings


class DiscountSettings(StepSettings):
    """How much the second observation of a voxel counts."""

    exponent: float = Field(
        default=0.5, ge=0, le=1, description="n observations of a voxel count as n to this power. 1 is eq. 6."
    )


def reach_m(settings: DiscountSettings, voxel_size_m: float) -> float:
    """A voxel alone."""
    return 0.0


def apply(state: MapState, settings: DiscountSettings) -> MapState:
    """Eq. 6 adds log-likelihoods as if images were independent of each other; here their sum is tempered."""
    factors = state.observations ** (settings.exponent - 1)
    return replace(state, scores=np.asarray(state.scores * factors[:, None], np.float32))
