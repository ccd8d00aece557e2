"""One drive: the measurements of all sensors, each with its own stamp.

Scans and images are read when they are needed; everything else is small and in memory. Measurements are joined by
stamp, or by the frame number in the file name, never by their position in a list.
"""

from __future__ import annotations

import bisect
import re
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from factor_graphs.alignment import AttitudePrior
from factor_graphs.geodesy import LocalFrame
from factor_graphs.measurements import (
    AntennaHeadings,
    GnssFixes,
    GnssVelocities,
    ImuNoise,
    ImuSamples,
    Repairs,
    WheelSpeeds,
)
from factor_graphs.settings import SampleInstant
from factor_graphs.surveyed_points import SurveyedPoints
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.errors import ConfigError, DataError
from gnss_sem_map.files.untrusted import shown
from gnss_sem_map.sensor_log.cameras import NAME, Camera, check_rigid
from gnss_sem_map.sensor_log.conventions import SensorConventions


@dataclass(frozen=True, eq=False)
class Points:
    """The returns of one sweep, in the lidar frame."""

    xyz: NDArray[np.float32]
    """(n, 3) m."""
    intensity: NDArray[np.float32]
    """(n,) in 0..1."""
    stamps: NDArray[np.float64] | None
    """(n,) s, when each point was measured; None: the file is already motion-compensated to the scan's stamp."""

    def __post_init__(self) -> None:
        n = len(self.xyz)
        if self.xyz.shape != (n, 3) or self.intensity.shape != (n,):
            raise DataError(
                f"points: found {self.xyz.shape} and {self.intensity.shape}, expected (n, 3), (n,)"
            )
        if self.stamps is not None and self.stamps.shape != (n,):
            raise DataError(f"points: found {self.stamps.shape} stamps for {n} points, expected one each")

    @cached_property
    def rows(self) -> NDArray[np.float32]:
        """(4 n,) x, y, z in m and intensity, point after point: the file's own memory where it was read like that."""
        base = self.xyz.base
        if (
            base is not None
            and base.shape == (len(self.xyz), 4)
            and base.flags.c_contiguous
            and base.ctypes.data == self.xyz.ctypes.data
        ):
            return base.reshape(-1)
        return np.column_stack([self.xyz, self.intensity]).astype(np.float32, copy=False).reshape(-1)

    def __getitem__(self, selection: NDArray[np.bool_]) -> Points:
        """The points where a boolean mask (n,) holds."""
        stamps = None if self.stamps is None else self.stamps[selection]
        return Points(self.xyz[selection], self.intensity[selection], stamps)


@dataclass(frozen=True, eq=False)
class Scan:
    """One LiDAR sweep: its name and number, its stamp, and how to read it."""

    name: str
    """File name without its ending: what the sweep's labels are named after."""
    number: int
    """Frame number, from the file name."""
    stamp: float
    """s since the log's epoch; mid sweep."""
    read: Callable[[], Points] = field(repr=False)
    """Raises DataError when the file is damaged."""
    sweep: tuple[float, float] | None = None
    """First and last moment, s, where the log says them; None: its points have times of their own, or one stamp."""


@dataclass(frozen=True, eq=False)
class Image:
    """One camera image: its number, its stamp, and how to read it."""

    number: int
    """Frame number, from the file name."""
    stamp: float
    """s since the log's epoch, as the camera reports it (see `Camera.time_offset_s`)."""
    read: Callable[[], NDArray[np.uint8]] = field(repr=False)
    """The RGB pixels, (h, w, 3); raises DataError when the file is damaged."""
    camera: str = ""
    """Name of its camera; empty where the log has but one."""

    @property
    def frame(self) -> str:
        """Its number in words, with its camera where there are several."""
        return f"{self.number} of {self.camera}" if self.camera else str(self.number)


def file_of(item: Scan | Image) -> Path | None:
    """The file that a scan or an image is read from; None where there is none.

    The first argument of its `read`, or what this one is read from: a scan that is kept when it is read.
    """
    first = item.read.args[0] if isinstance(item.read, partial) and item.read.args else None
    if isinstance(first, Scan | Image):
        return file_of(first)
    return first if isinstance(first, Path) else None


@dataclass(frozen=True, eq=False)
class Calibration:
    """Calibration: poses of the sensors, and the cameras."""

    T_imu_lidar: NDArray[np.float64]
    """(4, 4)."""
    cameras: tuple[Camera, ...] = ()
    """Several have names, all different."""
    p_imu_antenna: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    """(3,) m: the GNSS antenna in the imu frame."""

    def __post_init__(self) -> None:
        check_rigid(self.T_imu_lidar, ": T_imu_lidar")
        names = [camera.name for camera in self.cameras]
        if len(set(names)) < len(names) or (len(names) > 1 and "" in names):
            raise DataError(f"calibration: found cameras {names}, expected names, all different")

    def camera(self, name: str = "") -> Camera:
        """The camera of this name; the only one has none. Raises DataError."""
        found = next((camera for camera in self.cameras if camera.name == name), None)
        if found is None:
            there = ", ".join(camera.name for camera in self.cameras) or "none"
            raise DataError(f"calibration: found cameras {there}, expected {name or 'one without a name'}")
        return found

    @property
    def image_sizes(self) -> dict[str, tuple[int, int]]:
        """(width, height) of the images by the names of their cameras, px."""
        return {camera.name: camera.image_size for camera in self.cameras}


@dataclass(frozen=True, eq=False)
class Lidar:
    """One LiDAR of several."""

    name: str
    T_imu_lidar: NDArray[np.float64]
    """(4, 4)."""
    scans: tuple[Scan, ...]
    """Sorted by stamp."""


@dataclass(frozen=True)
class Skip:
    """Something that is missing or not usable, and was skipped."""

    what: str
    where: str
    reason: str
    frames: int = 1
    """Number of frames, rows or files."""


def skipped(what: str, where: object, noun: str, counts: Mapping[str, int]) -> list[Skip]:
    """A skip for every reason, of so many things."""
    return [Skip(what, shown(where), f"{n} {noun}: {why}", n) for why, n in counts.items()]


def repaired(where: object, *repairs: Repairs | None) -> list[Skip]:
    """A skip for every sensor of whose rows some were dropped."""
    return [Skip("samples", shown(where), str(one)) for one in repairs if one is not None and one.dropped]


SENSOR = "sensor"
"""`what` of the skip that says that a drive lacks its IMU or its receiver."""
POSE_OF_LIDAR = "pose of the LiDAR"
"""`what` of the skip that says that a drive does not give it."""


@dataclass(frozen=True, eq=False)
class SensorLog:
    """A drive: every measurement with its stamp, and the calibration that joins the sensors."""

    name: str
    epoch_ns: int
    """Unix time of stamp zero."""
    calibration: Calibration
    scans: tuple[Scan, ...]
    """Of the LiDAR that all else is relative to, sorted by stamp; `by_lidar` has those of the others."""
    images: tuple[Image, ...]
    """Of all cameras, sorted by stamp; empty for a drive without a camera."""
    frame: LocalFrame | None = None
    """Origin of the map; None when the drive has no georeference."""
    imu: ImuSamples | None = None
    gnss: GnssFixes | None = None
    velocities: GnssVelocities | None = None
    """Of the receiver; None: the log has none."""
    headings: AntennaHeadings | None = None
    """Between two antennas of the receiver; None: the log has none."""
    points: SurveyedPoints | None = None
    """Where the antenna was, by a survey; None: the log has none."""
    wheels: WheelSpeeds | None = None
    """None: the log has no wheel speed."""
    imu_noise: ImuNoise | None = None
    """None: the estimator's default."""
    imu_sample_instant: SampleInstant | None = None
    """What the stamp of an IMU sample names of its interval; None: the estimator finds it."""
    initial_attitude: AttitudePrior | None = None
    """Attitude of the navigation unit at the first IMU stamp; None: estimated from the motion."""
    attitude_of_unit: bool = False
    """Whether that is of the unit's own axes, as its samples are, and not of ours."""
    given: Trajectory | None = None
    """Poses given with the drive, or in place of its own; if present, there is no smoothing."""
    given_how: str = ""
    """From where, on which clock and in which frame they were given in place of the drive's own; empty: they are."""
    reference: Trajectory | None = None
    """Poses by the drive's own navigation system, for comparison; never used as input."""
    skips: tuple[Skip, ...] = ()
    conventions: SensorConventions | None = field(default_factory=SensorConventions)
    """Axes, units and clocks of the drive's sensors, as the drive declares them; None: all are ours."""
    lidar: str = ""
    """Name of the LiDAR of `scans`; empty where the log has but one."""
    others: tuple[Lidar, ...] = ()
    """More LiDARs."""

    def __post_init__(self) -> None:
        names = [self.lidar, *(lidar.name for lidar in self.others)]
        if (
            len(set(names)) < len(names)
            or not all(re.fullmatch(NAME, name) for name in names)
            or (self.others and "" in names)
        ):
            raise DataError(f"{self.name}: found LiDARs {names}, expected letters, digits, _, -, once")
        stamps = {"scans": [scan.stamp for scan in self.scans]}
        for lidar in self.others:
            stamps[f"scans of {lidar.name}"] = [scan.stamp for scan in lidar.scans]
        for name, found in self._image_stamps.items():
            stamps[f"images of {name}" if name else "images"] = found
        for what, some in stamps.items():
            if any(b <= a for a, b in pairwise(some)):
                raise DataError(f"{self.name}: stamps of {what} do not increase; sort them, remove repeats")

    def check_located(self) -> None:
        """Raise DataError when neither poses nor IMU with GNSS say where the vehicle was."""
        if self.given is None and (self.imu is None or self.gnss is None):
            lost = next((f"{skip.where}: {skip.reason}" for skip in self.skips if skip.what == SENSOR), None)
            raise DataError(lost or f"{self.name}: expected poses, or IMU and GNSS")

    @property
    def folders(self) -> set[Path]:
        """Folders of the files of scans and images; of a bag, which holds many of them, its files."""
        items: list[Scan | Image] = [*self.scans, *self.images]
        items += [scan for lidar in self.others for scan in lidar.scans]
        counts = Counter(map(file_of, items))
        return {file.parent if count == 1 else file for file, count in counts.items() if file is not None}

    def between(self, frames: str | None) -> SensorLog:
        """The same log with the scans A to B - 1 alone: `frames` is "A:B", "A:" or ":B". Raises ConfigError."""
        if frames is None:
            return self
        first, colon, last = frames.partition(":")
        if not colon or not all(part == "" or part.isdecimal() for part in (first, last)):
            raise ConfigError(f"frames: found {frames!r}, expected A:B with frame numbers")
        low, high = int(first or 0), int(last) if last else float("inf")
        if low >= high:
            raise ConfigError(f"frames: found {frames!r}, expected A:B with A below B")
        return self.with_scans(lambda scans: tuple(scan for scan in scans if low <= scan.number < high))

    def in_our_conventions(self, chosen: SensorConventions) -> SensorLog:
        """The same log in our axes, units and clock; chosen conventions have priority over those of the drive."""
        if self.conventions is None:
            return self
        theirs = chosen.over(self.conventions)
        offset = theirs.lidar_time_offset_s or 0.0
        attitude = self.initial_attitude
        if attitude is not None and self.attitude_of_unit:
            attitude = theirs.attitude_in_ours(attitude)
        late = (
            self.with_scans(lambda scans: tuple(_later(scan, offset) for scan in scans)) if offset else self
        )
        return replace(
            late,
            imu=None if self.imu is None else theirs.imu_in_ours(self.imu),
            gnss=None if self.gnss is None else theirs.on_our_clock(self.gnss),
            velocities=None if self.velocities is None else theirs.on_our_clock(self.velocities),
            headings=None if self.headings is None else theirs.on_our_clock(self.headings),
            points=None if self.points is None else theirs.on_our_clock(self.points),
            wheels=None if self.wheels is None else theirs.wheels_in_ours(self.wheels),
            initial_attitude=attitude,
            conventions=None,
        )

    def with_scans(self, change: Callable[[tuple[Scan, ...]], tuple[Scan, ...]]) -> SensorLog:
        """The same log with what `change` makes of the scans of each LiDAR."""
        others = tuple(replace(lidar, scans=change(lidar.scans)) for lidar in self.others)
        return replace(self, scans=change(self.scans), others=others)

    def frame_of(self, scan: Scan) -> str:
        """The number of a scan in words, with its LiDAR where there are several."""
        return f"{scan.number} of {self.lidar}" if self.lidar else str(scan.number)

    def check_scans(self) -> None:
        """Raise DataError when the LiDAR that all else is relative to has no scan: then there is nothing to map."""
        if not self.scans:
            of = f" of {self.lidar}" if self.lidar else ""
            why = next((f" ({skip.where}: {skip.reason})" for skip in self.skips if skip.what == "scan"), "")
            raise DataError(
                f"{self.name}: has no LiDAR scan{of}, or none that --frames names{why}; `trajectory` needs none"
            )

    @property
    def scan_count(self) -> int:
        """Number of the scans of all LiDARs."""
        return sum(len(log.scans) for log in self.by_lidar)

    @cached_property
    def by_lidar(self) -> tuple[SensorLog, ...]:
        """The same log once for each LiDAR, with its scans alone: this one where it has but one."""
        if not self.others:
            return (self,)
        return (replace(self, others=()), *(self._of(lidar) for lidar in self.others))

    def _of(self, lidar: Lidar) -> SensorLog:
        T_first_lidar = np.linalg.inv(self.calibration.T_imu_lidar) @ lidar.T_imu_lidar
        cameras = tuple(
            replace(camera, T_camera_lidar=camera.T_camera_lidar @ T_first_lidar)
            for camera in self.calibration.cameras
        )
        calibration = replace(self.calibration, T_imu_lidar=lidar.T_imu_lidar, cameras=cameras)
        return replace(self, lidar=lidar.name, scans=lidar.scans, calibration=calibration, others=())

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """Those that have images."""
        return tuple(camera for camera in self.calibration.cameras if camera.name in self._images_of)

    def images_of(self, camera: str = "") -> tuple[Image, ...]:
        """The images of one camera, sorted by stamp."""
        return self._images_of.get(camera, ())

    @cached_property
    def _images_of(self) -> dict[str, tuple[Image, ...]]:
        found: dict[str, list[Image]] = {}
        for image in self.images:
            found.setdefault(image.camera, []).append(image)
        return {name: tuple(images) for name, images in found.items()}

    @cached_property
    def _image_stamps(self) -> dict[str, list[float]]:
        return {name: [image.stamp for image in images] for name, images in self._images_of.items()}

    def image_at(self, stamp: float, within_s: float, camera: str = "") -> Image | None:
        """The camera's image nearest in time to `stamp`, or None when none is within `within_s` seconds."""
        images, stamps = self.images_of(camera), self._image_stamps.get(camera, [])
        after = bisect.bisect_left(stamps, stamp)
        near = [images[i] for i in (after - 1, after) if 0 <= i < len(stamps)]
        best = min(near, key=lambda image: abs(image.stamp - stamp), default=None)
        return best if best is not None and abs(best.stamp - stamp) <= within_s else None


def _later(scan: Scan, offset_s: float) -> Scan:
    sweep = None if scan.sweep is None else (scan.sweep[0] + offset_s, scan.sweep[1] + offset_s)
    return replace(scan, stamp=scan.stamp + offset_s, read=partial(_read_later, scan, offset_s), sweep=sweep)


def _read_later(scan: Scan, offset_s: float) -> Points:
    points = scan.read()
    return points if points.stamps is None else replace(points, stamps=points.stamps + offset_s)
