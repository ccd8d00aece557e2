"""Places that a drive passes again, registered by several workers: some pairs in a row are a task.

WORK/revisits/job.json, trajectory.npz    the drive, for the workers (`runs.drive_job`)
              N.json                      what task N found, and what from
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from factor_graphs.trajectory import Trajectory
from gnss_sem_map.config import Settings
from gnss_sem_map.files import work_folder
from gnss_sem_map.files.work_folder import REVISITS, SWEEPS
from gnss_sem_map.mapping import fingerprints
from gnss_sem_map.process.execution import Executor, Task, path_of, run_tasks
from gnss_sem_map.runs.drive_job import other_drive, read_job, write_job
from gnss_sem_map.runs.source import Source
from gnss_sem_map.scans.local_maps import LocalMaps, sweeps_of
from gnss_sem_map.scans.revisits import Found, Pair, Pass, Registrar, RevisitSettings, register_pair
from gnss_sem_map.sensor_log import SensorLog
from gnss_sem_map.voxels.reuse import digest, read_record, write_record

PAIRS_PER_TASK = 24
"""Two seconds of work; pairs in a row have local maps in common."""


@dataclass(frozen=True)
class RevisitTasks:
    """Registers places on the workers of an executor; see `mapping.trajectory.locate`."""

    source: Source
    work: Path
    executor: Executor

    def __call__(self, log: SensorLog, trajectory: Trajectory, settings: Settings) -> Registrar:
        """Who registers the places of this drive. Raises DataError when the disk is full."""
        return lambda passes, pairs: self._found(log, trajectory, settings, passes[0], pairs)

    def _found(
        self,
        log: SensorLog,
        trajectory: Trajectory,
        settings: Settings,
        places: Pass,
        pairs: Sequence[Pair],
    ) -> Iterator[Found | None]:
        if len(pairs) <= PAIRS_PER_TASK:  # a worker would take as long to open the drive
            yield from (register_pair([places], pair, settings.trajectory.revisits) for pair in pairs)
            return
        stamps, sweeps = places.stamps.tolist(), sorted(places.maps.sweeps.numbers)
        fingerprint = _fingerprint(log, trajectory, settings, stamps, sweeps)
        work_folder.make(self.work)
        folder = (self.work / REVISITS).resolve()
        folder.mkdir(exist_ok=True)
        write_job(folder, self.source, settings, trajectory, fingerprint, stamps=stamps, sweeps=sweeps)
        groups = [pairs[start : start + PAIRS_PER_TASK] for start in range(0, len(pairs), PAIRS_PER_TASK)]
        function = path_of(register_some)
        tasks = [
            Task(f"{log.name}, places that are passed again", function, (str(folder), fingerprint, n, group))
            for n, group in enumerate(groups)
        ]
        results = {task.arguments[2]: found for task, found in run_tasks(tasks, self.executor)}
        for n in range(len(groups)):
            yield from map(_unpacked, results[n])


def register_some(folder: str, fingerprint: str, number: int, pairs: list[list[int]]) -> list[Any]:
    """Register pairs, and save what was found: a task. Raises DataError if the drive is another one here."""
    file = Path(folder) / f"{number}.json"
    passes, settings = _opened(folder, fingerprint)
    made_from = digest([fingerprint, pairs])
    known = read_record(file)
    if known is not None and known.get("made_from") == made_from:
        return list(known["found"])
    found = [_packed(register_pair(passes, (a, i, b, j), settings)) for a, i, b, j in pairs]
    write_record({"made_from": made_from, "found": found}, file)
    return found


@lru_cache(1)
def _opened(folder: str, fingerprint: str) -> tuple[list[Pass], RevisitSettings]:
    """The places of a job: opened once for all tasks of a worker."""
    about, source, settings, log, trajectory = read_job(Path(folder))
    here = _fingerprint(log, trajectory, settings, about["stamps"], about["sweeps"])
    if not here == about["fingerprint"] == fingerprint:
        raise other_drive(source)
    stamps = np.array(about["stamps"])
    sweeps = sweeps_of(log, about["sweeps"], Path(folder).parent / SWEEPS)
    maps = LocalMaps(sweeps, trajectory, stamps)
    anchors = np.empty(0, np.intp)  # of the graph, which is elsewhere
    return [Pass(anchors, stamps, trajectory.at(stamps), maps)], settings.trajectory.revisits


def _fingerprint(
    log: SensorLog, trajectory: Trajectory, settings: Settings, stamps: list[float], sweeps: list[int]
) -> str:
    """Digest of all that decides what is found, but the pairs: a worker of a cluster outlives a run."""
    of_drive = fingerprints.of_matches(log, trajectory, settings)
    return digest([of_drive, settings.trajectory.revisits.model_dump_json(), stamps, sweeps])


def _packed(found: Found | None) -> Any:
    """As JSON, in which numbers keep all their digits."""
    if found is None:
        return None
    return [found.T.tolist(), found.covariance.tolist(), [a.tolist() for a in found.sample]]


def _unpacked(packed: Any) -> Found | None:
    if packed is None:
        return None
    T, covariance, (points, normals) = packed
    return Found(np.array(T), np.array(covariance), (np.array(points), np.array(normals)))
