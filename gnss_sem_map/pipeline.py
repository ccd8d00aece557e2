"""The stages of a run: from a drive to its trajectory and its semantic map (Fig. 1 of the paper).

    preflight           check the log against physics, and its sensors against each other; a probable mistake stops
    trajectory          smooth GNSS and IMU in batch (or take the poses of the drive), then add LiDAR odometry
    sharpness           measure the thickness of surfaces under the trajectories
    motion              find the points of moving objects
    mapping             every scan: deskew into the map, label from its image, fuse into the voxels
    refinement          the steps of `refinement.steps`

Result folders are written by `runs`, their files by `export`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory

from factor_graphs.smoothing import Solution
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.config import Settings
from gnss_sem_map.dynamics.moving_objects import MovingObjects
from gnss_sem_map.evaluation import preflight
from gnss_sem_map.evaluation.map_sharpness import Sharpness, of_drive
from gnss_sem_map.evaluation.preflight.findings import Level, Preflight, PreflightError
from gnss_sem_map.labels import sensor_model
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.labels.sensor_model import LabelCalibration
from gnss_sem_map.mapping.evidence import RunEvidence
from gnss_sem_map.mapping.fusion import build_maps, probabilities_fingerprint
from gnss_sem_map.mapping.labelled_scans import Drive
from gnss_sem_map.mapping.motion_checkpoint import MotionCheckpoint, open_checkpoint
from gnss_sem_map.mapping.moving_points import find_moving
from gnss_sem_map.mapping.surface_heights import measure_surface_heights
from gnss_sem_map.mapping.trajectory import estimate_trajectory, locate
from gnss_sem_map.refinement.kerb_points import Kerbs
from gnss_sem_map.refinement.road_sidewalk import road_and_sidewalk
from gnss_sem_map.refinement.state import Evidence, MapState
from gnss_sem_map.refinement.steps import RefinementReport, run_steps
from gnss_sem_map.refinement.surface_heights import SurfaceHeights
from gnss_sem_map.run_stats import Progress, RunStats, silent
from gnss_sem_map.segmentation import Segmenter
from gnss_sem_map.segmentation.cached import CachedLabels
from gnss_sem_map.segmentation.cached_segmenter import CachedSegmenter, probabilities_folder
from gnss_sem_map.sensor_log import SensorLog
from gnss_sem_map.voxels.semantic_map import SemanticMap, State
from gnss_sem_map.voxels.voxel_map import VoxelMap

__all__ = ["Result", "check_drive", "estimate_trajectory", "locate", "map_drive", "refine_map", "run"]


@dataclass(frozen=True, eq=False)
class Result:
    """The results of a run."""

    trajectory: Trajectory
    solution: Solution | None
    """Solution of the smoother; None if the drive has poses."""
    raw: SemanticMap
    refined: SemanticMap
    refinement: RefinementReport
    stats: RunStats
    evidence: RunEvidence
    """Evidence besides the map, with which it can be refined again."""
    sharpness: Mapping[str, Sharpness] = field(default_factory=dict)
    """Of the "map"; with LiDAR odometry, also of a map with the poses of "gnss and imu" alone."""
    from_lidar_odometry: bool = False
    """Whether the poses come from LiDAR odometry, so that static objects are not blurred in the map."""
    kerbs: Kerbs | None = None
    """Voxels of the refined map whose points are classified one by one."""
    preflight: Preflight = field(default_factory=lambda: Preflight((), 0.0))
    """Findings of the pre-flight check."""


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

    Without a segmenter, or without images, the map has no labels. Intermediate results are kept in the folder `work`
    until the caller removes it, and used with `resume`; see `mapping.fusion.build_maps`. With `force`, a red pre-flight
    does not stop the run. Raises PreflightError, DataError when not one scan can be used, MeasurementError and
    EstimationError from the smoother.
    """
    log = log.in_our_conventions(settings.sensors)
    stats = RunStats(skips=list(log.skips))
    _sensor_model(settings)  # one of other classes is refused now
    page = check_drive(log, segmenter, settings, stats, force)
    with stats.stage("trajectory"):
        progress("trajectory", 0, 1)
        found = locate(log, settings, stats, progress, page.solution)
        progress("trajectory", 1, 1)
    with stats.stage("sharpness"):
        trajectories = [found.trajectory, *([found.without_lidar] if found.without_lidar else [])]
        figures = of_drive(log, trajectories, progress=progress)
        sharpness = dict(zip(("map", "gnss and imu"), figures, strict=False))
    drive = Drive(log, found.trajectory, segmenter, settings, from_lidar_odometry=found.from_lidar_odometry)
    result = map_drive(
        drive, stats, progress, work=work, resume=resume, workers=workers, labels_from=labels_from
    )
    return replace(result, solution=found.solution, sharpness=sharpness, preflight=page)


def map_drive(
    drive: Drive,
    stats: RunStats,
    progress: Progress = silent,
    *,
    work: Path | None = None,
    resume: bool = False,
    workers: int = 1,
    labels_from: str = "",
) -> Result:
    """Raw map and refined map of a drive whose trajectory is known; see `run`."""
    with _probabilities(drive, work, resume, labels_from) as folder:
        checkpoint = None if work is None else open_checkpoint(work, drive, labels_from, resume)
        drive, found = _without_moving(drive, folder, checkpoint, stats, progress)
        with stats.stage("mapping"):
            maps = build_maps(
                drive, stats, progress, work=work, resume=resume, workers=workers, labels_from=labels_from
            )
    raw = SemanticMap.of(maps.static + maps.removed)
    with stats.stage("refinement"):
        progress("refinement", 0, 1)
        keyframes = found.keyframes if drive.from_lidar_odometry else None
        heights = _heights(drive, raw.voxels)
        evidence = RunEvidence(maps.removed, drive.moving or {}, keyframes, heights)
        state, report = refine_map(maps.static, evidence, drive.settings)
        progress("refinement", 1, 1)
    refined = _decided(state)
    if (refined.states == State.REMOVED).all():
        stats.warnings.append("all points were removed as moving: the pictures show the removed points")
    report = replace(report, tracked=found.objects)
    return Result(
        drive.trajectory, None, raw, refined, report, stats, evidence,
        from_lidar_odometry=drive.from_lidar_odometry, kerbs=state.kerbs,
    )  # fmt: skip


def refine_map(
    static: VoxelMap, evidence: RunEvidence, settings: Settings
) -> tuple[MapState, RefinementReport]:
    """Refine the static map with all evidence besides it; see `refinement.steps`."""
    beside = Evidence(evidence.moved, _sensor_model(settings), evidence.keyframes, evidence.surface_heights)
    return run_steps(static, settings.refinement, beside)


def _decided(state: MapState) -> SemanticMap:
    assert state.decided is not None
    return state.decided


def _sensor_model(settings: Settings) -> LabelCalibration | None:
    return sensor_model.opened(settings.calibration, open_label_set(settings.classes))


def _heights(drive: Drive, voxels: VoxelMap) -> SurfaceHeights | None:
    """Heights of surfaces, if a step needs them and the map has labels."""
    steps, label_set = drive.settings.refinement, drive.label_set
    if (
        road_and_sidewalk(label_set) is None
        or not (steps.levels.enabled or steps.kerbs.enabled)
        or not voxels.observed.any()
    ):
        return None
    return measure_surface_heights(drive.log, drive.trajectory, drive.settings, voxels)


def check_drive(
    log: SensorLog, segmenter: Segmenter | None, settings: Settings, stats: RunStats, force: bool = False
) -> Preflight:
    """The pre-flight check; amber findings, and red ones with `force`, become warnings. Raises PreflightError."""
    with stats.stage("preflight"):
        page = preflight.check(log, settings, segmenter, with_camera=segmenter is not None)
    if page.level is Level.RED and not force:
        raise PreflightError(log.name, page)
    stats.warnings.extend(str(finding) for finding in (*page.of(Level.RED), *page.of(Level.AMBER)))
    return page


@contextmanager
def _probabilities(drive: Drive, work: Path | None, resume: bool, labels_from: str) -> Iterator[Path]:
    """Folder for the probabilities of a network, in `work` if there is one: --resume segments no image twice."""
    if work is not None:
        yield probabilities_folder(work, probabilities_fingerprint(drive, labels_from), resume)
        return
    with TemporaryDirectory(prefix="gnss-sem-map-") as folder:
        yield Path(folder)


def _without_moving(
    drive: Drive, folder: Path, checkpoint: MotionCheckpoint | None, stats: RunStats, progress: Progress
) -> tuple[Drive, MovingObjects]:
    """The drive with its moving points, and the moving objects; probabilities of a network are kept in `folder`."""
    log, settings = drive.log, drive.settings
    if not settings.dynamics.enabled:
        return drive, MovingObjects({}, ())
    is_network = drive.segmenter is not None and not isinstance(drive.segmenter, CachedLabels)
    if drive.segmenter is not None and is_network and log.calibration.image_size is not None:
        label_set = open_label_set(settings.classes)
        cached = CachedSegmenter(drive.segmenter, label_set, log.calibration.image_size, folder)
        drive = replace(drive, segmenter=cached)
    with stats.stage("motion"):
        moving = _searched(drive, checkpoint, progress)
    stats.counts["points of moving objects"] += sum(map(len, moving.points.values()))
    return replace(drive, moving=moving.points), moving


def _searched(drive: Drive, checkpoint: MotionCheckpoint | None, progress: Progress) -> MovingObjects:
    """The moving objects of a drive, from the checkpoint where it has them."""
    if checkpoint is None:
        return find_moving(drive, progress)
    moving = checkpoint.read()
    if moving is None:
        moving = find_moving(drive, progress)
        checkpoint.write(moving)
    return moving
