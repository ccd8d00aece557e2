"""Checkpoint of the search for moving objects: with --resume, a finished search is not repeated.

It lies in the folder `motion/` of the work folder. `about.json` is written last: it holds the fingerprint of the run
and the checksum of every file. A checkpoint that is incomplete, damaged or of another run is not used.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from gnss_sem_map.dynamics.motion_state import Motion, TrackedObject
from gnss_sem_map.dynamics.moving_objects import MovingObjects
from gnss_sem_map.errors import DataError
from gnss_sem_map.files import work_folder
from gnss_sem_map.files.ownership import write_whole
from gnss_sem_map.mapping import evidence
from gnss_sem_map.mapping.fusion import fingerprint
from gnss_sem_map.mapping.labelled_scans import Drive

ABOUT, OBJECTS = "about.json", "objects.json"


@dataclass(frozen=True)
class MotionCheckpoint:
    """The moving objects of one run on disk; `open_checkpoint` makes it."""

    folder: Path
    fingerprint: str
    """Of everything that decides the search."""

    def read(self) -> MovingObjects | None:
        """The result of a finished search; None if there is none, or it cannot be used."""
        try:
            about = json.loads((self.folder / ABOUT).read_text("utf-8"))
            if about["fingerprint"] != self.fingerprint or about["files"] != self._checksums():
                return None
            objects = json.loads((self.folder / OBJECTS).read_text("utf-8"))
            keyframes = self.folder / evidence.KEYFRAMES
            return MovingObjects(
                evidence.read_moving_points(self.folder / evidence.MOVING_POINTS),
                tuple(_from_json(one) for one in objects),
                evidence.read_keyframes(keyframes) if keyframes.name in about["files"] else None,
            )
        except (DataError, OSError, ValueError, KeyError, TypeError):
            return None

    def write(self, found: MovingObjects) -> None:
        """Keep the result of a search; raises DataError when it cannot be written."""
        work = self.folder.parent
        try:
            work_folder.remove_motion(work)
            self.folder.mkdir()
            evidence.write_moving_points(found.points, self.folder / evidence.MOVING_POINTS)
            if found.keyframes is not None:
                evidence.write_keyframes(found.keyframes, self.folder / evidence.KEYFRAMES)
            write_whole(self.folder / OBJECTS, json.dumps([_to_json(one) for one in found.objects]).encode())
            about = {"fingerprint": self.fingerprint, "files": self._checksums()}
            write_whole(self.folder / ABOUT, json.dumps(about).encode())
        except OSError as error:
            raise DataError(
                f"{self.folder}: cannot be written ({error.strerror or error}); free the disk, then --resume"
            ) from None

    def _checksums(self) -> dict[str, str]:
        """Name -> SHA-256 of every file that the search found something for; raises OSError."""
        found = {}
        for path in self.folder.iterdir():
            if path.name != ABOUT:
                with path.open("rb") as file:
                    found[path.name] = hashlib.file_digest(file, "sha256").hexdigest()
        return found


def open_checkpoint(work: Path, drive: Drive, labels_from: str, resume: bool) -> MotionCheckpoint:
    """The checkpoint of a drive in a work folder; without `resume`, an earlier one is removed.

    Raises DataError when the folder cannot be written.
    """
    work_folder.make(work)
    folder = work / work_folder.MOTION
    try:
        if not resume:
            work_folder.remove_motion(work)
    except OSError as error:
        raise DataError(f"{folder}: cannot be written ({error.strerror}); choose another place") from None
    return MotionCheckpoint(folder, _fingerprint(drive, labels_from))


def _fingerprint(drive: Drive, labels_from: str) -> str:
    """What two runs share when the search finds the same in both: what decides the map, and the search's settings."""
    of_map = fingerprint(replace(drive, moving=None), labels_from)
    said = [of_map, drive.settings.dynamics.model_dump_json(), drive.from_lidar_odometry]
    return hashlib.sha256(repr(said).encode()).hexdigest()


def _to_json(one: TrackedObject) -> dict[str, Any]:
    return asdict(one) | {"path": one.path.tolist()}


def _from_json(content: dict[str, Any]) -> TrackedObject:
    given = {
        "motion": Motion(content["motion"]),
        "segments": tuple(content["segments"]),
        "path": np.array(content["path"], np.float64),
    }
    return TrackedObject(**content | given)
