"""Levels: road and sidewalk lie on two parallel planes, and the height of a voxel's surface says on which it lies.

A network may call the gaps between parked cars on a sidewalk road in every image, so neighbours do not help. Height
is independent evidence. Around every cell of the ground two parallel planes are fitted by expectation maximisation
(Dempster, Laird, Rubin 1977): each voxel belongs to each plane with the probability of its class, and that probability
follows from its distance to the planes. Height is used only where the two planes are clearly separated.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.special import entr, expit, logit

from gnss_sem_map.labels.label_set import UNLABELLED
from gnss_sem_map.refinement.kerb_points import FACE_BEGINS
from gnss_sem_map.refinement.road_sidewalk import (
    ROAD,
    SIDEWALK,
    RoadEdgeSettings,
    around,
    heights_of,
    is_road_or_sidewalk,
    meeting,
    road_and_sidewalk,
)
from gnss_sem_map.refinement.state import MapState
from gnss_sem_map.voxels.semantic_map import SemanticMap, State
from gnss_sem_map.voxels.voxel_map import keys_of

CELL_M = 2.0
REACH = (3, 3, 1)
"""Cells to each side that make the surroundings of a place: seven metres, which a street's crown does not bend much."""
FEWEST = 20
"""Voxels of each class that a plane needs."""
ROUNDS = 6
CLEARLY_TWO = 2.0
"""Least distance of two normal distributions, in standard deviations, that are seen to be two (Ashman et al. 1994)."""
SUREST = 0.98
"""Upper limit of the images' probability of road against sidewalk, so that height can change it."""
VOXEL_STDDEV_M = 0.03
"""Surfaces of voxels lie at least so far over or under the plane that they belong to."""
X, Y, ON_SIDEWALK, Z, TERMS = 1, 2, 3, 4, 5
"""Of the terms of a fit; the first is one."""


class LevelSettings(RoadEdgeSettings):
    """Which steps the heights of voxels tell."""


def reach_m(settings: LevelSettings, voxel_size_m: float) -> float:
    """The radius of one fit; what the fits there take from beyond is left out."""
    return (REACH[0] + 1) * CELL_M


def apply(state: MapState, settings: LevelSettings) -> MapState:
    """Height as evidence between road and sidewalk; see `split_levels`."""
    assert state.decided is not None
    heights = heights_of(state)
    return replace(state, decided=split_levels(state.decided, heights, settings))


def split_levels(
    semantic_map: SemanticMap, heights: NDArray[np.float64], settings: LevelSettings
) -> SemanticMap:
    """The map with road and sidewalk split by height as well, where the two levels are clearly separated.

    `heights` (v,) m: of every voxel's surface, NaN where unknown. Nothing else changes.
    """
    classes = road_and_sidewalk(semantic_map.voxels.label_set)
    voxels = np.flatnonzero(is_road_or_sidewalk(semantic_map) & np.isfinite(heights))
    if classes is None or len(voxels) == 0:
        return semantic_map
    labels, confidence = semantic_map.labels[voxels], semantic_map.confidence[voxels]
    sure = logit(np.clip(confidence, 0.5, SUREST).astype(np.float64))
    images = np.where(labels == classes[SIDEWALK], sure, -sure)
    ground = _Ground.of(semantic_map.voxels.centres[voxels], heights[voxels])
    planes = _fit(ground, expit(images))
    for _ in range(ROUNDS):
        planes = _fit(ground, expit(images + _log_odds(planes, ground, settings)))
    of_height = _log_odds(planes, ground, settings)
    log_odds = images + of_height
    split = np.where(log_odds > 0, classes[SIDEWALK], classes[ROAD])
    clear = _are_two(planes, settings)[ground.cell] & (of_height != 0)
    clear &= ~_hold_both(semantic_map, voxels, split, classes)
    return _decided(semantic_map, voxels[clear], split[clear], log_odds[clear])


def _hold_both(
    semantic_map: SemanticMap, voxels: NDArray[np.int64], split: NDArray[np.int64], classes: tuple[int, int]
) -> NDArray[np.bool_]:
    """Which of the voxels (g,) stand where the two meet, by the images and by the split as well.

    A kerb goes through those, and they lie on neither level; their points are classified one by one, see `kerbs`.
    """
    before = np.where(semantic_map.shown, semantic_map.labels, UNLABELLED)
    after = before.copy()
    after[voxels] = split
    still = meeting(semantic_map, before, classes) & meeting(semantic_map, after, classes)
    return np.asarray(still[voxels])


@dataclass(frozen=True, eq=False)
class _Ground:
    """Surfaces of g voxels, and the k cells that they lie in."""

    p: NDArray[np.float64]
    """(g, 3) m."""
    cell: NDArray[np.int64]
    """(g,) the cell of each."""
    surroundings: list[NDArray[np.int64]]
    """Per offset the cell (k,) that lies there, -1 for none."""

    @classmethod
    def of(cls, centres: NDArray[np.float64], heights: NDArray[np.float64]) -> _Ground:
        p = np.column_stack([centres[:, :2], heights])
        cells, cell = np.unique(keys_of(p, CELL_M), return_inverse=True)
        return cls(p - p.mean(axis=0), cell, list(around(cells, cells, REACH)))


@dataclass(frozen=True, eq=False)
class _Planes:
    """z = z0 + a x + b y on the road, a step higher on the sidewalk, around each of k cells."""

    z0: NDArray[np.float64]
    slopes: NDArray[np.float64]
    """(k, 3) along x and y, and the step, m."""
    variance: NDArray[np.float64]
    """(k,) m²; of what lies on either plane; infinite where there are too few voxels for two."""


def _fit(ground: _Ground, on_sidewalk: NDArray[np.float64]) -> _Planes:
    """Least squares around every cell, each voxel (g,) on the sidewalk as far as it is probable."""
    rows, columns = np.triu_indices(TERMS)
    cells = len(ground.surroundings[0])
    own = np.zeros((cells, len(rows)))
    _add_moments(ground.p, ground.cell, on_sidewalk, own)
    around_each = np.zeros((cells, len(rows)))
    for there in ground.surroundings:
        _add_rows(own, there, around_each)
    sums = np.empty((cells, TERMS, TERMS))
    sums[:, rows, columns] = sums[:, columns, rows] = around_each
    count = sums[:, 0, 0]
    scatter = sums - sums[:, :, :1] * sums[:, :1, :] / count[:, None, None]
    of_terms, with_z = scatter[:, 1:Z, 1:Z], scatter[:, 1:Z, Z]
    slopes = np.linalg.solve(of_terms + 1e-6 * np.eye(Z - 1), with_z[..., None])[..., 0]
    z0 = (sums[:, 0, Z] - (slopes * sums[:, 0, 1:Z]).sum(axis=1)) / count
    left_over = scatter[:, Z, Z] - (slopes * with_z).sum(axis=1)
    fewer = np.minimum(sums[:, 0, ON_SIDEWALK], count - sums[:, 0, ON_SIDEWALK])
    variance = np.where(fewer >= FEWEST, left_over / np.maximum(count - TERMS + 1, 1), np.inf)
    return _Planes(z0, np.asarray(slopes), variance)


@njit(cache=True, nogil=True)
def _add_moments(
    p: NDArray[np.float64],
    cell: NDArray[np.int64],
    on_sidewalk: NDArray[np.float64],
    sums: NDArray[np.float64],
) -> None:
    """Add the products of every two terms of each voxel (g,) to the sums of its cell (k, m)."""
    for i in range(len(cell)):
        s = on_sidewalk[i]
        terms = (1.0, p[i, 0], p[i, 1], s, p[i, 2])
        m = 0
        for a in range(TERMS):
            for b in range(a, TERMS):
                # a class is 0 or 1: E[s²] = E[s]
                sums[cell[i], m] += s if a == b == ON_SIDEWALK else terms[a] * terms[b]
                m += 1


@njit(cache=True, nogil=True)
def _add_rows(rows: NDArray[np.float64], places: NDArray[np.int64], sums: NDArray[np.float64]) -> None:
    """Add to every row of the sums (k, m) the row at its place (k,), if there is one."""
    for i in range(len(places)):
        if places[i] >= 0:
            for j in range(sums.shape[1]):
                sums[i, j] += rows[places[i], j]


def _are_two(planes: _Planes, settings: LevelSettings) -> NDArray[np.bool_]:
    """Around which cells (k,) the planes are clearly two."""
    step, stddev = planes.slopes[:, 2], np.sqrt(_variance(planes))
    return (step >= settings.least_m) & (step >= CLEARLY_TWO * stddev)


def _log_odds(planes: _Planes, ground: _Ground, settings: LevelSettings) -> NDArray[np.float64]:
    """What height says for the sidewalk (g,): the planes are two normal distributions; 0 where it is silent."""
    odds, variance = np.empty(len(ground.cell)), _variance(planes)
    _fill_log_odds(
        ground.p, ground.cell, planes.z0, planes.slopes, variance, settings.least_m, FACE_BEGINS, odds
    )
    return odds


@njit(cache=True, nogil=True, error_model="numpy")
def _fill_log_odds(
    p: NDArray[np.float64],
    cell: NDArray[np.int64],
    z0: NDArray[np.float64],
    slopes: NDArray[np.float64],
    variance: NDArray[np.float64],
    least_m: float,
    face_begins: float,
    odds: NDArray[np.float64],
) -> None:
    for i in range(len(cell)):
        c = cell[i]
        of_road = z0[c] + (slopes[c, 0] * p[i, 0] + slopes[c, 1] * p[i, 1])
        step = max(slopes[c, 2], least_m)  # no lower one is believed in
        up = (p[i, 2] - of_road) / step  # 0 on the road, 1 on the sidewalk
        # what lies a whole step off both is neither
        odds[i] = step * step * (up - face_begins) / variance[c] if -1 < up < 2 else 0.0


def _variance(planes: _Planes) -> NDArray[np.float64]:
    return np.maximum(planes.variance, VOXEL_STDDEV_M**2)


def _decided(
    semantic_map: SemanticMap,
    voxels: NDArray[np.int64],
    labels: NDArray[np.int64],
    log_odds: NDArray[np.float64],
) -> SemanticMap:
    """The map with these labels in these voxels, as sure as they are."""
    probability = expit(np.abs(log_odds)).astype(np.float32)
    after, states = semantic_map.labels.copy(), semantic_map.states.copy()
    refined = np.where(labels == semantic_map.voxels.labels[voxels], State.OBSERVED, State.REFINED)
    states[voxels] = np.where(states[voxels] == State.INFERRED, State.INFERRED, refined)
    confidence = semantic_map.confidence.copy()
    after[voxels], confidence[voxels] = labels, probability
    entropy = semantic_map.entropy
    if entropy is not None:
        entropy = entropy.copy()
        entropy[voxels] = entr(probability) + entr(1 - probability)
    return replace(semantic_map, labels=after, confidence=confidence, states=states, entropy=entropy)
