"""How a map is made, of one drive or many, and how its stages call tasks."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from factor_graphs.geodesy import LocalFrame
from gnss_sem_map.config import Settings
from gnss_sem_map.process.execution import Executor, InProcess, Task, attempted, path_of, run_tasks
from gnss_sem_map.process.run_stats import Progress, silent


@dataclass(frozen=True, eq=False)
class MapJob:
    """How a map is made, and where."""

    settings: Settings
    frame: LocalFrame | None
    """Of the map; None: its only drive has no georeference."""
    work: Path
    """Work folder, which the workers of the executor see."""
    executor: Executor = field(default_factory=InProcess)
    progress: Progress = silent
    is_one: bool = False
    """Whether it is of one drive: then its error is raised, and its files are those of the map."""
    failed: dict[str, str] = field(default_factory=dict)
    """Drive -> why it was left out on the way."""

    def call(self, stage: str, tasks: Mapping[str, Sequence[Task]]) -> dict[str, list[Any]]:
        """Call the tasks of all drives, and tell the progress of a stage; drive -> results in their order.

        A drive of which a task fails is left out. Of a map of one, the error is raised.
        """
        flat = [task for of_drive in tasks.values() for task in of_drive]
        if not flat:
            return {name: [] for name in tasks}
        # of a single one, a worker would take seconds to start
        executor = self.executor if len(flat) > 1 else InProcess()
        calls = {task if self.is_one else attempted(task): task for task in flat}
        found: dict[Task, Any] = {}
        lost: dict[str, Any] = {} if self.is_one else {"lost": lambda error: {"failed": str(error)}}
        for call, result in run_tasks(
            calls, executor, lambda done, total: self.progress(stage, done, total), **lost
        ):
            found[calls[call]] = result if self.is_one else result.get("result")
            if not self.is_one and "failed" in result:
                name = next(name for name, of_drive in tasks.items() if calls[call] in of_drive)
                self.failed.setdefault(name, result["failed"].removeprefix(f"{name}: "))
        return {
            name: [found[task] for task in of_drive]
            for name, of_drive in tasks.items()
            if name not in self.failed
        }


def task_of(name: str, function: Callable[..., Any], *arguments: Any, size: int = 1) -> Task:
    """A task of this name for reports."""
    return Task(name, path_of(function), arguments, size)
