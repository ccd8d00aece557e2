"""Geometric labels: what shape and intensity say corrects what images saw, and fills what no image shows.

The classifier of `geometric_classifier` is independent of the images of a voxel: it was trained on those of other
blocks. What both say is a log-opinion pool; where no image looked, the classifier speaks alone, and the voxel is marked
as inferred. The shape of kerbs counts in full, because images hardly show it. `other`, none of the classes, is one of
the answers. A weak Potts model over all voxels follows.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from pydantic import Field

from gnss_sem_map.refinement.potts_mrf import ITERATIONS, LEAST_PROBABILITY, mean_field
from gnss_sem_map.refinement.road_sidewalk import road_and_sidewalk, with_odds
from gnss_sem_map.refinement.state import MapState, NotApplicable, StepSettings
from gnss_sem_map.refinement.systematic_error import doubted
from gnss_sem_map.voxels.voxel_map import softmax

NEVER = -30.0
"""Log score of an answer that is out of the question."""
OTHER_LIMITS = (0.001, 0.9)
"""Of the images' probability of `other`, as evidence: networks are too sure of it."""


class GeometricLabelSettings(StepSettings):
    """How much the geometric classifier has to say."""

    weight: float = Field(
        default=0.3,
        ge=0,
        le=10,
        description="Its log probabilities are multiplied by this where images show a voxel as well.",
    )
    coupling_nat: float = Field(
        default=0.1, ge=0, description="What a neighbour that is sure of a class adds to it, nat."
    )
    other_where_seen: bool = Field(
        default=False,
        description="Whether `other` may win where images show a class: fewer wrong labels on fences and lawns, and"
        " fewer of vegetation.",
    )


def reach_m(settings: GeometricLabelSettings, voxel_size_m: float) -> float:
    """One voxel per iteration of the Potts model; what the classifier says is known."""
    return ITERATIONS * voxel_size_m if settings.coupling_nat else 0.0


def apply(state: MapState, settings: GeometricLabelSettings) -> MapState:
    """Add the classifier's log probabilities to those of the images, which may err in all views alike."""
    geometry, voxels, model = state.beside.geometry, state.voxels, state.beside.sensor_model
    if geometry is None:
        raise NotApplicable("there is no geometric classifier")
    logs, kerbs = geometry.of(voxels.keys)
    known, seen = np.isfinite(kerbs), voxels.observed
    temperature = np.float32(1.0 if model is None else model.temperature)
    images = doubted(softmax(state.scores / temperature), state.systematic_error)
    images = np.log(np.maximum(images, np.float32(LEAST_PROBABILITY)))
    logs, kerbs = np.where(known[:, None], logs, np.float32(0)), np.where(known, kerbs, np.float32(0))
    scores = np.where(seen[:, None], np.float32(settings.weight) * logs, logs)
    scores[seen, :-1] += images[seen]
    if (classes := road_and_sidewalk(voxels.label_set)) is not None:
        # networks call sidewalks road, hardly ever road sidewalk: a sidewalk that images show stays one
        scores = with_odds(scores, classes, np.where(seen, np.maximum(kerbs, 0), kerbs))
    share = np.clip(voxels.other_share, *OTHER_LIMITS)
    of_other = np.log(share) - np.log1p(-share)
    # where images show nothing but `other`, no class has evidence
    only_other = (voxels.other_share > 0) & ~seen
    scores[only_other, -1] += of_other[only_other]
    scores[seen, -1] = scores[seen, -1] + of_other[seen] if settings.other_where_seen else np.float32(NEVER)
    if settings.coupling_nat:
        scores = mean_field(voxels.keys, scores, seen | known, settings.coupling_nat, temper=1.0)
    # the decision divides by the temperature of the images, which is done here already
    return replace(state, scores=np.asarray(scores * temperature, np.float32), inferred=known & ~seen)
