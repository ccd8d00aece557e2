"""The tracks from which pictures show the map of a run: one for every drive."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from factor_graphs.trajectory import Trajectory
from gnss_sem_map.files.run_json import read_run
from gnss_sem_map.files.untrusted import is_folder
from gnss_sem_map.files.work_folder import DRIVES

TRACKS = "tracks"
"""Folder of a merged run, which has no drives and no trajectory of its own."""


def tracks_of(run: Path) -> list[Trajectory]:
    """Where each drive of a run had scans; of a merged run, those of the first of both."""
    if is_folder(run / DRIVES):
        return [track for drive in sorted((run / DRIVES).iterdir()) for track in tracks_of(drive)]
    if is_folder(run / TRACKS):
        return [Trajectory.load(path) for path in sorted((run / TRACKS).glob("*.parquet"))]
    first, last = read_run(run)["scans_s"]
    return [Trajectory.load(run / "trajectory.parquet").during(first, last)]


def keep_tracks(run: Path, tracks: Iterable[Trajectory]) -> None:
    """Write the tracks of a merged run, their poses alone."""
    (run / TRACKS).mkdir()
    for number, track in enumerate(tracks):
        Trajectory(track.stamps, track.T_map_imu).save(run / TRACKS / f"{number:04d}.parquet")
