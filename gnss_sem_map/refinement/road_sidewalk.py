"""Road and sidewalk in a map: where they are, and where they meet."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from gnss_sem_map.labels.label_set import UNLABELLED, LabelSet
from gnss_sem_map.labels.roles import Role
from gnss_sem_map.refinement.state import MapState, NotApplicable, StepSettings
from gnss_sem_map.voxels import kernels
from gnss_sem_map.voxels.kernels import AXIS_BITS
from gnss_sem_map.voxels.semantic_map import SemanticMap

ROAD, SIDEWALK = 0, 1
"""Which of the two `road_and_sidewalk` is which."""


class RoadEdgeSettings(StepSettings):
    """How high the step from road to sidewalk is."""

    least_m: float = Field(
        default=0.06,
        gt=0,
        description="Least height of the step from road to sidewalk, m; below it only the images decide.",
    )


def road_and_sidewalk(label_set: LabelSet) -> tuple[int, int] | None:
    """Class indices of road and sidewalk; None for a class set that lacks one."""
    road, sidewalk = label_set.the(Role.ROAD), label_set.the(Role.SIDEWALK)
    return None if road is None or sidewalk is None else (road, sidewalk)


def with_odds(
    logs: NDArray[np.float32], classes: tuple[int, int], more: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Log scores (v, k) in which the log odds of sidewalk against road have `more` (v,); their sum stays, and all else.

    `classes` are road and sidewalk.
    """
    road, sidewalk = classes
    both, odds = np.logaddexp(logs[:, road], logs[:, sidewalk]), logs[:, sidewalk] - logs[:, road] + more
    logs = logs.copy()
    logs[:, sidewalk] = both - np.logaddexp(0, -odds)
    logs[:, road] = both - np.logaddexp(0, odds)
    return logs


def is_road_or_sidewalk(semantic_map: SemanticMap) -> NDArray[np.bool_]:
    """Which voxels (v,) are shown as road or sidewalk; none where either is missing: there is nothing to split."""
    classes = road_and_sidewalk(semantic_map.voxels.label_set)
    shown = np.where(semantic_map.shown, semantic_map.labels, UNLABELLED)
    if classes is None or not all((shown == one).any() for one in classes):
        return np.zeros(len(shown), np.bool_)
    return np.asarray((shown == classes[ROAD]) | (shown == classes[SIDEWALK]))


def heights_of(state: MapState) -> NDArray[np.float64]:
    """Mean height of the points in every voxel (v,) m, NaN where unknown. Raises NotApplicable."""
    if state.decided is None or not is_road_or_sidewalk(state.decided).any():
        raise NotApplicable("the map has no road, or no sidewalk")
    if state.decided.voxels.heights is None:
        raise NotApplicable("heights of surfaces were not measured")
    return state.decided.voxels.surface_heights


def around(
    keys: NDArray[np.int64], sought: NDArray[np.int64], reach: tuple[int, int, int]
) -> Iterator[NDArray[np.int64]]:
    """Places (k,) among sorted packed `keys` of what lies around the k `sought`, -1 for nothing there.

    One array per offset within `reach` in x, y and z, x outermost.
    """
    for x, y, z in product(*(range(-r, r + 1) for r in reach)):
        found = np.empty(len(sought), np.int64)
        kernels.find(keys, sought + ((x << 2 * AXIS_BITS) + (y << AXIS_BITS) + z), found)
        yield found


def meeting(
    semantic_map: SemanticMap, labels: NDArray[np.integer], classes: tuple[int, int]
) -> NDArray[np.bool_]:
    """Which voxels (v,) of one of the classes are beside one of the other, in their own layer."""
    found, keys = np.zeros(len(labels), np.bool_), semantic_map.voxels.keys
    own, other = sorted(classes, key=lambda one: np.count_nonzero(labels == one))
    candidates = np.flatnonzero(labels == own)  # of the rarer class: whoever meets is met
    for beside in around(keys, keys[candidates], (1, 1, 0)):
        meets = (beside >= 0) & (labels[beside] == other)
        found[candidates[meets]] = found[beside[meets]] = True
    return found
