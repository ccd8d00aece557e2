"""Search for the points of moving objects in all scans of a drive, before mapping."""

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
"""Classes of objects that may move, if the class set has them."""


def find_moving(drive: Drive, progress: Progress = silent) -> MovingObjects:
    """The moving points among the usable points of all scans, and the moving objects; skips are counted when mapping.

    Objects outside of all images are tracked too, but count as moving only if they were displaced.
    """
    detector = MovingObjectDetector(drive.settings.dynamics, drive.from_lidar_odometry)
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


def movable_and_known(
    shown: NDArray[np.int8], class_names: tuple[str, ...]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Masks of the points that the image labels as movable (n,), and of those that it labels at all (n,).

    `shown` (n,) as `LabelledScan.labels`. The class `other` may be a pole or a pedestrian, so it counts as unknown.
    """
    is_movable = np.isin([*class_names, OTHER, ""], MOVABLE)  # the last one: not in an image
    return is_movable.take(shown), (shown >= 0) & (shown < len(class_names))


def _observed(seen: LabelledScan) -> Observation:
    drive, scan = seen.drive, seen.scan
    T_map_imu = drive.trajectory.at(np.array([scan.stamp]), EXTRAPOLATE_S)[0]
    T_map_lidar = T_map_imu @ drive.log.calibration.T_imu_lidar
    return observe(
        scan.number, scan.stamp, seen.p_map, T_map_lidar, *movable_and_known(seen.labels, drive.label_set.names),
        drive.settings.dynamics,
    )  # fmt: skip
