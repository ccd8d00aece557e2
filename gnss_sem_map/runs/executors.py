"""Where the tasks of a run are called: here, in processes of this machine, or on a Dask cluster."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from gnss_sem_map.files import work_folder
from gnss_sem_map.process.dask_cluster import Cluster
from gnss_sem_map.process.execution import Executor, InProcess
from gnss_sem_map.process.worker_processes import Processes

LONGEST_TASK_S = 86_400.0
"""A worker that is busy with one drive, or a part of it, for longer is replaced."""


@contextmanager
def executor_of(
    workers: int, scheduler: str | None, work: Path, reads: Iterable[Path | str | None]
) -> Iterator[Executor]:
    """Processes, or the workers of the Dask scheduler at an address; else this process.

    `work` is the work folder of the run, and it `reads` these inputs; what is not there is told later. Raises
    ConfigError and DataError for a cluster that cannot do the tasks.
    """
    if scheduler is not None:
        work_folder.make(work)
        there = [
            Path(os.path.abspath(place)) for place in reads if place is not None and os.path.exists(place)
        ]
        cluster = Cluster(scheduler, work, tuple(there), timeout_s=LONGEST_TASK_S)
        cluster.check()
        yield cluster
    elif workers > 1:
        with closing(Processes(workers, timeout_s=LONGEST_TASK_S, keep=True)) as processes:
            yield processes
    else:
        yield InProcess()
