"""LiDAR odometry: every deskewed sweep is registered to a local map of earlier sweeps -> relative poses, covariances.

The registration is VGICP of `small_gicp` (Koide et al. 2021: voxelised generalised ICP). This module adds an initial
guess from the trajectory, a covariance that is large in degenerate directions, and a check of every match. The factor
graph uses relative poses, because absolute positions drift. Places that are passed again: `revisits`.

A long drive is matched in sections, which may be matched at the same time. A section begins with the last sweeps of the
one before, for a local map to start with.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial, reduce
from itertools import chain, pairwise
from operator import add
from pathlib import Path
from typing import Literal

import numpy as np
import small_gicp
from numpy.typing import NDArray
from pydantic import Field

from factor_graphs.errors import MeasurementError
from factor_graphs.relative_poses import RelativePoses
from factor_graphs.settings import SmootherSettings
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.errors import DataError
from gnss_sem_map.process.prefetch import prefetch
from gnss_sem_map.process.run_stats import Progress, silent
from gnss_sem_map.scans import registration
from gnss_sem_map.scans.deskew import usable_points_at_stamp
from gnss_sem_map.scans.downsampling import thinned
from gnss_sem_map.scans.registration import DegenerateSettings
from gnss_sem_map.scans.revisits import RevisitSettings
from gnss_sem_map.scans.thinned_sweeps import ThinnedSweeps
from gnss_sem_map.sensor_log import Points, Scan, SensorLog, Skip

Array = NDArray[np.float64]

# Correspondence distance of the second registration, as a share of the voxel size. Points that are farther from their
# surface belong to moving objects: a car ahead, 0.5 m farther since the last sweep, would pull the sweep with it.
SETTLED = 0.5
# The two registrations stop when a step is shorter than this.
COARSE_M, FINE_M = 0.01, 0.001
# Neighbours for the plane of a point: with ten or twenty, planes tilt at edges, and the sweep rolls with them.
NEIGHBOURS = 6
# Sweeps overlap, so every other matched one is added to the local map: on simulated drives the poses drift no more.
EVERY_NTH_IN_MAP = 2
# Anchors are so many sweeps apart, and each is bound to so many before it. If each sweep were bound to the tenth before
# it, the graph of a drive of 480 s would take half as much memory again (780 MB for 530), for the same accuracy.
ANCHOR_SCANS, ANCHORS_BOUND = 10, 3
# So many sweeps are matched before a section, for its local map.
WARM_UP_SCANS = 50


class ScanMatchingSettings(DegenerateSettings):
    """How sweeps are matched; the defaults suit a spinning LiDAR of 16 to 128 beams on a road vehicle."""

    nearest_m: float = Field(2.5, ge=0, description="Nearer returns, of the vehicle itself, are left out.")
    farthest_m: float = Field(80.0, gt=0, description="Farther returns are too sparse to match.")
    downsampling_m: float = Field(0.55, gt=0, description="One point of a sweep per cube of this edge.")
    voxel_size_m: float = Field(0.5, gt=0, description="Edge of the local map's voxels.")
    map_scans: int = Field(
        100, gt=0, description="Voxels not observed for so many sweeps are removed from the local map."
    )
    min_points: int = Field(300, gt=0, description="A sweep with fewer downsampled points is not matched.")
    min_inlier_share: float = Field(
        0.25, gt=0, le=1, description="Least share of points with a correspondence."
    )
    max_correction_m: float = Field(
        1.0, gt=0, description="A match farther than this from its initial guess has diverged."
    )
    max_correction_deg: float = Field(5.0, gt=0, description="Likewise, in rotation.")
    max_gap_s: float = Field(1.0, gt=0, description="After a longer gap a new local map is started.")
    section_scans: int = Field(
        600,
        gt=0,
        description="Sections of a long drive, of so many sweeps, are matched each with its own local map.",
    )
    # Halves of the sweeps of a real drive (KITTI 0005), matched separately, show the true noise of a match: 2 to 7 mm
    # and 0.2 to 0.5 mrad over a second, several times the value that follows from the number of points.
    translation_stddev_m: float = Field(0.005, gt=0, description="Least standard deviation of translation.")
    rotation_stddev_rad: float = Field(0.0005, gt=0, description="Least standard deviation of rotation.")


class TrajectorySettings(SmootherSettings):
    """How the trajectory is estimated: GNSS, IMU, and where there are sweeps LiDAR odometry."""

    lidar_odometry: bool = Field(
        True, description="Add relative poses from LiDAR odometry to the factor graph."
    )
    given_poses: Literal["fixed", "measured"] = Field(
        "fixed",
        description="Poses of --trajectory, or of the drive: as they are, or measurements beside LiDAR odometry.",
    )
    given_stddev_m: float = Field(0.1, gt=0, description="Of measured poses without a covariance.")
    given_stddev_deg: float = Field(0.1, gt=0, description="Likewise, of their rotations.")
    scan_matching: ScanMatchingSettings = Field(ScanMatchingSettings(), description="Sweep to local map.")
    revisits: RevisitSettings = Field(RevisitSettings(), description="Places that are passed again.")


@dataclass(frozen=True, eq=False)
class ScanMatches:
    """What scan matching found."""

    relative_poses: RelativePoses
    """Between the stamps of matched sweeps, in the imu frame."""
    skips: tuple[Skip, ...]
    """Sweeps that were not matched, each with the reason; those named "scan" cannot be read."""
    counts: Counter[str]
    """"scans matched", "scans not matched", "scans with an open direction", "local maps"."""

    def __add__(self, later: ScanMatches) -> ScanMatches:
        """Of two sections."""
        return ScanMatches(
            self.relative_poses + later.relative_poses, self.skips + later.skips, self.counts + later.counts
        )


@dataclass(frozen=True, eq=False)
class _Match:
    """Pose of a sweep in the local map; `number` counts the sweeps of the drive, `covariance` (6, 6) is of the tangent
    in LiDAR axes."""

    number: int
    scan: Scan
    local_map: int
    T_local_lidar: Array
    covariance: Array
    is_open: bool


class _NoMatch(Exception):
    """Why a sweep cannot be matched."""


def match_scans(
    log: SensorLog,
    trajectory: Trajectory,
    settings: ScanMatchingSettings | None = None,
    progress: Progress = silent,
) -> ScanMatches:
    """Relative poses from the sweeps of a drive; a drive without a usable sweep has none.

    `trajectory` deskews every sweep, and its relative poses are the initial guesses of the registrations. Sweeps that
    cannot be read or matched are left out and reported in `skips`.
    """
    settings = settings or ScanMatchingSettings()
    sections = sections_of(len(log.scans), settings)
    return reduce(add, (match_section(log, trajectory, settings, part, progress) for part in sections))


def sections_of(count: int, settings: ScanMatchingSettings) -> list[range]:
    """The sections of a drive of so many sweeps; the last one has up to twice as many."""
    edges = [*range(0, max(count - settings.section_scans, 0) + 1, settings.section_scans), count]
    return [range(start, end) for start, end in pairwise(edges)]


def match_section(
    log: SensorLog,
    trajectory: Trajectory,
    settings: ScanMatchingSettings,
    section: range,
    progress: Progress = silent,
    saved: Path | None = None,
) -> ScanMatches:
    """Relative poses of the sweeps of a section to earlier ones; see `match_scans`.

    Sweeps that two sections need are saved in the folder `saved` by the one that reads them first.
    """
    odometry = _Odometry(settings)
    matches: list[_Match] = []
    skips: list[Skip] = []
    first = max(section.start - WARM_UP_SCANS, 0)
    before = 0  # matches of the section before
    # the next sweeps are read, downsampled and deskewed on a second core while one is matched
    sweeps = _sweeps_of(log, settings, saved)
    prepare = partial(_prepare, sweeps=sweeps, trajectory=trajectory, settings=settings)
    for number, sweep in prefetch(prepare, range(first, section.stop)):
        scan = log.scans[number]
        if number == section.start:
            before, skips = len(matches), []
        try:
            if isinstance(sweep, Skip):
                skips.append(sweep)
            else:
                matches.append(odometry.match(number, scan, sweep))
        except _NoMatch as error:
            skips.append(Skip("scan matching", f"frame {log.frame_of(scan)}", str(error)))
        progress("scan matching", number + 1, len(log.scans))
    counts = Counter(
        {
            "scans matched": len(matches) - before,
            "scans not matched": len(skips),
            "scans with an open direction": sum(match.is_open for match in matches[before:]),
            "local maps": odometry.local_maps,
        }
    )
    pairs = list(_pairs(matches, before))
    return ScanMatches(_relative_poses(pairs, log.calibration.T_imu_lidar, settings), tuple(skips), counts)


@dataclass(frozen=True, eq=False)
class _Sweep:
    """A sweep ready for registration: downsampled points, each with its plane, and T_map_lidar by the trajectory."""

    points: small_gicp.PointCloud
    T_map_lidar: Array


def _sweeps_of(log: SensorLog, settings: ScanMatchingSettings, saved: Path | None) -> ThinnedSweeps:
    """The sweeps of a drive, one point per cube; those that end a section begin the next one, too."""

    def one_per_cube(points: Points) -> Points:
        nearest_m, farthest_m = settings.nearest_m, settings.farthest_m
        some = thinned(points, settings.downsampling_m, nearest_m, farthest_m)
        if not len(some.xyz):
            raise DataError(f"no point between {nearest_m:g} and {farthest_m:g} m of {len(points.xyz)}")
        return some

    starts = [section.start for section in sections_of(len(log.scans), settings)]
    shared = (range(max(start - WARM_UP_SCANS, 0), start) for start in starts)
    return ThinnedSweeps(log, "odometry", one_per_cube, frozenset(chain.from_iterable(shared)), saved)


def _prepare(
    number: int, sweeps: ThinnedSweeps, trajectory: Trajectory, settings: ScanMatchingSettings
) -> _Sweep | Skip:
    """The sweep ready for registration, or the reason why it is skipped."""
    log = sweeps.log
    scan = log.scans[number]
    try:
        return _sweep(sweeps[number], scan.stamp, trajectory, log.calibration.T_imu_lidar, settings)
    except (DataError, MeasurementError) as error:
        return Skip("scan", f"frame {log.frame_of(scan)}", str(error))
    except _NoMatch as error:
        return Skip("scan matching", f"frame {log.frame_of(scan)}", str(error))


def _sweep(
    some: Points, stamp: float, trajectory: Trajectory, T_imu_lidar: Array, settings: ScanMatchingSettings
) -> _Sweep:
    """Deskew the points of a thinned sweep, and fit a plane to each."""
    cloud, T_map_lidar = usable_points_at_stamp(some, stamp, trajectory, T_imu_lidar)
    points = small_gicp.PointCloud(cloud)
    if points.size() < settings.min_points:
        raise _NoMatch(
            f"found {points.size()} points after downsampling, expected at least {settings.min_points}"
        )
    # on one thread: a second one of small_gicp waits by spinning, and costs as much time as it saves
    small_gicp.estimate_covariances(points, small_gicp.KdTree(points), NEIGHBOURS)
    return _Sweep(points, T_map_lidar)


class _Odometry:
    """The local map, and the pose of the last matched sweep in the local map and by the trajectory."""

    def __init__(self, settings: ScanMatchingSettings) -> None:
        self.local_maps = 0
        self._settings = settings
        self._last: tuple[Scan, Array, Array] | None = None

    def match(self, number: int, scan: Scan, sweep: _Sweep) -> _Match:
        """Register a sweep, and add every other one to the local map; raises _NoMatch, with the map unchanged."""
        if self._last is None or scan.stamp - self._last[0].stamp > self._settings.max_gap_s:
            self._map = small_gicp.GaussianVoxelMap(self._settings.voxel_size_m)
            self._map.set_lru(horizon=max(1, self._settings.map_scans // EVERY_NTH_IN_MAP))
            self.local_maps += 1
            self._matched = 0
            T, covariance, is_open = np.eye(4), np.zeros((6, 6)), False
        else:
            _, T_last, T_map_last = self._last
            guess = T_last @ np.linalg.inv(T_map_last) @ sweep.T_map_lidar
            T, covariance, is_open = self._register(sweep.points, guess)
        if self._matched % EVERY_NTH_IN_MAP == 0:
            self._map.insert(sweep.points, T)
        self._matched += 1
        self._last = scan, T, sweep.T_map_lidar
        return _Match(number, scan, self.local_maps, T, covariance, is_open)

    def _register(self, points: small_gicp.PointCloud, guess: Array) -> tuple[Array, Array, bool]:
        settings = self._settings
        coarse = self._align(points, guess, settings.voxel_size_m, COARSE_M)
        found = coarse.num_inliers / points.size()
        if found < settings.min_inlier_share:
            raise _NoMatch(
                f"{found:.0%} of its points have a correspondence in the local map, expected"
                f" {settings.min_inlier_share:.0%}"
            )
        settled = self._align(points, coarse.T_target_source, SETTLED * settings.voxel_size_m, FINE_M)
        # the information comes from the coarse match: its residuals include moving objects, which makes it smaller
        T, covariance, is_open = registration.remap_solution(
            guess, registration.rigid(settled.T_target_source), coarse, points, settings
        )
        # a match in a degenerate direction may slide without harm
        if not is_open and not all(registration.has_converged(result) for result in (coarse, settled)):
            raise _NoMatch(f"the registration did not converge in {registration.MAX_ITERATIONS} iterations")
        _refuse_divergence(registration.inverse(guess) @ T, settings)
        return T, covariance, is_open

    def _align(
        self, points: small_gicp.PointCloud, guess: Array, within_m: float, step_m: float
    ) -> small_gicp.RegistrationResult:
        """Register with this correspondence distance to the means of the voxels, until a step is shorter than
        `step_m`.
        """
        return small_gicp.align(
            self._map,
            points,
            guess,
            max_correspondence_distance=within_m,
            max_iterations=registration.MAX_ITERATIONS,
            translation_epsilon=step_m,
        )


def _refuse_divergence(correction: Array, settings: ScanMatchingSettings) -> None:
    shift = float(np.linalg.norm(correction[:3, 3]))
    turn = registration.turn_deg(correction)
    if shift > settings.max_correction_m or turn > settings.max_correction_deg:
        raise _NoMatch(
            f"the registration moved {shift:.2f} m and {turn:.1f}° from its initial guess, expected at most"
            f" {settings.max_correction_m:g} m and {settings.max_correction_deg:g}°"
        )


def _pairs(matches: list[_Match], before: int) -> Iterator[tuple[_Match, _Match]]:
    """Every matched sweep with the one before and the last anchor, and an anchor with the last ANCHORS_BOUND.

    The later one is not among the first ones, the matches `before` this section. The first matched of ANCHOR_SCANS
    sweeps is an anchor. All are of one local map, and between a sweep and an anchor there is no degenerate match: there
    the local map itself may have moved.
    """
    anchors: list[_Match] = []
    for i, later in enumerate(matches):
        follows = i > 0 and matches[i - 1].local_map == later.local_map
        if later.is_open or not follows:
            anchors = []
        is_anchor = not anchors or anchors[-1].number // ANCHOR_SCANS != later.number // ANCHOR_SCANS
        bound = anchors[-ANCHORS_BOUND:] if is_anchor else anchors[-1:]
        if follows and matches[i - 1] not in bound:
            bound = [*bound, matches[i - 1]]
        if i >= before:
            yield from ((earlier, later) for earlier in bound)
        if is_anchor and not later.is_open:
            anchors.append(later)


def _relative_poses(
    pairs: list[tuple[_Match, _Match]], T_imu_lidar: Array, settings: ScanMatchingSettings
) -> RelativePoses:
    """Relative poses of the IMU from pairs of matches; covariances are the sum of both ends, plus the least
    variances.
    """
    T_lidar_imu = registration.inverse(T_imu_lidar)
    to_imu = registration.adjoint(T_imu_lidar)
    floor = np.diag(np.repeat([settings.rotation_stddev_rad**2, settings.translation_stddev_m**2], 3))
    ends = list(chain.from_iterable(pairs))
    stamps = np.array([match.scan.stamp for match in ends]).reshape(-1, 2)
    T = np.array([match.T_local_lidar for match in ends]).reshape(-1, 2, 4, 4)
    covariances = np.array([match.covariance for match in ends]).reshape(-1, 2, 6, 6)
    T_earlier_later = registration.rigid(registration.inverse(T[:, 0]) @ T[:, 1])
    back = registration.adjoint(registration.inverse(T_earlier_later))
    in_lidar = covariances[:, 1] + back @ covariances[:, 0] @ np.swapaxes(back, 1, 2)
    in_imu = to_imu @ in_lidar @ to_imu.T + floor
    return RelativePoses(
        stamps,
        registration.rigid(T_imu_lidar @ T_earlier_later @ T_lidar_imu),
        (in_imu + np.swapaxes(in_imu, 1, 2)) / 2,
    )
