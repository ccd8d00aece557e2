"""A drive on its way into a map: what its tasks need to know, in a work folder that all processes see.

FOLDER/job.json    the source, the settings, the origin of the map
       *.npz       what its tasks found (`files.memo`)
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, astuple, dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

from factor_graphs.geodesy import LocalFrame
from gnss_sem_map.config import Settings
from gnss_sem_map.errors import DataError
from gnss_sem_map.files import work_folder
from gnss_sem_map.files.atomic import write_whole
from gnss_sem_map.files.memo import Found, recall
from gnss_sem_map.files.untrusted import is_file
from gnss_sem_map.files.work_folder import DRIVES, JOB, SWEEPS, writing_to
from gnss_sem_map.runs.map_job import MapJob
from gnss_sem_map.runs.same_run import digest_of, is_made_from
from gnss_sem_map.runs.source import Source
from gnss_sem_map.scans.kept_sweeps import KeptSweeps
from gnss_sem_map.segmentation import Segmenter
from gnss_sem_map.sensor_log import SensorLog
from gnss_sem_map.voxels.reuse import digest

FINISHED = "finished"
"""What is known of the map of a drive beside its folder."""


@dataclass(frozen=True, eq=False)
class DriveJob:
    """What a drive is mapped from, and how. Its tasks are told its folder, and the digest of what is in it."""

    source: Source
    settings: Settings
    origin: LocalFrame | None
    """Of the map; None: that of the drive."""
    folder: Path
    """Its work folder, absolute."""
    force: bool = False
    """A red pre-flight does not stop it."""
    is_one: bool = False
    """Of a map of one drive: what later stages need of its sweeps is saved, 110 MB."""

    @property
    def name(self) -> str:
        return self.source.name

    @property
    def made(self) -> Path:
        """The folder of its map, once it is there."""
        return self.folder.with_name(self.name)

    @property
    def saved(self) -> Path:
        """The folder of sweeps that are saved when they are matched."""
        return self.folder / SWEEPS

    @cached_property
    def key(self) -> tuple[str, str]:
        """How tasks find it."""
        return str(self.folder), digest(self._about())

    def begin(self) -> DriveJob:
        """Write the job for its tasks; raises DataError."""
        work_folder.make(self.folder)
        with writing_to(self.folder):
            write_whole(self.folder / JOB, json.dumps(self._about()).encode())
        return self

    def found(self, name: str, made_from: str | None = None) -> Found | None:
        """What a task has found."""
        return recall(self.folder / f"{name}.npz", made_from)

    def needed(self, name: str, made_from: str | None = None) -> Found:
        """What an earlier task has found; raises DataError where it is not there."""
        found = self.found(name, made_from)
        if found is None:
            raise DataError(
                f"{self.folder}/{name}.npz: is not there, or damaged; do all workers see this folder? run it again"
            )
        return found

    def is_made(self, read: str, correction: str) -> bool:
        """Whether the map is there, of what was `read` (a digest) and with this digest of the correction."""
        what = self.source, self.settings, self.origin, read, correction
        return self.found(FINISHED, self.key[1]) is not None and is_made_from(self.made, *what)

    def _about(self) -> dict[str, object]:
        return {
            "source": asdict(self.source),
            "settings": self.settings.model_dump(mode="json"),
            "origin": None if self.origin is None else astuple(self.origin),
            "force": self.force,
            "is_one": self.is_one,
        }


@dataclass(frozen=True, eq=False)
class OpenDrive:
    """A drive as the tasks of a process see it."""

    job: DriveJob
    log: SensorLog
    """In our conventions."""
    read: str
    """Digest of all that is read of it; empty without the IMU."""
    network_of: Callable[[Settings, SensorLog], Segmenter | None]
    kept: KeptSweeps | None = None
    """Sweeps that the pre-flight has read, where the next task is of the same drive."""
    known: dict[str, Any] = field(default_factory=dict)
    """What tasks of this process have read of its folder, by digest."""

    @cached_property
    def network(self) -> Segmenter | None:
        """The segmenter for its images; raises DataError and ConfigError."""
        return self.network_of(self.job.settings, self.log)

    @property
    def keeping(self) -> SensorLog:
        """The log, of which sweeps are kept when they are read."""
        return self.log if self.kept is None else self.kept.keeping(self.log)

    @property
    def taking(self) -> SensorLog:
        """The log, of which sweeps that are kept are not read again."""
        return self.log if self.kept is None else self.kept.taking(self.log)

    def forget(self) -> None:
        """Let go of the sweeps that are kept: 35 MB."""
        if self.kept is not None:
            self.kept.forget()


_GIVEN: dict[tuple[str, str], OpenDrive] = {}
"""Drives that are open already, in this process."""


def give(job: DriveJob, log: SensorLog, segmenter: Segmenter | None = None) -> None:
    """Let the tasks of this process take a log, and a segmenter, that are open; `closing_drives` lets go of them."""
    source, settings = job.source, job.settings
    read, log = digest_of(log, source, settings), log.in_our_conventions(settings.sensors)
    network_of = source.open_network if segmenter is None else lambda settings, log: segmenter
    _GIVEN[job.key] = OpenDrive(job, log, read, network_of, KeptSweeps())


@contextmanager
def closing_drives() -> Iterator[None]:
    """Afterwards no drive is held open in this process."""
    try:
        yield
    finally:
        _GIVEN.clear()
        _opened.cache_clear()


def job_of(folder: str, key: str) -> DriveJob:
    """The job in a folder; raises DataError where it is another one."""
    if (given := _GIVEN.get((folder, key))) is not None:
        return given.job
    path = Path(folder) / JOB
    about = json.loads(path.read_text("utf-8")) if is_file(path) else None
    if about is None or digest(about) != key:
        raise DataError(f"{path}: is gone; this task is of a run that has ended")
    origin = None if about["origin"] is None else LocalFrame(*about["origin"])
    settings = Settings.model_validate(about["settings"])
    job = DriveJob(Source(**about["source"]), settings, origin, Path(folder), about["force"], about["is_one"])
    job.__dict__["key"] = folder, key  # what it was found by: paths in settings may be written in another way
    return job


def opened(folder: str, key: str, with_imu: bool = False) -> OpenDrive:
    """The drive of a job; the IMU is for the tasks before its trajectory is known. Raises DataError."""
    return _GIVEN.get((folder, key)) or _opened(folder, key, with_imu)


@lru_cache(1)
def _opened(folder: str, key: str, with_imu: bool) -> OpenDrive:
    job = job_of(folder, key)
    log = job.source.open_log(with_imu)
    read = digest_of(log, job.source, job.settings) if with_imu else ""
    return OpenDrive(job, log.in_our_conventions(job.settings.sensors), read, job.source.open_network)


def other_drive(source: Source) -> DataError:
    """The worker's log has another fingerprint."""
    return DataError(
        f"{source.drive}: a worker finds another drive or other labels than the main process: files were changed, are"
        " not the same on its machine, or a script changed the log; take one worker, or the files as they are"
    )


def job_for(source: Source, run: MapJob, force: bool = False) -> DriveJob:
    """The job of a drive in the work folder of a map."""
    folder = (run.work / DRIVES / f".{source.name}.work").resolve()
    return DriveJob(source, run.settings, run.frame, folder, force, run.is_one)
