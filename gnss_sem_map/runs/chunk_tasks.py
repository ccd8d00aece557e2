"""Ranges of chunks of one drive as tasks: a worker opens the drive again, and maps its range into the work folder.

WORK/job.json          what the worker opens, the settings, and the fingerprint that it must find
     trajectory.npz    the trajectory itself: nothing is rounded, so the map has the same bytes
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from factor_graphs.trajectory import Trajectory
from gnss_sem_map.config import Settings
from gnss_sem_map.errors import DataError
from gnss_sem_map.files.ownership import write_whole
from gnss_sem_map.files.work_folder import JOB, TRAJECTORY
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.mapping import fusion
from gnss_sem_map.mapping.checkpoints import ChunkStore
from gnss_sem_map.mapping.dask_cluster import Cluster
from gnss_sem_map.mapping.execution import Task, run_tasks
from gnss_sem_map.mapping.labelled_scans import Drive
from gnss_sem_map.mapping.worker_processes import Processes
from gnss_sem_map.runs.source import Source
from gnss_sem_map.segmentation.cached_segmenter import CachedSegmenter

RANGES_PER_WORKER = 2
"""A worker reads the scans between its chunks once; shorter ranges end more evenly."""
CHUNKS_ON_CLUSTER = 4
"""Chunks of a range on a cluster, whose workers come and go."""


@dataclass(frozen=True)
class ChunkTasks:
    """Maps the chunks of a drive on the workers of an executor; see `fusion.map_scans`."""

    source: Source
    executor: Processes | Cluster

    def __call__(self, drive: Drive, store: ChunkStore, pending: Sequence[int]) -> Iterator[range]:
        """Map these chunks into the store; yields each range when it is done."""
        work = store.folder.resolve()
        _write_job(work, self.source, drive, store)
        tasks = [
            Task(
                f"{drive.log.name}, chunks {numbers.start} to {numbers.stop - 1}",
                "gnss_sem_map.runs.chunk_tasks:map_range",
                (str(work), numbers.start, numbers.stop),
            )
            for numbers in fusion.ranges(pending, self._length(len(pending)))
        ]
        for task, _ in run_tasks(tasks, self.executor):
            yield range(*task.arguments[1:])

    def _length(self, chunks: int) -> int:
        """Chunks of a range."""
        if isinstance(self.executor, Cluster):
            return CHUNKS_ON_CLUSTER
        return -(-chunks // (RANGES_PER_WORKER * self.executor.workers))


def map_range(work: str, start: int, stop: int) -> None:
    """Map the chunks of a range that are not mapped yet: a task. Raises DataError if the drive is another one here."""
    drive, store = _read_job(Path(work))
    left = sorted(set(range(start, stop)) - store.done())
    if left:
        fusion.map_range(drive, store, range(left[0], stop))


def _write_job(work: Path, source: Source, drive: Drive, store: ChunkStore) -> None:
    cache = drive.segmenter.folder.resolve() if isinstance(drive.segmenter, CachedSegmenter) else None
    about = {
        "source": asdict(source),
        "settings": drive.settings.model_dump(mode="json"),
        "from_lidar_odometry": drive.from_lidar_odometry,
        "probabilities": None if cache is None else str(cache),
        "fingerprint": store.fingerprint,
        "chunks": store.count,
    }
    arrays = {field.name: getattr(drive.trajectory, field.name) for field in fields(Trajectory)}
    file = io.BytesIO()
    np.savez(file, **{name: array for name, array in arrays.items() if array is not None})
    try:
        write_whole(work / TRAJECTORY, file.getvalue())
        write_whole(work / JOB, json.dumps(about).encode())
    except OSError as error:
        raise DataError(
            f"{work}: cannot be written ({error.strerror}); free the disk, then --resume"
        ) from None


def _read_job(work: Path) -> tuple[Drive, ChunkStore]:
    about: dict[str, Any] = json.loads((work / JOB).read_text("utf-8"))
    settings, source = Settings.model_validate(about["settings"]), Source(**about["source"])
    label_set = open_label_set(settings.classes)
    log = source.open_log().in_our_conventions(settings.sensors)
    network, size = source.open_network(settings, log), log.calibration.image_size
    if about["probabilities"] and network is not None and size is not None:
        network = CachedSegmenter(network, label_set, size, Path(about["probabilities"]))
    with np.load(work / TRAJECTORY) as arrays:
        trajectory = Trajectory(**arrays)
    drive = Drive(log, trajectory, network, settings, from_lidar_odometry=about["from_lidar_odometry"])
    if fusion.fingerprint(drive, source.labels_from) != about["fingerprint"]:
        raise DataError(
            f"{source.drive}: a worker finds another drive or other labels than the main process: files were changed,"
            " are not the same on its machine, or a script changed the log; take one worker, or the files as they are"
        )
    voxel_size_m = settings.mapping.voxel_size_m
    return drive, ChunkStore(work, about["fingerprint"], about["chunks"], voxel_size_m, label_set)
