"""What a run reads, in words: with them any process opens the same log and the same network."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gnss_sem_map.config import Settings
from gnss_sem_map.datasets import open_drive
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.segmentation import Segmenter, open_segmenter
from gnss_sem_map.sensor_log import SensorLog


@dataclass(frozen=True)
class Source:
    """A drive and the SPEC of its segmenter; `source_of` makes it. All paths are absolute."""

    drive: str
    segmenter: str | None = "none"
    """None and `none`: no labels, geometry only."""
    frames: str | None = None
    drive_format: str | None = None
    device: str = "auto"
    called: str = ""
    """The name of the drive, where its folder has another one now: it was given as a link."""
    trajectory: str | None = None
    """A file of poses in place of the drive's own."""

    @property
    def name(self) -> str:
        """The name of the drive: that of its folder, or of the link that was given."""
        return self.called or Path(self.drive).name

    @property
    def labels_from(self) -> str:
        """Where labels come from, for the fingerprint of a map."""
        return str(self.segmenter)

    @property
    def inputs(self) -> dict[str, Any]:
        """From what the run is made, for run.json."""
        return {
            "drive": str(Path(self.drive).resolve()),
            "segmenter": self.segmenter,
            "frames": self.frames,
            "drive_format": self.drive_format,
            **({} if self.trajectory is None else {"trajectory": self.trajectory}),
        }

    def open_log(self, with_imu: bool = True) -> SensorLog:
        """The log, with the scans of `frames`; raises DataError and ConfigError."""
        return open_drive(self.drive, self.drive_format, with_imu, self.trajectory).between(self.frames)

    def open_network(self, settings: Settings, log: SensorLog) -> Segmenter | None:
        """The segmenter for the images of this log; None for geometry only. Raises DataError and ConfigError."""
        if self.segmenter in (None, "none"):
            return None
        label_set, sizes = open_label_set(settings.classes), log.calibration.image_sizes
        return open_segmenter(str(self.segmenter), label_set, self.device, sizes)


def source_of(
    drive: Path,
    segmenter: str | None = "none",
    frames: str | None = None,
    drive_format: str | None = None,
    device: str = "auto",
    trajectory: Path | str | None = None,
) -> Source:
    """The source of a run; `{drive}` in the SPEC and in `trajectory` stands for the name of the drive."""
    folder = os.path.abspath(drive)
    name = Path(folder).name
    spec = None if segmenter is None else absolute(segmenter.replace("{drive}", name))
    poses = None if trajectory is None else os.path.abspath(str(trajectory).replace("{drive}", name))
    return Source(folder, spec, frames, drive_format, device, trajectory=poses)


def absolute(segmenter: str) -> str:
    """The segmenter's SPEC with an absolute path."""
    kind, colon, rest = segmenter.partition(":")
    place, mark, options = rest.partition("?")
    if not place or not Path(place).exists():
        return segmenter
    return f"{kind}{colon}{Path(place).resolve()}{mark}{options}"
