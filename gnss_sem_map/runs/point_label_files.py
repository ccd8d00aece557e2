"""Point labels of a run: for every original LiDAR point what the maps say of it, a file for each scan."""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from factor_graphs.trajectory import Trajectory
from gnss_sem_map.config import Settings
from gnss_sem_map.files.untrusted import is_folder
from gnss_sem_map.files.work_folder import DRIVES
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.mapping import evidence
from gnss_sem_map.mapping.point_labels import PointLabels, label_points
from gnss_sem_map.mapping.raw_map import MAP
from gnss_sem_map.mapping.refining import REFINED
from gnss_sem_map.process.machine import threads
from gnss_sem_map.process.prefetch import prefetch
from gnss_sem_map.process.run_stats import Progress, silent
from gnss_sem_map.refinement.kerb_points import Kerbs
from gnss_sem_map.sensor_log import Scan, SensorLog
from gnss_sem_map.voxels import tiles
from gnss_sem_map.voxels.tiles import TiledMap

RAW_LABELS = "labels_raw"
LABELS = ("labels", RAW_LABELS, "confidence", "looks", "removed")
"""Folders of the point labels of one drive."""


def has_point_labels(out: Path) -> bool:
    """Whether a finished map has labels of LiDAR points, as it is or of its drives."""
    return is_folder(out / RAW_LABELS) or any(out.glob(f"{DRIVES}/*/{RAW_LABELS}"))


@dataclass(frozen=True, eq=False)
class LabelledDrive:
    """A drive of which every point is labelled."""

    folder: Path
    """Where its evidence is, and its labels will be."""
    log: SensorLog
    """In the frame of the map."""
    trajectory: Trajectory
    known_raw: Path | None = None
    """A folder with the labels before refinement, which are copied."""


def write_point_labels(
    run: Path,
    drives: Iterable[LabelledDrive],
    kerbs: Kerbs | None,
    settings: Settings,
    progress: Progress = silent,
) -> None:
    """Write for every original point of some drives of a run what its maps say of it.

    Of points: class before and after refinement, confidence, LiDAR points of its voxel, and whether it was removed.
    `.label` files hold uint32, SemanticKITTI raw ids or, in removed/, 1 for moving vehicles; confidence/ holds float16,
    looks/ uint8. Of several LiDARs, each has a folder of its name.
    """
    refined = tiles.open_map(run / REFINED, open_label_set(settings.classes))
    for drive in drives:
        _label(drive, run, refined, kerbs, settings, progress)


def _label(
    drive: LabelledDrive,
    run: Path,
    refined: TiledMap,
    kerbs: Kerbs | None,
    settings: Settings,
    progress: Progress,
) -> None:
    folder, label_set = drive.folder, refined.label_set
    for name in LABELS:
        for one in drive.log.by_lidar:
            (folder / name / one.lidar).mkdir(parents=True, exist_ok=True)
    maps = [refined]
    if drive.known_raw is None:
        maps = [tiles.open_map(run / MAP, label_set), refined]
    else:
        shutil.copytree(drive.known_raw, folder / RAW_LABELS, dirs_exist_ok=True)
    ids = np.append(label_set.legend.semantic_kitti_ids, 0).astype("<u4")  # the label -1 finds the last
    beside = evidence.read(folder, label_set)
    for one in drive.log.by_lidar:
        moving = beside.moving_points_of(one.lidar)
        labelled = label_points(one, drive.trajectory, maps, settings, moving, kerbs)
        writing = prefetch(partial(_write, folder, Path(one.lidar), ids), labelled, threads())
        for done, _ in enumerate(writing, 1):
            progress("labels", done, len(one.scans))
        progress("labels", len(one.scans), len(one.scans))  # those that are skipped have none


def _write(
    folder: Path, lidar: Path, ids: NDArray[np.uint32], labelled: tuple[Scan, list[PointLabels]]
) -> None:
    """Write the labels of one scan, with these ids of the classes, of `other` and, at the end, of none."""
    scan, (*raw, after) = labelled
    label_file, other_file = lidar / f"{scan.name}.label", lidar / f"{scan.name}.bin"
    if raw:
        ids[raw[0].labels].tofile(folder / RAW_LABELS / label_file)
    ids[after.labels].tofile(folder / "labels" / label_file)
    after.confidence.astype("<f2").tofile(folder / "confidence" / other_file)
    after.looks.tofile(folder / "looks" / other_file)
    after.removed.astype("<u4").tofile(folder / "removed" / label_file)
