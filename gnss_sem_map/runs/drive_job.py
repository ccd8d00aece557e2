"""A drive for the tasks of a worker: what it opens, the settings, and the trajectory, in a folder that it sees.

FOLDER/job.json          the source, the settings, and the fingerprint that the worker must find
       trajectory.npz    the trajectory itself: nothing is rounded, so the results have the same bytes
"""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from factor_graphs.trajectory import Trajectory
from gnss_sem_map.config import Settings
from gnss_sem_map.errors import DataError
from gnss_sem_map.files.archives import npz_of
from gnss_sem_map.files.atomic import write_whole
from gnss_sem_map.files.work_folder import JOB, TRAJECTORY, writing_to
from gnss_sem_map.runs.source import Source
from gnss_sem_map.sensor_log import SensorLog


def write_job(
    folder: Path,
    source: Source,
    settings: Settings,
    trajectory: Trajectory,
    fingerprint: str,
    **more: Any,
) -> None:
    """Write a job, and `more` that is JSON; raises DataError."""
    about = {
        "source": asdict(source),
        "settings": settings.model_dump(mode="json"),
        "fingerprint": fingerprint,
        **more,
    }
    with writing_to(folder):
        write_whole(folder / TRAJECTORY, npz_of(trajectory))
        write_whole(folder / JOB, json.dumps(about).encode())


def read_job(folder: Path) -> tuple[dict[str, Any], Source, Settings, SensorLog, Trajectory]:
    """A job, and the log that it names; without the IMU, which nobody needs beside a trajectory."""
    about: dict[str, Any] = json.loads((folder / JOB).read_text("utf-8"))
    settings, source = Settings.model_validate(about["settings"]), Source(**about["source"])
    log = source.open_log(with_imu=False).in_our_conventions(settings.sensors)
    return about, source, settings, log, read_trajectory(folder / TRAJECTORY)


def read_trajectory(file: Path) -> Trajectory:
    """The trajectory of a job."""
    with np.load(file) as arrays:
        return Trajectory(**arrays)


def other_drive(source: Source) -> DataError:
    """The worker's log has another fingerprint."""
    return DataError(
        f"{source.drive}: a worker finds another drive or other labels than the main process: files were changed, are"
        " not the same on its machine, or a script changed the log; take one worker, or the files as they are"
    )
