"""From scans to voxels: every point at its own stamp, labelled by the image of its moment, fused (eq. 1 to 7).

Without a work folder and with one process, scans are fused in memory. Else they are fused in chunks of scans, which are
saved (`checkpoints`), so an interrupted run can be resumed. `build_maps` then loads the whole map; the memory of
`map_chunks` alone does not grow with the drive. Sums are integers, so the result has the same bytes in all cases.
"""

from __future__ import annotations

import hashlib
import pickle
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from factor_graphs.trajectory import Trajectory
from gnss_sem_map.config import Settings
from gnss_sem_map.errors import ConfigError, DataError
from gnss_sem_map.labels import sensor_model
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.mapping.checkpoints import ChunkStore, open_store
from gnss_sem_map.mapping.labelled_scans import Drive, label_each_scan
from gnss_sem_map.mapping.worker_processes import in_processes
from gnss_sem_map.run_stats import Progress, RunStats, silent
from gnss_sem_map.segmentation import Segmenter
from gnss_sem_map.sensor_log import Image, Scan, SensorLog, Skip, file_of
from gnss_sem_map.voxels.voxel_map import VoxelMap, VoxelTable

STATIC, REMOVED = "static", "removed"


@dataclass(frozen=True, eq=False)
class Maps:
    """The map of static points and the map of moving points; no point is in both."""

    static: VoxelMap
    removed: VoxelMap


def build_map(
    log: SensorLog,
    trajectory: Trajectory,
    segmenter: Segmenter | None,
    settings: Settings,
    stats: RunStats,
    progress: Progress = silent,
) -> VoxelMap:
    """All points of all scans in one map, in memory; see `build_maps`."""
    return build_maps(Drive(log, trajectory, segmenter, settings), stats, progress).static


def build_maps(
    drive: Drive,
    stats: RunStats,
    progress: Progress = silent,
    *,
    work: Path | None = None,
    resume: bool = False,
    workers: int = 1,
    labels_from: str = "",
) -> Maps:
    """Map all points of all scans (eq. 1 to 7): each at its own stamp, labelled by the nearest image in time.

    `work` is a folder for chunks of the map; with `resume`, the chunks of an interrupted run are used if drive,
    settings and `labels_from` (the source of the labels) are the same. The caller removes the folder. `workers`
    processes share the chunks. Raises DataError when no scan can be used, or `work` cannot be written or holds
    something else.
    """
    scans = drive.log.scans
    _warn(drive, stats)
    if work is None and workers == 1:
        static, removed = fuse_scans(drive, scans, stats, progress)
        maps = Maps(static.to_map(), removed.to_map())
    else:
        with _folder(work) as folder:
            store = map_chunks(
                drive, folder, stats, progress, resume=resume, workers=workers, labels_from=labels_from
            )
            maps = Maps(store.whole(STATIC), store.whole(REMOVED))
    _check(drive, stats, maps)
    return maps


def map_chunks(
    drive: Drive,
    work: Path,
    stats: RunStats,
    progress: Progress = silent,
    *,
    resume: bool = False,
    workers: int = 1,
    labels_from: str = "",
) -> ChunkStore:
    """Map a drive into a folder of chunks, whose tiles are read one by one: memory does not grow with the drive."""
    scans, mapping = drive.log.scans, drive.settings.mapping
    chunks = _chunks(drive)
    store = open_store(
        work, fingerprint(drive, labels_from), len(chunks), resume, mapping.voxel_size_m, drive.label_set
    )
    there = store.done()
    done = sum(len(chunks[number]) for number in there)
    pending = [number for number in range(len(chunks)) if number not in there]
    for number in _map_all(drive, store, pending, workers, _shifted(progress, done, len(scans))):
        done += len(chunks[number])
        progress("mapping", done, len(scans))
    for record in store.records():
        stats.counts.update(record["counts"])
        stats.skips.extend(Skip(**skip) for skip in record["skips"])
    return store


def fuse_scans(
    drive: Drive, scans: Sequence[Scan], stats: RunStats, progress: Progress = silent
) -> tuple[VoxelTable, VoxelTable]:
    """Fuse some scans of a drive: the static points, and the points of moving objects."""
    settings = drive.settings
    static, removed = _table(settings), _table(settings)
    for done, seen in enumerate(label_each_scan(drive, scans, stats)):
        if seen is not None:
            keys = seen.keys
            moved = np.zeros(len(keys), np.bool_)
            if drive.moving is not None:
                moved[drive.moving.get(seen.scan.number, [])] = True
            if moved.any():
                removed.add(keys[moved], seen.pixels[moved], seen.classes)
                static.add(keys[~moved], seen.pixels[~moved], seen.classes)
            else:
                static.add(keys, seen.pixels, seen.classes)
        progress("mapping", done + 1, len(scans))
    return static, removed


def _table(settings: Settings) -> VoxelTable:
    label_set = open_label_set(settings.classes)
    calibration = sensor_model.opened(settings.calibration, label_set)
    return VoxelTable(
        settings.mapping.voxel_size_m,
        label_set,
        settings.labelling.probability_floor,
        None if calibration is None else calibration.log_likelihoods,
        settings.labelling.abstain,
    )


def _warn(drive: Drive, stats: RunStats) -> None:
    if drive.segmenter is None:
        stats.warnings.append("no segmenter: the map shows geometry only")
    elif not _has_camera(drive):
        stats.warnings.append(f"{drive.log.name} has no images: the map shows geometry only")


def _check(drive: Drive, stats: RunStats, maps: Maps) -> None:
    if not stats.counts["scans"]:
        why = _first_reason(stats, "scan")
        raise DataError(f"{drive.log.name}: none of {len(drive.log.scans)} scans can be used{why}")
    is_labelled = maps.static.observed.any() or maps.removed.observed.any()
    if drive.segmenter is not None and _has_camera(drive) and not is_labelled:
        why = _first_reason(stats, "labels")
        stats.warnings.append(f"no point got a label, and the map shows geometry only{why}")


def _has_camera(drive: Drive) -> bool:
    return bool(drive.log.images) and drive.log.calibration.has_camera


def _first_reason(stats: RunStats, what: str) -> str:
    """The reason of the first skip of this kind, as the end of a sentence; empty without skips."""
    return next((f"; first reason: {s.where}: {s.reason}" for s in stats.skips if s.what == what), "")


@contextmanager
def _folder(work: Path | None) -> Iterator[Path]:
    if work is not None:
        yield work
        return
    with tempfile.TemporaryDirectory(prefix="gnss-sem-map-") as folder:
        yield Path(folder)


def _shifted(progress: Progress, done: int, total: int) -> Progress:
    return lambda stage, more, _: progress(stage, done + more, total)


def _chunks(drive: Drive) -> list[Sequence[Scan]]:
    scans, count = drive.log.scans, drive.settings.mapping.scans_per_chunk
    return [scans[i : i + count] for i in range(0, len(scans), count)]


def _map_all(
    drive: Drive, store: ChunkStore, numbers: Sequence[int], workers: int, progress: Progress
) -> Iterator[int]:
    """Map these chunks and save them; yields the number of each finished chunk."""
    if workers > 1 and len(numbers) > 1:
        _check_sendable(drive)
        yield from in_processes(_map_chunk, (drive, store), numbers, workers)
        return
    done = 0
    for number in numbers:
        _map_chunk(drive, store, number, _shifted(progress, done, 0))
        done += len(_chunks(drive)[number])
        yield number


def _map_chunk(drive: Drive, store: ChunkStore, number: int, progress: Progress = silent) -> None:
    stats = RunStats()
    static, removed = fuse_scans(drive, _chunks(drive)[number], stats, progress)
    record = {"counts": dict(stats.counts), "skips": [asdict(skip) for skip in stats.skips]}
    store.write(number, {STATIC: static.to_map(), REMOVED: removed.to_map()}, record)


def _check_sendable(drive: Drive) -> None:
    try:
        pickle.dumps(drive.segmenter)
    except Exception as error:  # noqa: BLE001 (an object may refuse in any way)
        raise ConfigError(
            f"this segmenter cannot work in several processes ({error}); write its probabilities with"
            " `gnss-sem-map segment` first and use labels:FOLDER, or leave out --workers"
        ) from None


def fingerprint(drive: Drive, labels_from: str) -> str:
    """Digest of everything that decides the map: a run may resume another one with the same fingerprint."""
    log, settings = drive.log, drive.settings
    names = () if drive.segmenter is None else drive.segmenter.class_names
    said = [
        log.name, labels_from, list(names), settings.classes,
        settings.mapping.model_dump_json(), settings.labelling.model_dump_json(),
        [(scan.name, scan.number, scan.stamp, _state(scan)) for scan in log.scans],
        [(image.number, image.stamp, _state(image)) for image in log.images], _states(labels_from),
        log.calibration.image_size, log.calibration.camera_time_offset_s,
    ]  # fmt: skip
    digest = hashlib.sha256(repr(said).encode())
    for array in _arrays(drive):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def probabilities_fingerprint(drive: Drive, labels_from: str) -> str:
    """Digest of the network, the images and the classes: a run may use the probabilities of one with the same."""
    log = drive.log
    names = () if drive.segmenter is None else drive.segmenter.class_names
    said = [
        log.name, labels_from, list(names), drive.settings.classes, log.calibration.image_size,
        [(image.number, _state(image)) for image in log.images], _states(labels_from),
    ]  # fmt: skip
    return hashlib.sha256(repr(said).encode()).hexdigest()


def _state(item: Scan | Image) -> tuple[int, int] | None:
    """Size and time of the file of a scan or an image."""
    path = file_of(item)
    return None if path is None else _size_and_time(path)


def _states(labels_from: str) -> list[tuple[str, tuple[int, int] | None]]:
    """Sizes and times of the files that a segmenter's description names: label files, or those of a network."""
    place = Path(labels_from.partition(":")[2].partition("?")[0])
    if not labels_from.partition(":")[2] or not place.exists():
        return []
    files = sorted(path for path in place.iterdir() if path.is_file()) if place.is_dir() else [place]
    return [(path.name, _size_and_time(path)) for path in files]


def _size_and_time(path: Path) -> tuple[int, int] | None:
    try:
        about = path.stat()
    except OSError:  # the reader reports it
        return None
    return about.st_size, about.st_mtime_ns


def _arrays(drive: Drive) -> Iterable[NDArray[Any]]:
    calibration, trajectory = drive.log.calibration, drive.trajectory
    learnt = sensor_model.opened(drive.settings.calibration, open_label_set(drive.settings.classes))
    if learnt is not None:
        yield learnt.log_likelihoods
    yield from (trajectory.stamps, trajectory.T_map_imu, calibration.T_imu_lidar)
    for array in (trajectory.velocities, calibration.T_camera_lidar, calibration.K):
        if array is not None:
            yield array
    for number, places in sorted((drive.moving or {}).items()):
        yield np.array([number])
        yield places
