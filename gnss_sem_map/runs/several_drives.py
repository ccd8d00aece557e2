"""What all steps of a map of several drives share, and how they call a task for every drive."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import asdict, astuple, dataclass, field
from pathlib import Path
from secrets import token_hex
from typing import Any

from factor_graphs.geodesy import LocalFrame
from gnss_sem_map.config import Settings
from gnss_sem_map.errors import DataError
from gnss_sem_map.files.untrusted import is_file
from gnss_sem_map.files.work_folder import DRIVES
from gnss_sem_map.process.execution import Executor, Task, path_of, run_tasks
from gnss_sem_map.process.run_stats import Progress
from gnss_sem_map.runs.source import Source


@dataclass(frozen=True, eq=False)
class SeveralDrives:
    """How a map of several drives is made, and where."""

    settings: Settings
    frame: LocalFrame
    """Of the map."""
    work: Path
    """Work folder, which the workers of the executor see."""
    executor: Executor
    progress: Progress
    token: str = field(default_factory=lambda: token_hex(8))
    """Sets its tasks apart from those of an earlier run, which a cluster may still have under way."""

    @property
    def settings_file(self) -> Path:
        """From where tasks read the settings."""
        return self.work / DRIVES / f"config.{self.token}.yaml"

    def write_settings(self) -> None:
        """Write the settings for tasks, and remove those of earlier runs; raises OSError."""
        for file in (self.work / DRIVES).glob("config.*.yaml"):
            file.unlink()
        self.settings_file.write_text(self.settings.to_yaml(), "utf-8")

    def call(
        self, function: Callable[..., str], stage: str, drives: Iterable[tuple[Source, tuple[Any, ...]]]
    ) -> dict[str, str]:
        """Call a task for every drive, and tell the progress of a stage; name -> why it failed, empty if it did not.

        The arguments are the source of the drive, the file of the settings, the origin of the map, and more of each.
        """
        shared = str(self.settings_file), astuple(self.frame)
        tasks = [
            Task(source.name, path_of(function), (asdict(source), *shared, *more)) for source, more in drives
        ]
        found = run_tasks(
            tasks, self.executor, lambda done, total: self.progress(stage, done, total), lost=str
        )
        return {task.name: reason for task, reason in found}


def refuse_earlier(settings_file: Path) -> None:
    """Raise DataError in a task whose run has ended and was followed by another one: its settings are gone."""
    if not is_file(settings_file):
        raise DataError(f"{settings_file}: is gone; this task is of a run that has ended")
