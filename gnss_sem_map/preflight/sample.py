"""The part of a drive that the pre-flight looks at, each thing computed once and only when a check asks for it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from factor_graphs.measurements import ImuSamples
from gnss_sem_map.config import Settings
from gnss_sem_map.preflight.diagnosis import Diagnosis, diagnose
from gnss_sem_map.preflight.fixes import Fixes, examine
from gnss_sem_map.segmentation import Segmenter
from gnss_sem_map.sensor_log import SensorLog

# So much of a long drive, s, shows any mistake in the axes and clocks; it begins where the fixes begin to move.
STRETCH_S = 600.0
# A stretch with fewer samples shows nothing.
LEAST_SAMPLES = 10


@dataclass(frozen=True, eq=False)
class Sample:
    """A drive, and what several checks share of it."""

    log: SensorLog
    settings: Settings
    segmenter: Segmenter | None

    @cached_property
    def fixes(self) -> Fixes | None:
        """The GNSS fixes, which of them can be used, and what is odd about them; None: poses are given."""
        log = self.log
        if log.given is not None or log.imu is None or log.gnss is None or log.frame is None:
            return None
        return examine(log.gnss, log.frame, log.imu, self.settings.trajectory.max_speed_mps)

    @cached_property
    def diagnosis(self) -> Diagnosis | None:
        """What is probably wrong with the IMU; None: poses are given, or there is too little of it."""
        log, fixes = self.log, self.fixes
        if fixes is None or log.imu is None or log.frame is None:
            return None
        start = max(fixes.moves_from_s - 10.0, float(log.imu.stamps[0]))
        imu = stretch(log.imu, start, start + STRETCH_S)
        if len(imu) < LEAST_SAMPLES:
            return None
        lever = complex(*log.calibration.p_imu_antenna[:2])
        within = (fixes.usable.stamps >= start) & (fixes.usable.stamps <= start + STRETCH_S)
        return diagnose(imu, fixes.usable[within], log.frame, log.reference, lever)


def stretch(imu: ImuSamples, start: float, end: float) -> ImuSamples:
    """The samples between two stamps, s."""
    within = slice(*np.searchsorted(imu.stamps, [start, end]))
    return ImuSamples(imu.stamps[within], imu.specific_force[within], imu.angular_rate[within])
