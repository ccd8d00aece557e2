"""The whole flow on one page: a drive in, a trajectory and a semantic map out (Fig. 1 of the paper).

    trajectory          GNSS and IMU, smoothed in batch (or the poses that came with the drive)
    for every scan      deskew into the map, label from its image, fuse into the voxels
    refine              buildings against vegetation, moving vehicles

Files are the business of `io` and `export`.
"""

from __future__ import annotations

from dataclasses import dataclass

from factor_graphs.smoothing import Solution, smooth
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.account import Account, Progress, silent
from gnss_sem_map.config import Settings
from gnss_sem_map.errors import DataError
from gnss_sem_map.mapping import build_map
from gnss_sem_map.refinement import RefinementReport, refine
from gnss_sem_map.segmentation import Segmenter
from gnss_sem_map.sensor_log import SensorLog
from gnss_sem_map.voxel_map import SemanticMap


@dataclass(frozen=True, eq=False)
class Result:
    """Everything that a run made."""

    trajectory: Trajectory
    solution: Solution | None
    """How the smoother came to the trajectory; None when the poses came with the drive."""
    raw: SemanticMap
    refined: SemanticMap
    refinement: RefinementReport
    account: Account


def run(
    log: SensorLog, segmenter: Segmenter | None, settings: Settings, progress: Progress = silent
) -> Result:
    """Trajectory, raw map and refined map of one drive.

    Without a segmenter, or without images, the map has no labels. Raises DataError when not one scan can be used,
    MeasurementError and EstimationError from the smoother.
    """
    account = Account(skips=list(log.skips))
    with account.stage("trajectory"):
        progress("trajectory", 0, 1)
        trajectory, solution = estimate_trajectory(log, settings, account)
        progress("trajectory", 1, 1)
    with account.stage("mapping"):
        voxels = build_map(log, trajectory, segmenter, settings, account, progress)
    with account.stage("refinement"):
        progress("refinement", 0, 1)
        refined, refinement = refine(voxels, settings.refinement)
        progress("refinement", 1, 1)
    return Result(trajectory, solution, SemanticMap.of(voxels), refined, refinement, account)


def estimate_trajectory(
    log: SensorLog, settings: Settings, account: Account
) -> tuple[Trajectory, Solution | None]:
    """The poses that came with the drive, or GNSS and IMU smoothed."""
    if log.given is not None:
        return log.given, None
    if log.imu is None or log.gnss is None or log.frame is None:
        raise DataError(f"{log.name}: found neither poses nor IMU with GNSS; expected one of them")
    smoother = settings.trajectory
    if log.imu_noise is not None and "imu_noise" not in smoother.model_fields_set:
        smoother = smoother.model_copy(update={"imu_noise": log.imu_noise})
    solution = smooth(
        log.imu, log.gnss, log.frame, smoother, log.calibration.p_imu_antenna, log.initial_attitude
    )
    account.warnings.extend(solution.notes)
    return solution.trajectory, solution
