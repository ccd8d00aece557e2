"""From scans to voxels: every point at its own stamp, labelled by the image of its moment, fused (eq. 1 to 7).

The scans are mapped in chunks (`chunks`), which are saved (`checkpoints`), so an interrupted run can be resumed, and
several processes can share the work. Memory does not grow with the drive. Sums are integers, so the result has the same
bytes in all cases.
"""

from __future__ import annotations

import secrets
import shutil
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

from gnss_sem_map.config import Settings
from gnss_sem_map.errors import DataError
from gnss_sem_map.files.work_folder import writing_to
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.mapping import fingerprints
from gnss_sem_map.mapping.checkpoints import ChunkStore
from gnss_sem_map.mapping.chunks import BLURRED, chunks_of, map_chunks
from gnss_sem_map.mapping.edge_windows import EdgeWindows
from gnss_sem_map.mapping.labelled_scans import Drive
from gnss_sem_map.mapping.waiting_points import WAITING
from gnss_sem_map.process.memory import release_memory
from gnss_sem_map.process.run_stats import Progress, RunStats, shifted, silent
from gnss_sem_map.sensor_log import Skip

GEOMETRY_ONLY = "the map shows geometry only"
"""In every warning of a map without labels."""


def map_scans(
    drive: Drive,
    work: Path,
    stats: RunStats,
    progress: Progress = silent,
    *,
    resume: bool = False,
    labels_from: str = "",
) -> ChunkStore:
    """Map all points of all scans (eq. 1 to 7): each at its own stamp, labelled by the nearest image in time.

    The chunks of the map are written into the folder `work`; with `resume`, those of an interrupted run are used if
    drive, settings and `labels_from` (the source of the labels) are the same. The caller removes the folder. Raises
    DataError when no scan can be used, or `work` cannot be written or holds something else.
    """
    fingerprint = fingerprints.of_map(drive, labels_from)
    chunks, total = chunks_of(drive), drive.log.scan_count
    store = store_of(work, fingerprint, len(chunks), drive.settings).begun(resume)
    pending = store.pending()
    done = total - sum(len(chunks[number]) for number in pending)
    for numbers in ranges(pending, len(chunks)):
        map_range(drive, store, numbers, shifted(progress, done, total))
        done += sum(len(chunks[number]) for number in numbers)
    summarise(drive, store, stats)
    return store


def store_of(work: Path, fingerprint: str, count: int, settings: Settings) -> ChunkStore:
    """So many chunks of a drive in a work folder."""
    label_set = open_label_set(settings.classes)
    return ChunkStore(work, fingerprint, count, settings.mapping.voxel_size_m, label_set)


def summarise(drive: Drive, store: ChunkStore, stats: RunStats) -> None:
    """Counts and skips of all chunks, and what there is to say of them; raises DataError when no scan can be used."""
    _warn(drive, stats)
    for record in store.records():
        stats.counts.update(record["counts"])
        stats.skips.extend(Skip(**skip) for skip in record["skips"])
    _check(drive, stats)


def ranges(pending: Sequence[int], most: int) -> list[range]:
    """Consecutive chunks, at most so many in a range."""
    found = []
    for _, group in groupby(enumerate(pending), lambda pair: pair[1] - pair[0]):
        numbers = [number for _, number in group]
        for start in range(0, len(numbers), most):
            found.append(range(numbers[start], numbers[min(start + most, len(numbers)) - 1] + 1))
    return found


def map_range(drive: Drive, store: ChunkStore, numbers: range, progress: Progress = silent) -> None:
    """Map some chunks in a row and save each when it is done; raises DataError when the disk is full."""
    # not named after the process: those of two containers may have one number
    waiting = store.folder / f".{numbers.start}.{secrets.randbelow(1 << 60)}{WAITING}"
    with writing_to(waiting):
        waiting.mkdir()
    try:
        edges = EdgeWindows(store.folder, store.fingerprint)
        for chunk in map_chunks(drive, numbers, waiting, edges, progress):
            store.write(chunk)
            del chunk
            release_memory(always=True)  # the next one needs what it has used
    finally:
        shutil.rmtree(waiting, ignore_errors=True)


def without_images(settings: Settings) -> str:
    """What a map shows without labels of images, and how to get labels from elsewhere."""
    if settings.geometric_classifier.enabled and settings.geometric_classifier.model is not None:
        return "all classes are those of the geometric classifier"
    return (
        f"{GEOMETRY_ONLY}; a classifier of drives with labels would name it (--set geometric_classifier.model=FILE of"
        " `gnss-sem-map fit-classifier`)"
    )


def _warn(drive: Drive, stats: RunStats) -> None:
    if said := drive.label_set.said_of_roles:
        stats.warnings.append(said)
    if drive.log.images and not drive.log.cameras:
        stats.warnings.append(
            f"{drive.log.name}: no camera is described, so its {len(drive.log.images)} images are not used:"
            f" {without_images(drive.settings)}"
        )
    elif drive.segmenter is None:
        stats.warnings.append(f"no segmenter: {without_images(drive.settings)}")
    elif not drive.log.cameras:
        stats.warnings.append(f"{drive.log.name} has no images: {without_images(drive.settings)}")
    for one in drive.by_lidar if drive.settings.dynamics.enabled else ():
        if not one.is_too_sparse:
            continue
        of = f" of {one.log.lidar}" if one.log.lidar else ""
        stats.warnings.append(
            f"{drive.log.name}: the points of its scans{of} are too far apart to tell what they see through: hardly any"
            " moving object is found, and hardly any voxel is cleared"
        )


def _check(drive: Drive, stats: RunStats) -> None:
    if not stats.counts["scans"]:
        why = _first_reason(stats, "scan")
        raise DataError(f"{drive.log.name}: none of {drive.log.scan_count} scans can be used{why}")
    if drive.segmenter is not None and drive.log.cameras and not stats.counts["points labelled"]:
        why = _first_reason(stats, "labels")
        stats.warnings.append(f"no point got a label, and {without_images(drive.settings)}{why}")

    if (blurred := stats.counts[BLURRED]) and not any(one.is_too_sparse for one in drive.by_lidar):
        settings = drive.settings.trajectory
        is_given = drive.log.given is not None and settings.given_poses == "fixed"
        cure = "given_poses=measured" if is_given else "lidar_odometry=true"
        sharper = is_given or not settings.lidar_odometry
        stats.warnings.append(
            f"{drive.log.name}: the poses of {blurred} of {stats.counts['scans']} scans blur what stands: what no image"
            " shows is found to move there only where it goes elsewhere, and free_space clears nothing"
            + f"; sharper poses: --set trajectory.{cure}"
            * sharper
        )


def _first_reason(stats: RunStats, what: str) -> str:
    """The reason of the first skip of this kind, as the end of a sentence; empty without skips."""
    return next((f"; first reason: {s.where}: {s.reason}" for s in stats.skips if s.what == what), "")
