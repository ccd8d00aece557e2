"""From logs to a map (Fig. 1 of the paper): one drive is a map of one.

    check       every log against physics, and its sensors against each other; a probable mistake stops
    match       LiDAR odometry, a section of the scans at a time
    locate      GNSS, IMU and odometry smoothed in batch, or the poses of the drive
    bind        places that are passed again, by the same drive or by another one
    place       every trajectory in the frame of the map, and how sharp a map it makes
    map         every scan once: deskew, label from its image, fuse into the voxels, find what moved
    add         the maps of all drives, tile by tile
    refine      the steps of `refinement.steps`, block by block
    deliver     files for the next tool, report, run.json

Every stage is a flat list of tasks, of all drives, on whatever calls them: this process, others, a cluster. What a task
finds is remembered with the digest of what it was made from (`files.memo`, and tiles with their records): resuming,
adding and taking out a drive, and refining again, are doing what is not there yet.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import ceil
from pathlib import Path
from typing import Any

from factor_graphs.trajectory import Trajectory
from gnss_sem_map.config import Settings
from gnss_sem_map.files.output_folder import new_folder
from gnss_sem_map.files.run_json import read_run
from gnss_sem_map.files.work_folder import remove_chunks, remove_sweeps, writing_to
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.mapping import fusion
from gnss_sem_map.mapping.classifying import fit_classifiers
from gnss_sem_map.mapping.raw_map import open_raw, write_sum
from gnss_sem_map.mapping.refining import Refined, refine_map
from gnss_sem_map.mapping.trajectory import estimate_trajectory, in_frame, locate
from gnss_sem_map.preflight import check_drive
from gnss_sem_map.process.dask_cluster import Cluster
from gnss_sem_map.process.execution import Executor
from gnss_sem_map.process.run_stats import Progress, RunStats, silent
from gnss_sem_map.process.worker_processes import Processes
from gnss_sem_map.runs import drive_tasks
from gnss_sem_map.runs.binding import BoundDrives, LocatedJob, bind, with_unheld
from gnss_sem_map.runs.delivery import RefinedMap, deliver_drives, deliver_one, link_drives, link_map
from gnss_sem_map.runs.drive_job import DriveJob, closing_drives, give, job_for, opened
from gnss_sem_map.runs.map_job import MapJob, task_of
from gnss_sem_map.runs.source import Source
from gnss_sem_map.scans.base_cloud import BaseCloud
from gnss_sem_map.scans.lidar_odometry import sections_of
from gnss_sem_map.segmentation import Segmenter
from gnss_sem_map.sensor_log import SensorLog, Skip

__all__ = [
    "check_drive",
    "estimate_trajectory",
    "in_frame",
    "locate",
    "locate_drives",
    "map_drives",
    "refine",
]

DRIVES_AT_ONCE = 16
"""Chunks of so many drives are on disk at a time."""
CHUNKS_ON_CLUSTER = 4
"""Chunks of a task on a cluster, whose workers come and go."""


def locate_drives(drives: Sequence[DriveJob], run: MapJob) -> tuple[dict[str, LocatedJob], dict[str, str]]:
    """The trajectory of every drive, in its own frame: check, match, locate; and the digest of all that was read."""
    jobs = {job.name: job.begin() for job in drives}
    check = {name: [task_of(name, drive_tasks.check, *job.key)] for name, job in jobs.items()}
    checked = {name: found for name, [found] in run.call("preflight", check).items()}
    match = {
        name: [
            task_of(
                f"{name}, section {n} of its scans",
                drive_tasks.match, *jobs[name].key, found["matches"], n, size=len(section),
            )
            for n, section in enumerate(sections_of(found["scans"], run.settings.trajectory.scan_matching))
            if found["matches"] is not None
        ]
        for name, found in checked.items()
    }  # fmt: skip
    locate = {
        name: [task_of(name, drive_tasks.locate, *jobs[name].key, checked[name]["matches"])]
        for name in run.call("scan matching", match)
    }
    located = {
        name: LocatedJob(jobs[name], checked[name]["matches"], key)
        for name, [key] in run.call("trajectory", locate).items()
    }
    return located, {name: checked[name]["read"] for name in located}


def map_drives(
    drives: Mapping[str, LocatedJob], read: Mapping[str, str], bound: BoundDrives, run: MapJob
) -> dict[str, Path]:
    """The folder of the map of every located drive: place, map, finish. `read`: digest of all that was read of each."""
    names = [
        name for name, one in drives.items() if not one.job.is_made(read[name], bound.held.get(name, ""))
    ]
    made = {name: one.job.made for name, one in drives.items() if name not in names}
    for start in range(0, len(names), DRIVES_AT_ONCE):
        some = {name: drives[name] for name in names[start : start + DRIVES_AT_ONCE]}
        for name in _mapped(some, bound, run):
            made[name] = drives[name].job.made
            with writing_to(run.work):
                remove_chunks(drives[name].job.folder)
                remove_sweeps(drives[name].job.folder)
    return made


def _mapped(drives: Mapping[str, LocatedJob], bound: BoundDrives, run: MapJob) -> list[str]:
    """Names of the drives whose map is written."""
    place = {
        name: [task_of(name, drive_tasks.place, *one.job.key, one.located, bound.keys[name])]
        for name, one in drives.items()
    }
    placed = {name: found for name, [found] in run.call("sharpness", place).items()}
    stores = {
        name: fusion.store_of(drives[name].job.folder, found["map"], len(found["chunks"]), run.settings)
        for name, found in placed.items()
    }
    for store in stores.values():
        store.begun(resume=run.is_one or store.is_begun())
    length = _chunks_per_task(sum(store.count for store in stores.values()), run.executor)
    chunks = {
        name: [
            task_of(
                f"{name}, chunks {numbers.start} to {numbers.stop - 1}",
                drive_tasks.map_range, *drives[name].job.key, store.fingerprint, numbers.start, numbers.stop,
                size=sum(placed[name]["chunks"][numbers.start : numbers.stop]),
            )
            for numbers in fusion.ranges(store.pending(), length)
        ]
        for name, store in stores.items()
    }  # fmt: skip
    finish = {
        name: [
            task_of(
                name, drive_tasks.finish, *drives[name].job.key,
                {"located": drives[name].located, "bound": bound.keys[name], "mapped": placed[name]["map"]},
                sum(seconds),
            )
        ]
        for name, seconds in run.call("mapping", chunks).items()
    }  # fmt: skip
    return list(run.call("writing", finish))


def _chunks_per_task(chunks: int, executor: Executor) -> int:
    """Chunks of a task. Fewer end more evenly, but each task looks at a window of scans before it as well."""
    if isinstance(executor, Cluster):
        return CHUNKS_ON_CLUSTER
    return max(ceil(chunks / executor.workers), 1) if isinstance(executor, Processes) else max(chunks, 1)


def bound_and_mapped(
    drives: Sequence[DriveJob], run: MapJob, base: BaseCloud | None = None, force: bool = False
) -> tuple[BoundDrives, dict[str, Path]]:
    """Locate, bind and map new drives; the folder of the map of each that does not fail.

    One that fails may be wrong, and is not in the map: then those that it moved are bound without it, and mapped again.
    """
    located, read = locate_drives(drives, run)
    while True:
        tracks = {name: one.track() for name, one in located.items()}
        bound = bind(located, tracks, run, base)
        if base is not None:
            bound = with_unheld(tracks, bound, base, force)
        made = map_drives(located, read, bound, run)
        if bound.held.keys() <= made.keys():
            return bound, made
        located = {name: one for name, one in located.items() if name in made}


def write_one(out: Path, job: DriveJob, run: MapJob, write_labels: bool = False) -> None:
    """Refine and deliver the map of one drive, which is mapped, into `out`."""
    with new_folder(out) as folder:
        link_map(job.made, folder)
        deliver_one(_refined(folder, run, RunStats()), job, run, write_labels)


def write_drives(
    out: Path,
    drives: Mapping[str, Path],
    bound: BoundDrives,
    run: MapJob,
    labelled: Sequence[Source] = (),
    align_to: Path | None = None,
) -> dict[str, Any]:
    """Add, refine and deliver the maps of several `drives`, name -> folder, into `out`.

    With point labels of those that are `labelled`. Returns the content of run.json.
    """
    stats, classes = RunStats(), run.settings.classes
    assert run.frame is not None
    with new_folder(out) as folder:
        parts = link_drives(drives, folder)
        with stats.stage("mapping"):
            write_sum(parts, folder, run.frame, classes, out, executor=run.executor, work=run.work)
        # tiles that are taken from an earlier map do not say which points of kerbs are which
        made = _refined(folder, run, stats, None if labelled else out)
        return deliver_drives(made, bound, run, labelled, align_to)


def _refined(folder: Path, run: MapJob, stats: RunStats, earlier: Path | None = None) -> RefinedMap:
    refined = refine(folder, run.settings, stats, run.progress, earlier, executor=run.executor, work=run.work)
    return RefinedMap(folder, refined, stats)


@dataclass(frozen=True, eq=False)
class MappedLog:
    """A drive that is mapped: the folder of its map, its log and trajectory there, and what is known of the run."""

    folder: Path
    log: SensorLog
    trajectory: Trajectory
    stats: RunStats


def map_log(
    log: SensorLog, segmenter: Segmenter | None, run: MapJob, labels_from: str = "", force: bool = False
) -> MappedLog:
    """Map a log that is open, with a segmenter that is open, as a map of one; see `drive_tasks.finish`."""
    job = job_for(Source(log.name, labels_from or None, called=Path(log.name).name), run, force)
    with closing_drives():
        give(job, log, segmenter)
        bound_and_mapped([job], run)
        log = opened(*job.key).log
    about = read_run(job.made)
    stats = RunStats(
        Counter(about["counts"]), [Skip(**skip) for skip in about["skips"]["listed"]], about["warnings"]
    )
    return MappedLog(job.made, log, Trajectory(**job.needed("placed").of("track")), stats)


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
