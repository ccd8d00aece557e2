"""Before the map: which points of a drive belong to something that moved."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.dynamics.motion_state import TrackedObject
from gnss_sem_map.dynamics.moving_objects import MovingObjectDetector, MovingObjects, Observation, observe
from gnss_sem_map.dynamics.visibility import THREADS, KeyframeSelector
from gnss_sem_map.labels.label_set import OTHER
from gnss_sem_map.mapping.labelled_scans import Drive, LabelledScan, labelled_scans
from gnss_sem_map.run_stats import Progress, silent
from gnss_sem_map.scans.deskew import EXTRAPOLATE_S
from gnss_sem_map.scans.prefetch import prefetch

MOVABLE = ("vehicle", "person", "pedestrian", "rider", "cyclist", "bicycle", "motorcycle")
"""Classes, where the class set has them, whose objects may move."""


def find_moving(drive: Drive, progress: Progress = silent) -> MovingObjects:
    """Look at all scans once, and say which of their usable points moved; skips are counted when mapping.

    What no image shows is followed too, but is only said to have moved when it was seen to go elsewhere.
    """
    detector = MovingObjectDetector(drive.settings.dynamics, drive.matched)
    along = KeyframeSelector()
    points: dict[int, NDArray[np.int64]] = {}
    objects: list[TrackedObject] = []
    total = len(drive.log.scans)
    for done, (_, observation) in enumerate(
        prefetch(_observed, labelled_scans(drive, keep_points=True), THREADS), 1
    ):
        detector.add(observation)
        along.add(observation.stamp, observation.image, observation.T_lidar_map)
        settled = detector.settle()
        points.update(settled.points)
        objects += settled.objects
        progress("motion", done, total)
    rest = detector.decide()
    progress("motion", total, total)
    return MovingObjects(points | dict(rest.points), (*objects, *rest.objects), along.keyframes())


def told(
    shown: NDArray[np.int8], class_names: tuple[str, ...]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which points the image calls something that may move (n,), and of which it says anything (n,).

    `shown` (n,) as `LabelledScan.labels`. What is `other` to the map may be a pole or a pedestrian: unknown.
    """
    is_movable = np.isin([*class_names, OTHER, ""], MOVABLE)  # the last one: in no image
    return is_movable.take(shown), (shown >= 0) & (shown < len(class_names))


def _observed(seen: LabelledScan) -> Observation:
    drive, scan = seen.drive, seen.scan
    T_map_imu = drive.trajectory.at(np.array([scan.stamp]), EXTRAPOLATE_S)[0]
    T_map_lidar = T_map_imu @ drive.log.calibration.T_imu_lidar
    return observe(
        scan.number, scan.stamp, seen.p_map, T_map_lidar, *told(seen.labels, drive.label_set.names),
        drive.settings.dynamics,
    )  # fmt: skip
