"""Point labels: class, confidence and removal of every original point, looked up in the voxels of a map."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from factor_graphs.errors import MeasurementError
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.config import Settings
from gnss_sem_map.errors import DataError
from gnss_sem_map.labels.label_set import UNLABELLED
from gnss_sem_map.mapping.labelled_scans import map_points
from gnss_sem_map.refinement.kerb_points import Kerbs
from gnss_sem_map.scans.prefetch import prefetch
from gnss_sem_map.sensor_log import Scan, SensorLog
from gnss_sem_map.voxels.semantic_map import SemanticMap, State
from gnss_sem_map.voxels.voxel_map import keys_of


@dataclass(frozen=True, eq=False)
class PointLabels:
    """Labels of every original point of one scan, by one map."""

    labels: NDArray[np.int8]
    """(n,) class index, -1 unknown."""
    confidence: NDArray[np.float32]
    """(n,) probability of that class, 0 if unknown."""
    removed: NDArray[np.bool_]
    """(n,) mask of the points of moving objects."""


def label_points(
    log: SensorLog,
    trajectory: Trajectory,
    maps: Sequence[SemanticMap],
    settings: Settings,
    moving: Mapping[int, NDArray[np.int64]] | None = None,
    kerbs: Kerbs | None = None,
) -> Iterator[tuple[Scan, list[PointLabels]]]:
    """For every usable scan, the labels of its original points by each of the maps.

    Two rules apply to the last map, the refined one, only: the points `moving` (see `Drive`) are removed vehicles,
    whatever the class of their voxel; and the points in its `kerbs` are classified one by one as road or sidewalk.
    """
    one_grid = all(np.array_equal(other.voxels.keys, maps[0].voxels.keys) for other in maps[1:])

    def label(scan: Scan) -> list[PointLabels] | None:
        try:
            points = scan.read()
            p_map, valid = map_points(points, scan, trajectory, log, settings.mapping)
        except (DataError, MeasurementError):
            return None  # was reported when the map was built
        if not valid.any():
            return None  # likewise
        keys = keys_of(p_map, settings.mapping.voxel_size_m)
        places = [m.voxels.indices_of(keys) for m in (maps[:1] if one_grid else maps)]
        places *= len(maps) // len(places)
        found = [_look_up(m, there, valid) for m, there in zip(maps, places, strict=True)]
        if kerbs is not None:
            inside, chosen, probability = kerbs.decide(places[-1], p_map)
            points_of_kerbs = np.flatnonzero(valid)[inside]
            found[-1].labels[points_of_kerbs] = chosen
            found[-1].confidence[points_of_kerbs] = probability
        if moving is not None and scan.number in moving:
            usable, moved = np.flatnonzero(valid), moving[scan.number]
            if moved.max(initial=-1) >= len(usable):
                raise DataError(
                    f"frame {scan.number}: found {len(usable)} usable points, expected more than {moved.max()}, which"
                    " is said to have moved; was the scan changed? make the run again"
                )
            _remove(found[-1], usable[moved], maps[-1])
        return found

    for scan, found in prefetch(label, log.scans, threads=os.cpu_count() or 1):
        if found is not None:
            yield scan, found


def _look_up(semantic_map: SemanticMap, places: NDArray[np.int64], valid: NDArray[np.bool_]) -> PointLabels:
    known = valid.copy()
    known[valid] = places >= 0
    places = places[places >= 0]
    found = PointLabels(
        labels=np.full(len(valid), UNLABELLED, np.int8),
        confidence=np.zeros(len(valid), np.float32),
        removed=np.zeros(len(valid), np.bool_),
    )
    found.labels[known] = semantic_map.labels[places]
    found.confidence[known] = semantic_map.confidence[places]
    found.removed[known] = semantic_map.states[places] == State.REMOVED
    return found


def _remove(found: PointLabels, points: NDArray[np.int64], semantic_map: SemanticMap) -> None:
    names = semantic_map.voxels.label_set.names
    if "vehicle" in names:
        changed = points[found.labels[points] != names.index("vehicle")]
        found.labels[changed], found.confidence[changed] = names.index("vehicle"), 0.5
    found.removed[points] = True
