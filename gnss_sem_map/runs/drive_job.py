"""A drive for the tasks of a worker: what it opens, the settings, and the trajectory, in a folder that it sees.

FOLDER/job.json          the source, the settings, and the fingerprint that the worker must find
       trajectory.npz    the trajectory itself: nothing is rounded, so the results have the same bytes
"""

from __future__ import annotations

import io
import json
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np

from factor_graphs.trajectory import Trajectory
from gnss_sem_map.config import Settings
from gnss_sem_map.errors import DataError
from gnss_sem_map.files.ownership import write_whole
from gnss_sem_map.files.work_folder import JOB, TRAJECTORY
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
    arrays = {field.name: getattr(trajectory, field.name) for field in fields(Trajectory)}
    file = io.BytesIO()
    np.savez(file, **{name: array for name, array in arrays.items() if array is not None})
    try:
        write_whole(folder / TRAJECTORY, file.getvalue())
        write_whole(folder / JOB, json.dumps(about).encode())
    except OSError as error:
        raise DataError(
            f"{folder}: cannot be written ({error.strerror}); free the disk, then run it again"
        ) from None


def read_job(folder: Path) -> tuple[dict[str, Any], Source, Settings, SensorLog, Trajectory]:
    """A job, and the log that it names; without the IMU, which nobody needs beside a trajectory."""
    about: dict[str, Any] = json.loads((folder / JOB).read_text("utf-8"))
    settings, source = Settings.model_validate(about["settings"]), Source(**about["source"])
    log = source.open_log(with_imu=False).in_our_conventions(settings.sensors)
    with np.load(folder / TRAJECTORY) as arrays:
        return about, source, settings, log, Trajectory(**arrays)


def other_drive(source: Source) -> DataError:
    """The worker's log has another fingerprint."""
    return DataError(
        f"{source.drive}: a worker finds another drive or other labels than the main process: files were changed, are"
        " not the same on its machine, or a script changed the log; take one worker, or the files as they are"
    )
