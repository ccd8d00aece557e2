"""One pass over the scans of a drive, chunk by chunk: all points are fused, and those that moved are subtracted.

A chunk is two windows of scans of one LiDAR (`dynamics.window_scans`); the chunks of the first LiDAR come first. What
moved in it is decided by its own scans, the range images of a window of scans before it, and the segments of a window
of scans after it. So no chunk depends on what was decided elsewhere: the map is the same for any division of the chunks
among processes, and after any interruption.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.config import Settings
from gnss_sem_map.dynamics.motion_state import TrackedObject
from gnss_sem_map.dynamics.moving_objects import decide, moved_points
from gnss_sem_map.dynamics.observation import NearPoints, Observation
from gnss_sem_map.dynamics.visibility import THREADS, KeyframeScans, KeyframeSelector
from gnss_sem_map.files.work_folder import writing_to
from gnss_sem_map.labels import sensor_model
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.mapping.edge_windows import EdgeWindows
from gnss_sem_map.mapping.labelled_scans import Drive, LabelledScan, label_each_scan
from gnss_sem_map.mapping.moving_points import observe_scan, range_images
from gnss_sem_map.mapping.waiting_images import WaitingImages
from gnss_sem_map.mapping.waiting_points import WaitingPoints
from gnss_sem_map.process.memory import release_memory
from gnss_sem_map.process.prefetch import prefetch
from gnss_sem_map.process.run_stats import Progress, RunStats, shifted, silent
from gnss_sem_map.sensor_log import Scan
from gnss_sem_map.voxels.attribute_table import WAITS
from gnss_sem_map.voxels.attributes import Attributes
from gnss_sem_map.voxels.voxel_map import VoxelMap, VoxelTable

BLURRED = "scans with blurred poses"
"""Count of those in which free space is no evidence."""
WINDOWS = 2
"""Windows of scans in a chunk: with more, fewer scans are processed twice at its ends, and more memory is needed. With
one, tracks are cut so often that 97.0 % of the moving points of the demo are removed, not 98.6 %."""


@dataclass(frozen=True, eq=False)
class MappedChunk:
    """What one chunk of scans says."""

    number: int
    lidar: str
    """Name of its LiDAR; empty where the drive has but one."""
    static: VoxelMap
    removed: VoxelMap
    """The points that moved; none of them is in `static`."""
    attributes: Attributes
    """Of the voxels of `static`."""
    attributes_removed: Attributes
    """Of the voxels of `removed`."""
    moving: Mapping[int, NDArray[np.int64]]
    """Frame number -> indices of the points that moved among the usable points of the scan."""
    objects: tuple[TrackedObject, ...]
    """Those that are first seen in this chunk."""
    keyframes: KeyframeScans | None
    """Scans for free-space evidence; None where the poses are not sharp enough for it."""
    stats: RunStats
    """Its counts and skips."""


def chunks_of(drive: Drive) -> list[Sequence[Scan]]:
    """The scans of every chunk; the last of a LiDAR has up to a window more, so that the others have one after them."""
    return [chunk for one in drive.by_lidar for chunk in _chunks_of(one)]


def _chunks_of(drive: Drive) -> list[Sequence[Scan]]:
    scans, window = drive.log.scans, drive.settings.dynamics.window_scans
    count = 1 + max(0, len(scans) - window) // (WINDOWS * window)
    edges = [*range(0, count * WINDOWS * window, WINDOWS * window), len(scans)]
    return [scans[start:end] for start, end in pairwise(edges)]


def map_chunks(
    drive: Drive, numbers: range, folder: Path, edges: EdgeWindows, progress: Progress = silent
) -> Iterator[MappedChunk]:
    """Map consecutive chunks; each scan of them is read once. `folder` is for points that wait for a decision.

    What their first window tells of motion is saved in `edges`, for the process that maps the chunk before. Raises
    DataError when the stamps of the scans do not increase, or a folder cannot be written.
    """
    chunks = chunks_of(drive)
    total, first, done = sum(len(chunks[number]) for number in numbers), 0, 0
    for one in drive.by_lidar:
        count = len(_chunks_of(one))
        here = range(max(numbers.start - first, 0), min(numbers.stop - first, count))
        if len(here):
            yield from _map_chunks(one, here, first, folder, edges, shifted(progress, done, total))
            done += sum(len(chunks[first + number]) for number in here)
        first += count


def _map_chunks(
    drive: Drive, numbers: range, first: int, folder: Path, edges: EdgeWindows, progress: Progress
) -> Iterator[MappedChunk]:
    """Those of one LiDAR, whose first chunk has the number `first` in the drive."""
    chunks, window = _chunks_of(drive), drive.settings.dynamics.window_scans
    start = sum(map(len, chunks[: numbers.start]))
    total = sum(len(chunks[number]) for number in numbers)
    is_sought = drive.settings.dynamics.enabled
    images = range_images(drive, drive.log.scans[max(start - window, 0) : start]) if is_sought else []
    with writing_to(folder):
        before = WaitingImages.write(images, folder)
    del images
    undecided: _Chunk | None = None
    done = 0
    for number in numbers:
        chunk = _Chunk(drive, number, first, folder)
        for place, seen in enumerate(_observed(drive, chunks[number], chunk.stats, chunk.put_aside), 1):
            if seen is not None:
                chunk.add(*seen)
            if place == window and undecided is not None:
                chunk.put_table_aside()
                yield undecided.decided(before, chunk.observations)
                chunk.take_table_back()
                before, undecided = undecided.last_images, None
            elif place == window and number > 0 and is_sought:
                edges.save(chunk.observations, first + number)
            done += 1
            progress("mapping", done, total)
            release_memory()  # what lasts lies among what scans have used, and ten scans leave 70 MB of holes
        chunk.put_table_aside()
        undecided = chunk
    if undecided is not None:
        is_followed = numbers.stop < len(chunks) and is_sought
        after = edges.read(first + numbers.stop, drive.image_rows) if is_followed else []
        if after is None:
            after = _observations(drive, chunks[numbers.stop][:window])
        yield undecided.decided(before, after)


Seen = tuple[LabelledScan, Observation | None]
PutAside = Callable[[LabelledScan, NearPoints], None]


def _observed(
    drive: Drive, scans: Sequence[Scan], stats: RunStats, put_aside: PutAside | None = None
) -> Iterator[Seen | None]:
    """Every scan, with what it tells of motion if that is sought; None for one that cannot be used.

    Threads call `put_aside` with the points that may have moved.
    """
    is_sought = drive.settings.dynamics.enabled
    labelled = label_each_scan(drive, scans, stats)
    if not is_sought:
        return (None if seen is None else (seen, None) for seen in labelled)

    def observe(seen: LabelledScan | None) -> Observation | None:
        if seen is None:
            return None
        observation, near = observe_scan(seen)
        if put_aside is not None:
            put_aside(seen, near)
        return observation

    observing = prefetch(observe, labelled, THREADS)
    return (None if seen is None else (seen, observation) for seen, observation in observing)


def _observations(drive: Drive, scans: Sequence[Scan]) -> list[Observation]:
    """What scans of another chunk tell of motion; they are counted there."""
    seen = _observed(drive, scans, RunStats())
    return [one[1] for one in seen if one is not None and one[1] is not None]


class _Chunk:
    """A chunk under way: its points in a table, and those that may have moved on disk."""

    def __init__(self, drive: Drive, number: int, first: int, folder: Path) -> None:
        self._drive, self._number, self._first, self._folder = drive, number, first, folder
        self._all, self._keyframes = new_table(drive.settings), KeyframeSelector()
        self._table = folder / f"{number}.table"
        self.observations: list[Observation] = []
        self.last_images: WaitingImages | None = None
        """Of its last window of scans, once it is decided."""
        self.stats = RunStats()

    def put_aside(self, seen: LabelledScan, near: NearPoints) -> None:
        """Write the points that may have moved; raises DataError."""
        with writing_to(self._folder):
            WaitingPoints.of(seen, near).write(self._waiting(seen.scan.number))
        seen.levels[near.indices] = WAITS  # they are added when it is known whether they moved

    def add(self, seen: LabelledScan, observation: Observation | None) -> None:
        self._all.add(seen.keys, seen.pixels, seen.classes, seen.heights, (seen.levels, seen.moments_us))
        if observation is not None:
            self._keyframes.add(observation.stamp, observation.seen)
            self.observations.append(observation)

    def put_table_aside(self) -> None:
        """Its 30 to 80 MB are free until it is taken back; raises DataError."""
        with writing_to(self._folder):
            self._all.put_aside(self._table)

    def take_table_back(self) -> None:
        """The table may be used again; raises DataError."""
        with writing_to(self._folder):
            self._all.take_back(self._table)

    def decided(self, before: WaitingImages | None, after: Sequence[Observation]) -> MappedChunk:
        """The chunk, whose table was put aside, once the scans before and after it are known."""
        # of the scans, freed by other threads: 250 MB after three hundred; to decide takes 100 MB at once
        release_memory(always=True)
        settings, numbers = self._drive.settings, [one.number for one in self.observations]
        decision = decide([*self.observations, *after], len(numbers), before, settings.dynamics)
        last = self._last_window()
        images = [one.seen for one in self.observations if one.number in last]
        with writing_to(self._folder):
            self.last_images = WaitingImages.write(images, self._folder)
        del images
        self.observations.clear()
        release_memory(always=True)  # 110 MB
        self.take_table_back()

        def taken(place: int) -> tuple[WaitingPoints, NDArray[np.bool_]]:
            points = WaitingPoints.take(self._waiting(numbers[place]))
            moved, stands = decision.moved[place], decision.stands[place]
            return points, moved_points(points.near, moved, stands, settings.dynamics.grow_m)

        removed, moving = new_table(settings), {}
        for place, (points, moved) in prefetch(taken, range(len(numbers)), THREADS):
            stays = np.flatnonzero(~moved)
            self._all.see(points.keys.take(stays), (points.levels.take(stays), points.moments_us.take(stays)))
            removed.add(
                points.keys[moved], points.pixels[moved], points.classes, points.heights[moved],
                (points.levels[moved], points.moments_us[moved]),
            )  # fmt: skip
            moving[numbers[place]] = points.near.indices[moved].astype(np.int64)
            release_memory()  # the points of all scans together leave 200 MB of holes
        release_memory(always=True)  # table and columns side by side take 150 MB
        gone = removed.to_map()
        self.stats.counts["points of moving objects"] += sum(map(len, moving.values()))
        keyframes = self._keyframes.keyframes() if decision.is_sharp else None
        if numbers and not decision.is_sharp:
            self.stats.counts[BLURRED] += len(numbers)
        seen, added = Attributes(*self._all.attributes()), self._all.to_map()
        del self._all  # 60 MB are free while the chunk is saved
        static = added - gone
        del added
        number, lidar = self._first + self._number, self._drive.log.lidar
        objects = tuple(replace(one, lidar=lidar, chunk=number) for one in decision.objects)
        return MappedChunk(
            number, lidar, static, gone, seen, Attributes(*removed.attributes()), moving, objects, keyframes,
            self.stats,
        )  # fmt: skip

    def _last_window(self) -> frozenset[int]:
        window = self._drive.settings.dynamics.window_scans
        return frozenset(scan.number for scan in _chunks_of(self._drive)[self._number][-window:])

    def _waiting(self, number: int) -> Path:
        return self._folder / f"{number}.npy"


def new_table(settings: Settings) -> VoxelTable:
    """An empty table for the points of a drive."""
    label_set = open_label_set(settings.classes)
    calibration = sensor_model.opened(settings.calibration, label_set)
    return VoxelTable(
        settings.mapping.voxel_size_m,
        label_set,
        settings.labelling.probability_floor,
        None if calibration is None else calibration.log_likelihoods,
        settings.labelling.abstain,
        with_attributes=True,
    )
