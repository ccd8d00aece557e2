"""Geometry as evidence: how high a voxel stands, and how its surface lies, say what it cannot be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from gnss_sem_map.labels.label_set import LabelSet
from gnss_sem_map.labels.roles import Role
from gnss_sem_map.refinement.normals import flatness
from gnss_sem_map.refinement.state import MapState, StepSettings

LEAST_HEIGHT_M = 0.1
"""Buildings and vegetation are no lower: half a voxel of the paper, so the ground itself."""
FOOT_M = 0.3
"""Up to here a building may begin, but not with level ground."""
LEVEL = 0.95
"""Flatter than this is level ground (1 is level, 0 upright)."""
LEAST_FLATNESS = 0.8
"""Of road and sidewalk: a slope of 37 degrees, which no street has and every kerb's face and car's side exceeds."""


class GeometricPriorSettings(StepSettings):
    """At which heights over the ground, and on which surfaces, a class is unlikely."""

    against_nat: float = Field(
        default=2.3, ge=0, description="What a broken rule counts against a class, nat."
    )
    road_highest_m: float = Field(default=0.35, description="Road is no higher than this, m.")
    sidewalk_highest_m: float = Field(default=0.45, description="A sidewalk is no higher than this, m.")
    vehicle_highest_m: float = Field(
        default=3.5, description="A vehicle is no higher than this (counts twice), m."
    )


def reach_m(settings: GeometricPriorSettings, voxel_size_m: float) -> float:
    """The neighbours of a voxel say how flat it lies; its height is known."""
    return voxel_size_m


def apply(state: MapState, settings: GeometricPriorSettings) -> MapState:
    """Add log-likelihoods of height and flatness: those that a calibration found, or rules."""
    voxels, model = state.voxels, state.beside.sensor_model
    lie = flatness(voxels.keys, voxels.observed)
    if model is None:
        of_geometry = against(state.heights, lie, voxels.label_set, settings)
    else:
        of_geometry = model.of_geometry(state.heights, lie)
    return replace(state, scores=state.scores + of_geometry)


def against(
    heights: NDArray[np.float32],
    flatness: NDArray[np.float32],
    label_set: LabelSet,
    settings: GeometricPriorSettings,
) -> NDArray[np.float32]:
    """What heights (v,) m over ground and flatness (v,) add to the log scores: (v, c), zero or negative, nat.

    A flatness that is not known, NaN, breaks no rule. The rules are soft: a few observations that agree
    outweigh them. How low a vehicle reaches is left to the vehicle rules, which know its object.
    """
    steep, level = flatness < LEAST_FLATNESS, flatness > LEVEL
    rules = (
        (Role.ROAD, (heights > settings.road_highest_m) | steep, 1.0),
        (Role.SIDEWALK, (heights > settings.sidewalk_highest_m) | steep, 1.0),
        (Role.VEHICLE, heights > settings.vehicle_highest_m, 2.0),
        (Role.BUILDING, heights < LEAST_HEIGHT_M, 1.0),
        (Role.BUILDING, (heights < FOOT_M) & level, 1.0),
        (Role.VEGETATION, heights < LEAST_HEIGHT_M, 0.5),
    )
    result = np.zeros((len(heights), len(label_set.names)), np.float32)
    for role, broken, weight in rules:
        for label in label_set.having(role):
            result[:, label] -= np.float32(weight * settings.against_nat) * broken
    return result
