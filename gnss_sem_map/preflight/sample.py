"""The part of a drive that the pre-flight looks at, each thing computed once and only when a check asks for it."""

from __future__ import annotations

from dataclasses import dataclass

from gnss_sem_map.config import Settings
from gnss_sem_map.segmentation import Segmenter
from gnss_sem_map.sensor_log import SensorLog


@dataclass(frozen=True, eq=False)
class Sample:
    """A drive, and what several checks share of it."""

    log: SensorLog
    settings: Settings
    segmenter: Segmenter | None
