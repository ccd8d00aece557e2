"""From voxels back to points: what a map says of every original point of the drive that it was made of."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from factor_graphs.errors import MeasurementError
from factor_graphs.trajectory import Trajectory
from gnss_sem_map import labels
from gnss_sem_map.ahead import ahead
from gnss_sem_map.config import Settings
from gnss_sem_map.errors import DataError
from gnss_sem_map.refinement.kerbs import Kerbs, find_kerbs
from gnss_sem_map.seen_scans import map_points
from gnss_sem_map.sensor_log import Scan, SensorLog
from gnss_sem_map.voxel_map import SemanticMap, State, keys_of

ENOUGH_SCANS = 50
"""Scans that tell how high road and sidewalk lie: of a longer drive every `EVERY`th does as well as all."""
EVERY = 4


@dataclass(frozen=True, eq=False)
class PointLabels:
    """What a map says of every original point of one scan."""

    labels: NDArray[np.int8]
    """(n,) class index, -1 where nothing is known."""
    confidence: NDArray[np.float32]
    """(n,) probability of that class, 0 where nothing is known."""
    removed: NDArray[np.bool_]
    """(n,) part of something that moved."""


@dataclass(frozen=True, eq=False)
class _PlacedScan:
    """The usable points of a scan (m of n), and where the maps hold them."""

    valid: NDArray[np.bool_]
    """(n,) which are used."""
    p_map: NDArray[np.float64]
    """(m, 3) m."""
    places: list[NDArray[np.int64]]
    """Per map the voxel of each point (m,), -1 for none."""


def label_points(
    log: SensorLog,
    trajectory: Trajectory,
    maps: Sequence[SemanticMap],
    settings: Settings,
    moving: Mapping[int, NDArray[np.int64]] | None = None,
) -> Iterator[tuple[Scan, list[PointLabels]]]:
    """For every usable scan, what each of the maps says of its original points.

    Two things concern the last map, the refined one, alone: the points `moving` (see `Drive`) are vehicles that it has
    removed, whatever stands there; and points where road meets sidewalk are told apart (see `kerbs`).
    """
    one_grid = all(np.array_equal(other.voxels.keys, maps[0].voxels.keys) for other in maps[1:])

    def place(scan: Scan) -> _PlacedScan | None:
        try:
            points = scan.read()
            p_map, valid = map_points(points, scan, trajectory, log, settings.mapping)
        except (DataError, MeasurementError):
            return None  # counted when the map was built
        keys = keys_of(p_map, settings.mapping.voxel_size_m)
        places = [m.voxels.places(keys) for m in (maps[:1] if one_grid else maps)]
        return _PlacedScan(valid, p_map, places * (len(maps) // len(places)))

    def sweeps() -> Iterator[tuple[NDArray[np.int64], NDArray[np.float64]]]:
        scans = log.scans if len(log.scans) < EVERY * ENOUGH_SCANS else log.scans[::EVERY]
        for _, placed in ahead(place, scans, threads=os.cpu_count() or 1):
            if placed is not None:
                yield placed.places[-1], placed.p_map[:, 2]

    kerbs = None
    if settings.refinement.kerbs == "evidence":
        kerbs = find_kerbs(maps[-1], sweeps(), settings.refinement.levels)

    def look(scan: Scan) -> list[PointLabels] | None:
        placed = place(scan)
        if placed is None:
            return None
        found = [_look_up(m, places, placed.valid) for m, places in zip(maps, placed.places, strict=True)]
        if kerbs is not None:
            _tell_apart(found[-1], kerbs, placed)
        if moving is not None and scan.number in moving:
            _remove(found[-1], np.flatnonzero(placed.valid)[moving[scan.number]], maps[-1])
        return found

    for scan, found in ahead(look, log.scans, threads=os.cpu_count() or 1):
        if found is not None:
            yield scan, found


def _look_up(semantic_map: SemanticMap, places: NDArray[np.int64], valid: NDArray[np.bool_]) -> PointLabels:
    known = valid.copy()
    known[valid] = places >= 0
    places = places[places >= 0]
    found = PointLabels(
        labels=np.full(len(valid), labels.UNLABELLED, np.int8),
        confidence=np.zeros(len(valid), np.float32),
        removed=np.zeros(len(valid), np.bool_),
    )
    found.labels[known] = semantic_map.labels[places]
    found.confidence[known] = semantic_map.confidence[places]
    found.removed[known] = semantic_map.states[places] == State.REMOVED
    return found


def _tell_apart(found: PointLabels, kerbs: Kerbs, placed: _PlacedScan) -> None:
    inside, chosen, probability = kerbs.decide(placed.places[-1], placed.p_map)
    points = np.flatnonzero(placed.valid)[inside]
    found.labels[points], found.confidence[points] = chosen, probability


def _remove(found: PointLabels, points: NDArray[np.int64], semantic_map: SemanticMap) -> None:
    names = semantic_map.voxels.label_set.names
    if "vehicle" in names:
        changed = points[found.labels[points] != names.index("vehicle")]
        found.labels[changed], found.confidence[changed] = names.index("vehicle"), 0.5
    found.removed[points] = True
