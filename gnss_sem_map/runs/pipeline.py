"""The stages of a run: from a drive to its trajectory and its semantic map (Fig. 1 of the paper).

    preflight           check the log against physics, and its sensors against each other; a probable mistake stops
    trajectory          smooth GNSS and IMU in batch (or take the poses of the drive), then add LiDAR odometry, and
                        bind places that are passed again
    sharpness           measure the thickness of surfaces under the trajectories
    mapping             every scan once: deskew, label from its image, fuse into the voxels, find what moved
    refinement          the steps of `refinement.steps`, block by block

Maps are written into a folder, tile by tile. The other files of a run are written by `runs`, with `export`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from factor_graphs.corrections import Correction
from factor_graphs.geodesy import LocalFrame
from factor_graphs.smoothing import Solution
from factor_graphs.trajectory import Trajectory
from gnss_sem_map import preflight
from gnss_sem_map.config import Settings
from gnss_sem_map.dynamics.motion_state import TrackedObject
from gnss_sem_map.evaluation.map_sharpness import Sharpness, SweepSample, of_sample
from gnss_sem_map.files.work_folder import SWEEPS
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.mapping import fingerprints
from gnss_sem_map.mapping.classifying import fit_classifiers, opened_model
from gnss_sem_map.mapping.fusion import Elsewhere, map_scans
from gnss_sem_map.mapping.labelled_scans import Drive, pattern_sweeps
from gnss_sem_map.mapping.passes import TwoPasses
from gnss_sem_map.mapping.raw_map import open_raw, write_raw
from gnss_sem_map.mapping.refining import Refined, opened_sensor_model, refine_map
from gnss_sem_map.mapping.trajectory import (
    DriveTrajectory,
    Matcher,
    RegistrarOf,
    check_georeference,
    check_heights,
    estimate_trajectory,
    in_frame,
    locate,
    matches_scans,
)
from gnss_sem_map.preflight.findings import Level, Preflight, PreflightError
from gnss_sem_map.process.execution import Executor
from gnss_sem_map.process.machine import one_blas_thread
from gnss_sem_map.process.memory import release_memory
from gnss_sem_map.process.run_stats import Progress, RunStats, silent
from gnss_sem_map.scans.kept_sweeps import KeptSweeps
from gnss_sem_map.segmentation import Segmenter
from gnss_sem_map.segmentation.cached import CachedLabels
from gnss_sem_map.segmentation.cached_segmenter import CachedSegmenter, probabilities_folder
from gnss_sem_map.sensor_log import SensorLog

__all__ = [
    "Located",
    "Mapped",
    "check_drive",
    "estimate_trajectory",
    "in_frame",
    "locate",
    "map_drive",
    "refine",
    "run",
    "saving_sweeps",
]


@dataclass(frozen=True, eq=False)
class Located:
    """A drive and its trajectory, in the frame of the map."""

    log: SensorLog
    trajectory: Trajectory
    solution: Solution | None = None
    """Solution of the smoother, in the drive's own frame; None if the drive has poses."""
    alone: Trajectory | None = None
    """The trajectory before the drive was bound, to others or to itself; None where nothing binds it."""

    def in_short(self) -> Located:
        """What is needed to map it: no covariances, and nothing else that grows with the IMU stamps."""
        solution = None if self.solution is None else self.solution.in_short()
        return Located(self.log, replace(self.trajectory, covariances=None), solution)


@dataclass(frozen=True, eq=False)
class Mapped:
    """What is known of a drive beside its raw map and its evidence, which are in its folder."""

    log: SensorLog
    """In the frame of the map."""
    trajectory: Trajectory
    stats: RunStats
    objects: tuple[TrackedObject, ...] = ()
    """Objects through time, with the evidence of their motion."""
    untracked: int = 0
    """Objects that had too few points to be tracked."""
    solution: Solution | None = None
    """As `Located` has it."""
    passes: tuple[TwoPasses, ...] = ()
    """What the drive passed again."""
    sharpness: Mapping[str, Sharpness] = field(default_factory=dict)
    """Of the "map"; with LiDAR odometry, also with the poses of "gnss and imu" alone, or "given poses"."""
    from_lidar_odometry: bool = False
    """Whether the poses come from LiDAR odometry, so that static objects are not blurred in the map."""
    preflight: Preflight = field(default_factory=lambda: Preflight((), 0.0))
    """Findings of the pre-flight check."""


@one_blas_thread()
def run(
    log: SensorLog,
    segmenter: Segmenter | None,
    settings: Settings,
    folder: Path,
    work: Path,
    progress: Progress = silent,
    *,
    origin: LocalFrame | None = None,
    resume: bool = False,
    match: Matcher | None = None,
    registrar_of: RegistrarOf | None = None,
    elsewhere: Elsewhere | None = None,
    labels_from: str = "",
    force: bool = False,
    correction: Correction | None = None,
    write: Callable[[Located], None] | None = None,
) -> Mapped:
    """Trajectory of one drive; its raw map and evidence are written into `folder`.

    Without a segmenter, or without images, the map has no labels. The frame of the map is that of the drive, or
    `origin`. Intermediate results are kept in the folder `work` until the caller removes it, and used with `resume`;
    for this and `elsewhere` see `mapping.fusion.map_scans`, for `match` and `registrar_of`
    `mapping.trajectory.locate`. With `force`, a red pre-flight does not stop the run. `correction`: how the trajectory
    moves in the frame `origin` because the drive is bound to others; without one, the drive is bound to itself only.
    `write` gets the trajectory before anything is mapped, and what the map does not need of it is not held any longer.
    Raises PreflightError, DataError when not one scan can be used, and what the smoother raises.
    """
    log.check_scans()
    log = log.in_our_conventions(settings.sensors)
    check_georeference(log, origin, settings.mapping.voxel_size_m)
    stats = RunStats(skips=list(log.skips))
    opened_sensor_model(settings)  # one of other classes is refused now
    opened_model(settings)
    saved = work / SWEEPS if match is not None and matches_scans(log, settings) else None
    page, found, sharpness = _checked_and_located(
        log, segmenter, settings, stats, progress, force, match, registrar_of, saved, bound=correction is None
    )
    located = _in_map(log, found, origin, correction)
    check_heights(log.name, located.trajectory, settings.mapping.voxel_size_m)
    passes, from_lidar_odometry = found.passes, found.from_lidar_odometry
    del found
    if write is not None:
        with stats.stage("export"):
            write(located)
        located = located.in_short()
    release_memory(always=True)  # of graph and local map: holes too small for the arrays of scans
    drive = Drive(located.log, located.trajectory, segmenter, settings, saved)
    mapped = map_drive(
        drive, folder, work, stats, progress, resume=resume, elsewhere=elsewhere, labels_from=labels_from
    )
    return replace(
        mapped,
        solution=located.solution,
        passes=passes,
        sharpness=sharpness,
        from_lidar_odometry=from_lidar_odometry,
        preflight=page,
    )


def _in_map(
    log: SensorLog, found: DriveTrajectory, origin: LocalFrame | None, correction: Correction | None
) -> Located:
    """The trajectory that was found, in the frame of the map, and as the drive is bound to others."""
    alone = None if found.alone is None else in_frame(log, found.alone, origin)[1]
    log, trajectory = in_frame(log, found.trajectory, origin)
    if correction is not None:
        alone, trajectory = trajectory, correction.of(trajectory)
    return Located(log, trajectory, found.solution, alone)


def _checked_and_located(
    log: SensorLog,
    segmenter: Segmenter | None,
    settings: Settings,
    stats: RunStats,
    progress: Progress,
    force: bool,
    match: Matcher | None,
    registrar_of: RegistrarOf | None,
    saved: Path | None,
    bound: bool,
) -> tuple[Preflight, DriveTrajectory, dict[str, Sharpness]]:
    """All that comes before the map; the sweeps that the check has read are not read again."""
    sweeps = KeptSweeps()
    progress("preflight", 0, 1)
    page = check_drive(sweeps.keeping(log), segmenter, settings, stats, force)
    progress("preflight", 1, 1)
    found, sharpness = _located(
        sweeps.taking(log), settings, stats, progress, page.solution, match, registrar_of, saved, bound
    )
    if found.solution is not None and (said := page.other_clock(found.solution.calibration.time_offset_s)):
        stats.warnings.append(said)
    sweeps.forget()  # sections that are tasks have read their own: 35 MB
    return replace(page, solution=None), found, sharpness


def _located(
    log: SensorLog,
    settings: Settings,
    stats: RunStats,
    progress: Progress,
    first: Solution | None,
    match: Matcher | None,
    registrar_of: RegistrarOf | None,
    saved: Path | None,
    bound: bool,
) -> tuple[DriveTrajectory, dict[str, Sharpness]]:
    """The trajectory of a drive, and how sharp a map it makes."""
    with stats.stage("trajectory"):
        progress("trajectory", 0, 1)
        found = locate(log, settings, stats, progress, first, match, bound, registrar_of, saved)
        progress("trajectory", 1, 1)
    with stats.stage("sharpness"):
        trajectories = [found.trajectory, *([found.without_lidar] if found.without_lidar else [])]
        sample = SweepSample(log, folder=saved)
        figures = of_sample(sample, trajectories, progress)
        sample.sweeps.forget()  # 100 MB
    names = "map", "gnss and imu" if log.given is None else "given poses"
    return replace(found, without_lidar=None), dict(zip(names, figures, strict=False))


def saving_sweeps(log: SensorLog, folder: Path) -> SensorLog:
    """The log, of which the sweeps that are needed once more beside mapping are saved when they are read."""
    log = SweepSample(log, folder=folder).sweeps.listening()
    return pattern_sweeps(log, folder).listening()


def map_drive(
    drive: Drive,
    folder: Path,
    work: Path,
    stats: RunStats,
    progress: Progress = silent,
    *,
    resume: bool = False,
    elsewhere: Elsewhere | None = None,
    labels_from: str = "",
) -> Mapped:
    """Raw map and evidence of a drive whose trajectory is known; see `run`."""
    with stats.stage("mapping"):
        store = map_scans(
            _remembered(drive, work, resume, labels_from),
            work,
            stats,
            progress,
            resume=resume,
            elsewhere=elsewhere,
            labels_from=labels_from,
        )
        release_memory(always=True)  # of the chunks: a tile of the map is the sum of those of many
        write_raw(store, folder, drive.log.frame)
    if stats.counts["points"] - stats.counts["points left out"] == stats.counts["points of moving objects"]:
        stats.warnings.append("all points were removed as moving: the pictures show the removed points")
    return Mapped(
        drive.log,
        drive.trajectory,
        stats,
        store.objects(),
        store.untracked(),
    )


def refine(
    folder: Path,
    settings: Settings,
    stats: RunStats,
    progress: Progress = silent,
    earlier: Path | None = None,
    *,
    executor: Executor | None = None,
    work: Path | None = None,
) -> Refined:
    """Write `refined/` of a run folder from its raw map and evidence; see `refinement.steps`.

    Of an `earlier` run, and of the folder `work` of an interrupted one, tiles that were refined from the same are
    taken. Tiles are tasks of `executor`, by default in this process.
    """
    with stats.stage("classifier"):
        stats.warnings += fit_classifiers(folder, settings, executor)
    with stats.stage("refinement"):
        raw = open_raw(folder, open_label_set(settings.classes))
        return refine_map(raw, folder, settings, progress, earlier, executor=executor, work=work)


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


def _remembered(drive: Drive, work: Path, resume: bool, labels_from: str) -> Drive:
    """The drive with a network whose answers are kept in `work`: --resume segments no image twice."""
    if drive.segmenter is None or not drive.log.cameras or isinstance(drive.segmenter, CachedLabels):
        return drive
    sizes = drive.log.calibration.image_sizes
    folder = probabilities_folder(work, fingerprints.of_probabilities(drive, labels_from), resume, sizes)
    return replace(drive, segmenter=CachedSegmenter(drive.segmenter, drive.label_set, sizes, folder))
