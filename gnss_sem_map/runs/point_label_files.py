"""Point labels of a run: for every original LiDAR point what the maps say of it, file by file beside the scans."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np

from factor_graphs.trajectory import Trajectory
from gnss_sem_map.config import Settings
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.mapping import evidence
from gnss_sem_map.mapping.point_labels import label_points
from gnss_sem_map.mapping.raw_map import MAP
from gnss_sem_map.mapping.refining import REFINED
from gnss_sem_map.refinement.kerb_points import Kerbs
from gnss_sem_map.sensor_log import SensorLog
from gnss_sem_map.voxels import tiles

RAW_LABELS = "labels_raw"
LABELS = ("labels", RAW_LABELS, "confidence", "looks", "removed")
"""Folders of the point labels of one drive."""


def write_point_labels(
    folder: Path,
    log: SensorLog,
    trajectory: Trajectory,
    kerbs: Kerbs | None,
    settings: Settings,
    known_raw: Path | None = None,
    run: Path | None = None,
) -> None:
    """Write for every original point: class before and after refinement, confidence, LiDAR points of its voxel, and
    whether it was removed.

    `.label` files hold uint32, SemanticKITTI raw ids or, in removed/, 1 for moving vehicles; confidence/ holds float16,
    looks/ uint8. Of several LiDARs, each has a folder of its name. `known_raw`: a folder with the labels before
    refinement, which are copied. `run`: the folder of the maps, if it is another one.
    """
    for name in LABELS:
        for one in log.by_lidar:
            (folder / name / one.lidar).mkdir(parents=True, exist_ok=True)
    if known_raw is not None:
        shutil.copytree(known_raw, folder / RAW_LABELS, dirs_exist_ok=True)
    label_set = open_label_set(settings.classes)
    ids = np.append(label_set.semantic_kitti_ids, 0).astype("<u4")  # the label -1 finds the last
    places = [(run or folder) / name for name in (MAP, REFINED)[known_raw is not None :]]
    maps = [tiles.open_map(place, label_set) for place in places]
    beside = evidence.read(folder, label_set)
    for one in log.by_lidar:
        moving = beside.moving_points_of(one.lidar)
        for scan, (*raw, refined) in label_points(one, trajectory, maps, settings, moving, kerbs):
            place = Path(one.lidar) / scan.name
            if raw:
                ids[raw[0].labels].tofile(folder / RAW_LABELS / f"{place}.label")
            ids[refined.labels].tofile(folder / "labels" / f"{place}.label")
            refined.confidence.astype("<f2").tofile(folder / "confidence" / f"{place}.bin")
            refined.looks.tofile(folder / "looks" / f"{place}.bin")
            refined.removed.astype("<u4").tofile(folder / "removed" / f"{place}.label")
