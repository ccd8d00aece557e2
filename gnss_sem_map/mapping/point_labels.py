"""Point labels: class, confidence and removal of every original point, looked up in the voxels of a map."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from factor_graphs.errors import MeasurementError
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.config import Settings
from gnss_sem_map.errors import DataError
from gnss_sem_map.labels.label_set import UNLABELLED
from gnss_sem_map.labels.roles import MOVABLE
from gnss_sem_map.mapping.evidence import read_moving_points
from gnss_sem_map.mapping.labelled_scans import Drive, map_points
from gnss_sem_map.process.machine import threads
from gnss_sem_map.process.prefetch import prefetch
from gnss_sem_map.refinement.kerb_points import Kerbs
from gnss_sem_map.scans.deskew import EXTRAPOLATE_S
from gnss_sem_map.sensor_log import Scan, SensorLog
from gnss_sem_map.voxels.semantic_map import SemanticMap, State
from gnss_sem_map.voxels.tiles import TiledMap
from gnss_sem_map.voxels.voxel_map import keys_of

SCANS_AT_ONCE = 300
"""The part of the map around so many scans is in memory at a time."""
DRIVEN_IN_A_SWEEP_M = 60.0
"""Points may be this much farther from the pose of their scan than from that of their own stamp."""
OF_ONE_OBJECT_M = 1.0
"""Points that moved, and are as near as this, are of one object."""


@dataclass(frozen=True, eq=False)
class PointLabels:
    """Labels of every original point of one scan, by one map; or of every voxel, and of none at the end."""

    labels: NDArray[np.int8]
    """(n,) class index, c for `other`, -1 unknown."""
    confidence: NDArray[np.float32]
    """(n,) probability of that class, 0 if unknown."""
    removed: NDArray[np.bool_]
    """(n,) mask of the points of moving objects."""
    looks: NDArray[np.uint8]
    """(n,) LiDAR points of the voxel, 255 for more; 0 if unknown."""

    @classmethod
    def of_voxels(cls, semantic_map: SemanticMap) -> PointLabels:
        """What a map says of each of its v voxels, and in the place v, which is also -1, of none."""
        return cls(
            np.append(semantic_map.labels, np.int8(UNLABELLED)),
            np.append(semantic_map.confidence, np.float32(0)),
            np.append(semantic_map.states == State.REMOVED, False),
            np.append(np.minimum(semantic_map.voxels.hits, 255).astype(np.uint8), np.uint8(0)),
        )

    def at(self, places: NDArray[np.int64]) -> PointLabels:
        """Those at the places (n,)."""
        return PointLabels(
            self.labels[places], self.confidence[places], self.removed[places], self.looks[places]
        )


def label_points(
    log: SensorLog,
    trajectory: Trajectory,
    maps: Sequence[TiledMap],
    settings: Settings,
    moving_points: Sequence[Path] = (),
    kerbs: Kerbs | None = None,
) -> Iterator[tuple[Scan, list[PointLabels]]]:
    """For every usable scan, the labels of its original points by each of the maps, of which the last is refined.

    Two rules apply to the refined map only: the points in the files `moving_points` (see `mapping.evidence`) are
    removed and of a class that may move, whatever that of their voxel; and the points in its `kerbs` are classified one
    by one as road or sidewalk. Of the maps only the part around some scans is in memory. Raises DataError.
    """
    files = list(moving_points)
    moving: dict[int, NDArray[np.int64]] = {}
    drive = Drive(log, trajectory, None, settings)
    _ = drive.nearest_m  # the scans that tell it are kept for their turn
    for start in range(0, len(drive.log.scans), SCANS_AT_ONCE):
        scans = drive.log.scans[start : start + SCANS_AT_ONCE]
        box = _box_of(scans, log, trajectory, settings.mapping.farthest_m)
        if box is None:
            continue
        parts = [tiled.inside(box) for tiled in maps]
        # skipped scans are in no file: the files of these scans end where one holds the last of them, or a later one
        enough = {scan.number for scan in drive.log.scans[start + len(scans) - 1 :]}
        while files and enough.isdisjoint(moving):
            moving |= read_moving_points(files.pop(0))
        yield from _label_some(drive, scans, parts, moving, kerbs)
        for scan in scans:
            moving.pop(scan.number, None)


def _box_of(
    scans: Sequence[Scan], log: SensorLog, trajectory: Trajectory, farthest_m: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Corners (3,) m of a box that holds all points of these scans; None where none is in the trajectory."""
    stamps = np.array([scan.stamp for scan in scans])
    known = (stamps >= trajectory.start - EXTRAPOLATE_S) & (stamps <= trajectory.end + EXTRAPOLATE_S)
    if not known.any():
        return None
    p_map = (trajectory.at(stamps[known], EXTRAPOLATE_S) @ log.calibration.T_imu_lidar)[:, :3, 3]
    reach_m = farthest_m + DRIVEN_IN_A_SWEEP_M
    return p_map.min(axis=0) - reach_m, p_map.max(axis=0) + reach_m


def _label_some(
    drive: Drive,
    scans: Sequence[Scan],
    maps: Sequence[SemanticMap],
    moving: Mapping[int, NDArray[np.int64]],
    kerbs: Kerbs | None,
) -> Iterator[tuple[Scan, list[PointLabels]]]:
    one_grid = all(np.array_equal(other.voxels.keys, maps[0].voxels.keys) for other in maps[1:])
    of_voxels = [PointLabels.of_voxels(each) for each in maps]

    def label(scan: Scan) -> list[PointLabels] | None:
        try:
            points = scan.read()
            p_map, valid = map_points(points, scan, drive)
        except (DataError, MeasurementError):
            return None  # was reported when the map was built
        if not valid.any():
            return None  # likewise
        keys = keys_of(p_map, drive.settings.mapping.voxel_size_m)
        places = [_places(each, keys, valid) for each in (maps[:1] if one_grid else maps)]
        places *= len(maps) // len(places)
        found = [known.at(there) for known, there in zip(of_voxels, places, strict=True)]
        if kerbs is not None:
            inside, chosen, probability = kerbs.decide(keys, p_map)
            points_of_kerbs = np.flatnonzero(valid)[inside]
            found[-1].labels[points_of_kerbs] = chosen
            found[-1].confidence[points_of_kerbs] = probability
        if scan.number in moving:
            usable, moved = np.flatnonzero(valid), moving[scan.number]
            if moved.max(initial=-1) >= len(usable):
                raise DataError(
                    f"frame {scan.number}: found {len(usable)} usable points, expected more than {moved.max()}, which"
                    " is said to have moved; was the scan changed? make the run again"
                )
            movable = drive.label_set.having(*MOVABLE)
            _remove(found[-1], usable[moved], p_map[moved], movable)
        return found

    for scan, done in prefetch(label, scans, threads=threads()):
        if done is not None:
            yield scan, done


def _places(
    semantic_map: SemanticMap, keys: NDArray[np.int64], valid: NDArray[np.bool_]
) -> NDArray[np.int64]:
    """The voxel of every point (n,), -1 for none; `keys` are those of the valid points."""
    places = np.full(len(valid), -1)
    places[valid] = semantic_map.voxels.indices_of(keys)
    return places


def _remove(
    found: PointLabels, points: NDArray[np.int64], p_map: NDArray[np.float64], movable: Sequence[int]
) -> None:
    """Mark points, which are at `p_map` (m, 3) m, as removed, and call those of static voxels what may move.

    They have the class of the nearest one of their object that lies in a voxel of what moved, or the first.
    """
    found.removed[points] = True
    is_known = np.isin(found.labels[points], movable)
    if not movable or is_known.all():
        return
    classes = np.full(np.count_nonzero(~is_known), movable[0], np.int8)
    if len(movable) > 1 and is_known.any():
        away, nearest = KDTree(p_map[is_known]).query(p_map[~is_known])
        classes = np.where(away <= OF_ONE_OBJECT_M, found.labels[points[is_known]][nearest], classes)
    changed = points[~is_known]
    found.labels[changed], found.confidence[changed] = classes, 1 / (len(movable) + 1)
