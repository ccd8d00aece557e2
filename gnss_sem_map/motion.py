"""Before the map: which points of a drive belong to something that moved."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map import labels
from gnss_sem_map.account import Progress, silent
from gnss_sem_map.deskew import EXTRAPOLATE_S
from gnss_sem_map.refinement.moving_objects import MovingObjectDetector, MovingObjects
from gnss_sem_map.refinement.verdicts import TrackedObject
from gnss_sem_map.seen_scans import Drive, seen_scans

MOVABLE = ("vehicle", "person", "pedestrian", "rider", "cyclist", "bicycle", "motorcycle")
"""Classes, where the class set has them, whose objects may move."""


def find_moving(drive: Drive, progress: Progress = silent) -> MovingObjects:
    """Look at all scans once, and say which of their usable points moved; skips are counted when mapping.

    What no image shows is followed too, but is only said to have moved when it was seen to go elsewhere.
    """
    detector = MovingObjectDetector(drive.settings.refinement.motion)
    label_set = labels.label_set(drive.settings.classes)
    movable = [label_set.index(name) for name in MOVABLE if name in label_set.names]
    points: dict[int, NDArray[np.int64]] = {}
    objects: list[TrackedObject] = []
    total = len(drive.log.scans)
    for done, seen in enumerate(seen_scans(drive), 1):
        T_map_imu = drive.trajectory.at(np.array([seen.scan.stamp]), EXTRAPOLATE_S)[0]
        T_map_lidar = T_map_imu @ drive.log.calibration.T_imu_lidar
        shown = seen.labels
        is_object, is_known = np.isin(shown, movable), shown >= 0
        detector.observe(seen.scan.number, seen.scan.stamp, seen.p_map, T_map_lidar, is_object, is_known)
        settled = detector.settle()
        points.update(settled.points)
        objects += settled.objects
        progress("motion", done, total)
    rest = detector.decide()
    progress("motion", total, total)
    return MovingObjects(points | dict(rest.points), (*objects, *rest.objects))
