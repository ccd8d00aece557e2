"""The decision: the most probable class of every voxel, how probable it is, and where that comes from."""

from __future__ import annotations

from dataclasses import replace
from functools import reduce
from typing import Literal

import numpy as np
from pydantic import Field

from gnss_sem_map.refinement.state import MapState, StepSettings
from gnss_sem_map.refinement.systematic_error import doubted
from gnss_sem_map.voxels.semantic_map import Reason, SemanticMap, State, entropy_of
from gnss_sem_map.voxels.voxel_map import softmax


class DecisionSettings(StepSettings):
    """How sure a map is of its decisions."""

    enabled: Literal[True] = Field(default=True, description="Always on: the map needs one class per voxel.")
    temperature: float = Field(
        default=1.0,
        gt=0,
        le=100,
        description="Log scores are divided by this before confidence is read off them (Guo et al. 2017); a calibration"
        " file brings its own.",
    )


def reach_m(settings: DecisionSettings, voxel_size_m: float) -> float:
    """A voxel alone."""
    return 0.0


def apply(state: MapState, settings: DecisionSettings) -> MapState:
    """Softmax of the log scores at a temperature, doubted as far as images err in all views alike."""
    voxels, scores, model = state.voxels, state.scores, state.beside.sensor_model
    temperature = settings.temperature if model is None else model.temperature
    known = voxels.observed | state.inferred
    labels = state.labels
    states = np.where(voxels.observed, State.OBSERVED, State.UNOBSERVED).astype(np.uint8)
    states[labels != voxels.labels] = State.REFINED
    states[state.inferred] = State.INFERRED
    states[state.removed] = State.REMOVED
    probabilities = doubted(softmax(scores / np.float32(temperature)), state.systematic_error)
    confidence = np.where(known, reduce(np.maximum, probabilities.T), np.float32(0))
    entropy = np.where(known, entropy_of(probabilities), np.log(scores.shape[1])).astype(np.float32)
    reasons = np.where(state.removed, np.uint8(Reason.RULE), np.uint8(Reason.NONE))
    decided = SemanticMap(voxels, labels, confidence, states, entropy, reasons=reasons)
    return replace(state, decided=decided)
