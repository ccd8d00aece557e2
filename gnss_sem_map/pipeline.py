"""The whole flow on one page: a drive in, a trajectory and a semantic map out (Fig. 1 of the paper).

    preflight           the log against physics, and its sensors against each other: a probable mistake stops the run
    trajectory          GNSS and IMU, smoothed in batch (or the poses that came with the drive); sweeps matched by it
                        bind it in turn
    motion              which points belong to something that moved
    for every scan      deskew into the map, label from its image, fuse into the voxels
    refine              height, columns, vehicles, neighbours; levels of road and sidewalk

Files are the business of `io` and `export`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from factor_graphs.smoothing import Solution
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.config import Settings
from gnss_sem_map.dynamics.moving_objects import MovingObjects
from gnss_sem_map.evaluation import preflight
from gnss_sem_map.evaluation.map_sharpness import Sharpness, of_drive
from gnss_sem_map.evaluation.preflight.findings import Level, Preflight, PreflightError
from gnss_sem_map.labels import sensor_model
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.mapping.fusion import answers_fingerprint, build_maps
from gnss_sem_map.mapping.labelled_scans import Drive
from gnss_sem_map.mapping.moving_points import find_moving
from gnss_sem_map.mapping.surface_heights import surface_heights
from gnss_sem_map.mapping.trajectory import estimate_trajectory, final, solve
from gnss_sem_map.refinement import RefinementReport, refine, tell_ways
from gnss_sem_map.refinement.kerbs import Kerbs
from gnss_sem_map.run_stats import Progress, RunStats, silent
from gnss_sem_map.segmentation import Segmenter
from gnss_sem_map.segmentation.cached import CachedLabels
from gnss_sem_map.segmentation.cached_segmenter import CachedSegmenter, answers_folder
from gnss_sem_map.sensor_log import SensorLog
from gnss_sem_map.voxels.voxel_map import SemanticMap, State

__all__ = ["Result", "check_drive", "estimate_trajectory", "run", "solve"]

MATCHED_SHARE = 0.95
"""With so many of its scans matched a trajectory is sharp enough to tell what creeps from what stands."""


@dataclass(frozen=True, eq=False)
class Result:
    """Everything that a run made."""

    trajectory: Trajectory
    solution: Solution | None
    """How the smoother came to the trajectory; None when the poses came with the drive."""
    raw: SemanticMap
    refined: SemanticMap
    refinement: RefinementReport
    account: RunStats
    moving: Mapping[int, NDArray[np.int64]] | None = None
    """Frame number -> places of the points of moving objects among the scan's usable ones; None: not sought."""
    sharpness: Mapping[str, Sharpness] = field(default_factory=dict)
    """Of the "map", and of the one that "gnss and imu" alone would make, where LiDAR odometry helped."""
    kerbs: Kerbs | None = None
    """Where points of the refined map must be told apart into road and sidewalk."""
    preflight: Preflight = field(default_factory=lambda: Preflight((), 0.0))
    """What was found before any work."""


def run(
    log: SensorLog,
    segmenter: Segmenter | None,
    settings: Settings,
    progress: Progress = silent,
    *,
    work: Path | None = None,
    resume: bool = False,
    workers: int = 1,
    labels_from: str = "",
    force: bool = False,
) -> Result:
    """Trajectory, raw map and refined map of one drive.

    Without a segmenter, or without images, the map has no labels. What is mapped is kept in the folder `work` until
    the caller removes it, so that an interrupted run can `resume`; see `mapping.build_maps`. `force` goes on where the
    pre-flight is red. Raises PreflightError, DataError when not one scan can be used, MeasurementError and
    EstimationError from the smoother.
    """
    log = log.in_our_conventions(settings.sensors)
    account = RunStats(skips=list(log.skips))
    sensor_model.opened(
        settings.calibration, open_label_set(settings.classes)
    )  # of other classes: refused now
    page = check_drive(log, segmenter, settings, account, force)
    with account.stage("trajectory"):
        progress("trajectory", 0, 1)
        solutions = solve(log, settings, account, progress, page.solution)
        trajectory, solution = final(log, solutions)
        progress("trajectory", 1, 1)
    with account.stage("sharpness"):
        figures = of_drive(log, [trajectory, *(s.trajectory for s in solutions[:-1])], progress=progress)
        sharpness = dict(zip(("map", "gnss and imu"), figures, strict=False))
    whole = Drive(log, trajectory, segmenter, settings, matched=_is_matched(log, account))
    with _answers(whole, work, resume, labels_from) as folder:
        drive, found = _without_moving(whole, folder, account, progress)
        with account.stage("mapping"):
            maps = build_maps(
                drive, account, progress, work=work, resume=resume, workers=workers, labels_from=labels_from
            )
    with account.stage("refinement"):
        progress("refinement", 0, 1)
        calibration = sensor_model.opened(settings.calibration, maps.static.label_set)
        witnesses = found.keyframes if drive.matched else None
        refined, refinement = refine(
            maps.static, settings.refinement, maps.removed, found.objects, calibration, witnesses
        )
        refined, kerbs, levels = tell_ways(
            refined, settings.refinement, partial(surface_heights, log, trajectory, settings)
        )
        refinement = replace(refinement, steps=(*refinement.steps, levels))
        progress("refinement", 1, 1)
    if (refined.states == State.REMOVED).all():
        account.warnings.append("everything was taken for moving: what is drawn is what was removed")
    raw = SemanticMap.of(maps.static + maps.removed)
    return Result(
        trajectory, solution, raw, refined, refinement, account, drive.moving, sharpness, kerbs, page
    )


def check_drive(
    log: SensorLog, segmenter: Segmenter | None, settings: Settings, account: RunStats, force: bool = False
) -> Preflight:
    """The pre-flight; what is amber, and red where it is forced, becomes a warning. Raises PreflightError."""
    with account.stage("preflight"):
        page = preflight.check(log, settings, segmenter, with_camera=segmenter is not None)
    if page.level is Level.RED and not force:
        raise PreflightError(log.name, page)
    account.warnings.extend(str(finding) for finding in (*page.of(Level.RED), *page.of(Level.AMBER)))
    return page


@contextmanager
def _answers(drive: Drive, work: Path | None, resume: bool, labels_from: str) -> Iterator[Path]:
    """Where a network's answers are kept: with what is mapped, so that --resume asks for none twice."""
    if work is not None:
        yield answers_folder(work, answers_fingerprint(drive, labels_from), resume)
        return
    with TemporaryDirectory(prefix="gnss-sem-map-") as folder:
        yield Path(folder)


def _without_moving(
    drive: Drive, folder: Path, account: RunStats, progress: Progress
) -> tuple[Drive, MovingObjects]:
    """The drive with what moved in it, and why; a network's answers are kept in `folder` for the map."""
    log, settings = drive.log, drive.settings
    if settings.refinement.vehicles != "evidence":
        return drive, MovingObjects({}, ())
    is_network = drive.segmenter is not None and not isinstance(drive.segmenter, CachedLabels)
    if drive.segmenter is not None and is_network and log.calibration.image_size is not None:
        label_set = open_label_set(settings.classes)
        remembered = CachedSegmenter(drive.segmenter, label_set, log.calibration.image_size, folder)
        drive = replace(drive, segmenter=remembered)
    with account.stage("motion"):
        moving = find_moving(drive, progress)
    account.counts["points of moving objects"] += sum(map(len, moving.points.values()))
    return replace(drive, moving=moving.points), moving


def _is_matched(log: SensorLog, account: RunStats) -> bool:
    return account.counts["scans matched"] >= MATCHED_SHARE * max(len(log.scans), 1)
