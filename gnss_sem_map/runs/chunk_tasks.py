"""Ranges of chunks of one drive as tasks: a worker opens the drive again, and maps its range into the work folder."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.mapping import fingerprints, fusion
from gnss_sem_map.mapping.checkpoints import ChunkStore
from gnss_sem_map.mapping.labelled_scans import Drive
from gnss_sem_map.process.dask_cluster import Cluster
from gnss_sem_map.process.execution import Task, path_of, run_tasks
from gnss_sem_map.process.worker_processes import Processes
from gnss_sem_map.runs.drive_job import other_drive, read_job, write_job
from gnss_sem_map.runs.source import Source
from gnss_sem_map.segmentation.cached_segmenter import CachedSegmenter

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
                path_of(map_range),
                (str(work), store.fingerprint, numbers.start, numbers.stop),
            )
            for numbers in fusion.ranges(pending, self._length(len(pending)))
        ]
        for task, _ in run_tasks(tasks, self.executor):
            yield range(*task.arguments[2:])

    def _length(self, chunks: int) -> int:
        """Chunks of a range. Shorter ones end more evenly, but each looks at a window of scans before it as well."""
        if isinstance(self.executor, Cluster):
            return CHUNKS_ON_CLUSTER
        return math.ceil(chunks / self.executor.workers)


def map_range(work: str, fingerprint: str, start: int, stop: int) -> None:
    """Map the chunks of a range that are not mapped yet: a task. Raises DataError if the drive is another one here."""
    drive, store = _opened(work, fingerprint)
    # a chunk may be of an earlier run, of which a cluster still mapped something when this one began
    left = [number for number in range(start, stop) if not store.is_whole(number)]
    if left:
        fusion.map_range(drive, store, range(left[0], stop))


def _write_job(work: Path, source: Source, drive: Drive, store: ChunkStore) -> None:
    cache = drive.segmenter.folder.resolve() if isinstance(drive.segmenter, CachedSegmenter) else None
    write_job(
        work, source, drive.settings, drive.trajectory, store.fingerprint,
        probabilities=None if cache is None else str(cache),
        chunks=store.count,
        saved=None if drive.saved is None else str(drive.saved.resolve()),
    )  # fmt: skip


@lru_cache(1)
def _opened(work: str, fingerprint: str) -> tuple[Drive, ChunkStore]:
    """The drive of a job: opened once for all tasks of a worker."""
    about, source, settings, log, trajectory = read_job(Path(work))
    label_set = open_label_set(settings.classes)
    network = source.open_network(settings, log)
    if about["probabilities"] and network is not None:
        network = CachedSegmenter(
            network, label_set, log.calibration.image_sizes, Path(about["probabilities"])
        )
    drive = Drive(log, trajectory, network, settings, Path(about["saved"]) if about["saved"] else None)
    if not fingerprints.of_map(drive, source.labels_from) == about["fingerprint"] == fingerprint:
        raise other_drive(source)
    store = ChunkStore(Path(work), fingerprint, about["chunks"], settings.mapping.voxel_size_m, label_set)
    return drive, store
