"""The tracks from which pictures show the map of a run: one for every drive."""

from __future__ import annotations

from pathlib import Path

from factor_graphs.trajectory import Trajectory
from gnss_sem_map.files.run_json import read_run
from gnss_sem_map.files.untrusted import is_folder
from gnss_sem_map.files.work_folder import DRIVES


def tracks_of(run: Path) -> list[Trajectory]:
    """Where each drive of a run had scans."""
    if is_folder(run / DRIVES):
        return [track for drive in sorted((run / DRIVES).iterdir()) for track in tracks_of(drive)]
    first, last = read_run(run)["scans_s"]
    return [Trajectory.load(run / "trajectory.parquet").during(first, last)]
