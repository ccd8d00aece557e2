"""The sample of a drive for the pre-flight check; every value is computed once, when a check first needs it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from factor_graphs.errors import FactorGraphError
from factor_graphs.measurements import ImuSamples
from factor_graphs.smoothing import Solution
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.config import Settings
from gnss_sem_map.errors import DataError
from gnss_sem_map.mapping.trajectory import smooth_log
from gnss_sem_map.preflight.diagnosis import Diagnosis, diagnose
from gnss_sem_map.preflight.fixes import Fixes, examine
from gnss_sem_map.preflight.lidar_motion import STEPS, Stretch, Surfaces, stretch
from gnss_sem_map.scans.deskew import EXTRAPOLATE_S, LONGEST_SWEEP_S
from gnss_sem_map.scans.registration import inverse
from gnss_sem_map.segmentation import Segmenter
from gnss_sem_map.sensor_log import Points, Scan, SensorLog

Array = NDArray[np.float64]
LONGEST_S = 60.0
"""Of a longer drive so much is smoothed, and looked at closely; more of one that hardly shows its axes."""
SCANS_PER_STRETCH, LEAST_STRETCHES, MOST_STRETCHES = 40, 3, 5
"""One stretch in so many scans: what is looked at grows with the drive, and so does the run."""
LONGEST_STRETCH_S = 3.0
SCANS_PER_IMAGE, LEAST_IMAGES, MOST_IMAGES = 30, 10, 12
LEAST_WAY_M = 5.0
"""Images of places so far apart are different."""

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
        imu = between(log.imu, start, start + STRETCH_S)
        if len(imu) < LEAST_SAMPLES:
            return None
        lever = complex(*log.calibration.p_imu_antenna[:2])
        within = (fixes.usable.stamps >= start) & (fixes.usable.stamps <= start + STRETCH_S)
        return diagnose(imu, fixes.usable[within], log.frame, log.reference, lever)

    @property
    def trajectory(self) -> Trajectory | None:
        """The poses that came with the drive, or IMU and fixes of one stretch smoothed; None where that fails."""
        if self.log.given is not None or self._solution is None:
            return self.log.given
        return self._solution.trajectory

    @property
    def track_from(self) -> str:
        """What the trajectory was made from, in words."""
        return "the fixes" if self.log.given is None else "the given poses"

    @property
    def whole_solution(self) -> Solution | None:
        """The drive smoothed as a run smooths it first; None where only a stretch was, or what was corrected."""
        is_as_logged = self.diagnosis is None or self.diagnosis.is_right
        return self._solution if is_as_logged and self._is_short else None

    @cached_property
    def _solution(self) -> Solution | None:
        log = self.log
        if log.given is not None or log.imu is None or log.gnss is None:
            return None
        if self.diagnosis is not None:
            log = replace(log, imu=self.diagnosis.corrected(log.imu))
        try:
            stretch = log if self._is_short else _stretch_of(log, self._longest_s)
            return smooth_log(stretch, self.settings.trajectory)
        except FactorGraphError:
            return None

    @property
    def _is_short(self) -> bool:
        """Whether the stretch that is smoothed is the whole drive."""
        imu = self.log.imu
        return imu is not None and float(imu.stamps[-1] - imu.stamps[0]) <= self._longest_s

    @property
    def _longest_s(self) -> float:
        """A slow vehicle speeds up less than its fixes scatter: minutes of it tell the heading of its IMU."""
        return STRETCH_S if self.diagnosis is not None and self.diagnosis.moves_untold else LONGEST_S

    @property
    def stretches(self) -> tuple[Stretch, ...]:
        """A few seconds of the drive, as the LiDAR saw its own motion, where the vehicle moves most."""
        return tuple(seen for seen in self.tried.values() if isinstance(seen, Stretch) and seen.is_held)

    @cached_property
    def tried(self) -> dict[float, Stretch | DataError | None]:
        """The stretches looked at by the stamp of their first scan, in order; None: sweeps that do not fit."""
        scans = self.log.scans
        last = len(scans) - 1 - STEPS[-1]
        if last < 0:
            return {}
        wanted = int(np.clip(len(scans) // SCANS_PER_STRETCH + 1, LEAST_STRETCHES, MOST_STRETCHES))
        firsts = np.unique(np.linspace(0, last, 3 * wanted).astype(int))
        motion = np.array([self._motion(first) for first in firsts])
        found: dict[float, Stretch | DataError | None] = {}
        taken: list[int] = []
        for place in np.argsort(-motion, kind="stable"):
            first = int(firsts[place])
            if len(found) == wanted or motion[place] < 0:
                break
            if any(abs(first - other) < STEPS[-1] for other in taken):
                continue
            taken.append(first)
            try:
                found[scans[first].stamp] = stretch(scans, first, self._starts(first))
            except DataError as error:
                found[scans[first].stamp] = error
        return dict(sorted(found.items()))

    @cached_property
    def first_points(self) -> tuple[Points, float] | None:
        """The first scan that can be read, and its stamp."""
        return first_readable(self.log.scans)

    def deskewed(self, seen: Stretch) -> tuple[Array, Surfaces]:
        """A stretch with the times that its points were given, see `Stretch.deskewed`: computed once."""
        if id(seen) not in self._deskewed:
            self._deskewed[id(seen)] = seen.deskewed(
                tuple(
                    (s.after_s, s.dense_after_s)
                    if s.after_s is not None
                    and s.dense_after_s is not None
                    and np.ptp(s.after_s) < LONGEST_SWEEP_S
                    else None
                    for s in seen.sweeps
                )
            )
        return self._deskewed[id(seen)]

    @cached_property
    def _deskewed(self) -> dict[int, tuple[Array, Surfaces]]:
        return {}

    @cached_property
    def moving_scans(self) -> tuple[list[Scan], list[Scan]]:
        """Scans spread over the drive: those that move most, for a moment differs from another there, and the rest."""
        scans = self.log.scans
        if not scans:
            return [], []
        wanted = int(np.clip(len(scans) // SCANS_PER_IMAGE + 1, LEAST_IMAGES, MOST_IMAGES))
        places = np.unique(np.linspace(0, len(scans) - 1, 3 * wanted).astype(int))
        motion = np.array([self._speed(scans[place].stamp) for place in places])
        order = [k for k in np.argsort(-motion, kind="stable") if motion[k] >= 0]
        first, rest = ([scans[places[k]] for k in sorted(some)] for some in (order[:wanted], order[wanted:]))
        return first, rest

    def _speed(self, stamp: float) -> float:
        """Way in a tenth of a second, a turn counted as at 10 m; -1 beyond the trajectory."""
        track = self.trajectory
        if track is None:
            return 0.0
        if stamp < track.start - EXTRAPOLATE_S / 2 or stamp > track.end + EXTRAPOLATE_S / 2:
            return -1.0
        return _way(*track.at([stamp - 0.05, stamp + 0.05], EXTRAPOLATE_S))

    @property
    def is_moving(self) -> bool:
        """Whether the first and the last scan that are looked at see different places."""
        scans = self.moving_scans[0]
        if self.trajectory is None or len(scans) < 2:
            return False
        return _way(*self.trajectory.at([scans[0].stamp, scans[-1].stamp], EXTRAPOLATE_S)) > LEAST_WAY_M

    def _starts(self, first: int) -> tuple[Array, ...]:
        """T_first_second of the second sweep by the trajectory: as the extrinsics say, and straight ahead."""
        track, stamps = self.trajectory, [scan.stamp for scan in self.log.scans[first : first + 2]]
        if track is None:
            return ()
        a, b = track.at(stamps, EXTRAPOLATE_S)
        way = inverse(a) @ b
        T_imu_lidar = self.log.calibration.T_imu_lidar.copy()
        T_imu_lidar[:3, 3] = 0.0
        along = np.linalg.norm(way[:3, 3])
        ahead = np.eye(4)
        ahead[0, 3] = along
        return inverse(T_imu_lidar) @ way @ T_imu_lidar, ahead

    def _motion(self, first: int) -> float:
        """How far a stretch moves, m, a turn counted as at 10 m; -1 where it has a gap or leaves the trajectory."""
        stamps = np.array([self.log.scans[first + step].stamp for step in (0, STEPS[-1])])
        if stamps[1] - stamps[0] > LONGEST_STRETCH_S:
            return -1.0
        track = self.trajectory
        if track is None:
            return 0.0
        if stamps[0] < track.start - EXTRAPOLATE_S or stamps[1] > track.end + EXTRAPOLATE_S:
            return -1.0
        return _way(*track.at(stamps, EXTRAPOLATE_S))


def first_readable(scans: tuple[Scan, ...]) -> tuple[Points, float] | None:
    """The points and the stamp of the first of ten scans that can be read; None if there is none."""
    for scan in scans[:10]:
        try:
            return scan.read(), scan.stamp
        except DataError:
            continue
    return None


def _way(a: Array, b: Array) -> float:
    """Between two poses, m, a turn counted as at 10 m."""
    turn = np.arccos(np.clip((np.trace(a[:3, :3].T @ b[:3, :3]) - 1) / 2, -1, 1))
    return float(np.linalg.norm(b[:3, 3] - a[:3, 3]) + 10.0 * turn)


def _stretch_of(log: SensorLog, longest_s: float) -> SensorLog:
    """IMU and fixes of the stretch in which most way lies ahead."""
    assert log.imu is not None
    assert log.gnss is not None
    stamps, gnss = log.imu.stamps, log.gnss
    starts = np.arange(stamps[0], stamps[-1] - longest_s, longest_s / 2)
    at = np.column_stack([np.interp(starts, gnss.stamps, p) for p in gnss.positions.T])
    later = np.column_stack([np.interp(starts + longest_s, gnss.stamps, p) for p in gnss.positions.T])
    start = float(starts[np.argmax(np.linalg.norm(later - at, axis=1))])
    return replace(
        log,
        imu=between(log.imu, start, start + longest_s),
        gnss=gnss[(gnss.stamps >= start) & (gnss.stamps <= start + longest_s)],
        initial_attitude=log.initial_attitude if start == stamps[0] else None,
    )


def between(imu: ImuSamples, start: float, end: float) -> ImuSamples:
    """The samples between two stamps, s."""
    within = slice(*np.searchsorted(imu.stamps, [start, end]))
    return ImuSamples(imu.stamps[within], imu.specific_force[within], imu.angular_rate[within])
