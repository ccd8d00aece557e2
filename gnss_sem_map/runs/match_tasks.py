"""LiDAR odometry of a run: sections are saved in the work folder, and may be matched by several workers.

WORK/matches/job.json, trajectory.npz    the drive, for the workers (`runs.drive_job`)
             N.npz, N.json               relative poses of section N; its counts and skips, and the checksum of N.npz
     sweeps/                             sweeps that sections share or later stages need (`scans.thinned_sweeps`)
            about.json                   what they are from
"""

from __future__ import annotations

import hashlib
import io
import json
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import lru_cache, reduce
from operator import add
from pathlib import Path

import numpy as np

from factor_graphs.relative_poses import RelativePoses
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.config import Settings
from gnss_sem_map.errors import DataError
from gnss_sem_map.files import work_folder
from gnss_sem_map.files.archives import npz_of
from gnss_sem_map.files.atomic import write_whole
from gnss_sem_map.files.untrusted import read_bytes
from gnss_sem_map.files.work_folder import MATCHES, SWEEPS
from gnss_sem_map.mapping import fingerprints
from gnss_sem_map.process.execution import Executor, Task, path_of, run_tasks
from gnss_sem_map.process.run_stats import Progress, silent
from gnss_sem_map.runs import pipeline
from gnss_sem_map.runs.drive_job import other_drive, read_job, write_job
from gnss_sem_map.runs.source import Source
from gnss_sem_map.scans.lidar_odometry import ScanMatches, match_section, sections_of
from gnss_sem_map.scans.local_maps import sweeps_along
from gnss_sem_map.sensor_log import SensorLog, Skip
from gnss_sem_map.voxels.reuse import read_record, write_record

ABOUT = "about.json"


@dataclass(frozen=True)
class SavedMatches:
    """Matches the sections of a drive, here or on the workers of an executor; see `mapping.trajectory.locate`.

    With `resume`, the sections of an interrupted run are taken.
    """

    source: Source
    work: Path
    executor: Executor | None = None
    resume: bool = False
    mapped_next: bool = True
    """What the drive's mapping needs of sweeps is saved: 110 MB, too much for thousands of drives that are located."""

    def __call__(
        self, log: SensorLog, trajectory: Trajectory, settings: Settings, progress: Progress
    ) -> ScanMatches:
        """Relative poses from all sweeps, as `match_scans` finds them; raises DataError."""
        sections = sections_of(len(log.scans), settings.trajectory.scan_matching)
        fingerprint = fingerprints.of_matches(log, trajectory, settings)
        work_folder.make(self.work)
        if not self.resume or not _are_sweeps_of(self.work / SWEEPS, fingerprint):
            work_folder.remove_matches(self.work)
        folder = (self.work / MATCHES).resolve()
        with work_folder.writing_to(self.work):
            folder.mkdir(exist_ok=True)
            (self.work / SWEEPS).mkdir(exist_ok=True)
            write_record({"fingerprint": fingerprint}, self.work / SWEEPS / ABOUT)
        pending = [n for n in range(len(sections)) if _read(folder, n, fingerprint) is None]
        done = len(log.scans) - sum(len(sections[n]) for n in pending)  # of an interrupted run
        for n in self._matched(log, trajectory, settings, pending, folder, fingerprint, progress):
            done += len(sections[n])
            progress("scan matching", done, len(log.scans))
        return reduce(add, self._all(folder, len(sections), fingerprint))

    def _matched(
        self,
        log: SensorLog,
        trajectory: Trajectory,
        settings: Settings,
        pending: list[int],
        folder: Path,
        fingerprint: str,
        progress: Progress,
    ) -> Iterator[int]:
        """Match sections, and yield the number of each when it is saved."""
        if self.executor is None or len(pending) < 2:
            listening = _listening(log, trajectory, settings, self.work, self.mapped_next)
            for n in pending:
                _save(_match(listening, trajectory, settings, n, self.work, progress), folder, n, fingerprint)
                yield n
            return
        write_job(folder, self.source, settings, trajectory, fingerprint)
        function = path_of(match_one)
        tasks = [
            Task(f"{log.name}, section {n} of its scans", function, (str(folder), fingerprint, n))
            for n in pending
        ]
        for task, _ in run_tasks(tasks, self.executor):
            yield task.arguments[-1]

    def _all(self, folder: Path, count: int, fingerprint: str) -> Iterator[ScanMatches]:
        for n in range(count):
            found = _read(folder, n, fingerprint)
            if found is None:
                raise DataError(
                    f"{folder}: section {n} of the scans that was matched is not there, or damaged; do all workers see"
                    " this folder?"
                )
            yield found


def match_one(folder: str, fingerprint: str, number: int) -> None:
    """Match one section, and save it: a task. Raises DataError if the drive is another one here."""
    if _read(Path(folder), number, fingerprint) is None:
        log, trajectory, settings = _opened(folder, fingerprint)
        found = _match(log, trajectory, settings, number, Path(folder).parent)
        _save(found, Path(folder), number, fingerprint)


def _match(
    log: SensorLog,
    trajectory: Trajectory,
    settings: Settings,
    number: int,
    work: Path,
    progress: Progress = silent,
) -> ScanMatches:
    matching = settings.trajectory.scan_matching
    section = sections_of(len(log.scans), matching)[number]
    return match_section(log, trajectory, matching, section, progress, work / SWEEPS)


def _listening(
    log: SensorLog, trajectory: Trajectory, settings: Settings, work: Path, mapped_next: bool = True
) -> SensorLog:
    """The log, of which what later stages need of its sweeps is saved when they are read."""
    saved = work / SWEEPS
    if mapped_next:
        log = pipeline.saving_sweeps(log, saved)
    if settings.trajectory.revisits.enabled:
        log = sweeps_along(log, trajectory, saved).listening()
    return log


@lru_cache(1)
def _opened(folder: str, fingerprint: str) -> tuple[SensorLog, Trajectory, Settings]:
    """The drive of a job, of which sweeps are saved: opened once for all tasks of a worker."""
    _, source, settings, log, trajectory = read_job(Path(folder))
    if fingerprints.of_matches(log, trajectory, settings) != fingerprint:
        raise other_drive(source)
    return _listening(log, trajectory, settings, Path(folder).parent), trajectory, settings


def _are_sweeps_of(folder: Path, fingerprint: str) -> bool:
    return read_record(folder / ABOUT) == {"fingerprint": fingerprint}


def _save(found: ScanMatches, folder: Path, number: int, fingerprint: str) -> None:
    content = npz_of(found.relative_poses)
    about = {
        "fingerprint": fingerprint,
        "sha256": hashlib.sha256(content).hexdigest(),
        "counts": dict(found.counts),
        "skips": [asdict(skip) for skip in found.skips],
    }
    with work_folder.writing_to(folder):
        write_whole(folder / f"{number}.npz", content)
        write_whole(folder / f"{number}.json", json.dumps(about).encode())


def _read(folder: Path, number: int, fingerprint: str) -> ScanMatches | None:
    """A section that was saved; None where there is none of this run, or it is damaged."""
    about = read_record(folder / f"{number}.json")
    if about is None or about.get("fingerprint") != fingerprint:
        return None
    try:
        content = read_bytes(folder / f"{number}.npz")
        if about["sha256"] != hashlib.sha256(content).hexdigest():
            return None
        skips = tuple(Skip(**skip) for skip in about["skips"])
        counts = Counter(about["counts"])
    except (DataError, KeyError, TypeError):
        return None
    with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
        return ScanMatches(RelativePoses(**arrays), skips, counts)
