"""Sharpness of the map: errors of poses, calibration or time offsets blur it, which is measured without any truth.

Points are collected in cubes of half a metre. The points of many sweeps in one cube should lie on one surface: the
standard deviation across the surface is its thickness. Sharpness measures consistency, not accuracy: a bent map can be
sharp.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from itertools import chain
from pathlib import Path

import numpy as np
from numba import njit
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from factor_graphs.errors import MeasurementError
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.errors import DataError
from gnss_sem_map.process.prefetch import prefetch
from gnss_sem_map.process.run_stats import Progress, silent
from gnss_sem_map.scans.deskew import EXTRAPOLATE_S, usable_points_in_map
from gnss_sem_map.scans.thinned_sweeps import ThinnedSweeps
from gnss_sem_map.sensor_log import Points, SensorLog
from gnss_sem_map.voxels.hash_table import HashTable, room_in, slot_of
from gnss_sem_map.voxels.voxel_map import keys_of

Array = NDArray[np.float64]
Keys = NDArray[np.int64]
Slots = NDArray[np.int32]

UPPER = np.triu_indices(3)
GROUND_NORMAL, WALL_NORMAL = 0.9, 0.3
"""A surface is ground when its normal is steeper than the first (its z), a wall when flatter than the second."""
LENGTH_STEP_S = 1.0
THINNEST_M = 1e-4
"""Below the resolution of any LiDAR: keeps the logarithm of the entropy finite."""
SCANS, LAST_SCAN, SUMS = 1, 2, 3
"""Columns of a cube's row after its key: number of sweeps with a point in it, the last of them, and ten sums (float64):
the number of points, first and second moments about the centre of the cube."""
CUBE_WORDS = SUMS + 10
SMALLEST_TABLE = 1 << 14


class SharpnessSettings(BaseModel):
    """How sharpness is measured; figures are comparable only with the same settings."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    nearest_m: float = Field(3.5, ge=0, description="Nearer returns are left out.")
    farthest_m: float = Field(50.0, gt=0, description="Farther returns are left out.")
    every_nth_point: int = Field(5, gt=0, description="Of every sweep, this part of the points is used.")
    cell_size_m: float = Field(0.5, gt=0, description="Edge of the cubes whose thickness is measured.")
    min_points: int = Field(30, ge=4, description="Cubes with fewer points do not count.")
    min_scans: int = Field(10, gt=0, description="Nor do cubes with points of fewer sweeps.")
    voxel_size_m: float = Field(0.2, gt=0, description="Edge of the voxels that are counted.")
    max_scans: int = Field(
        200, gt=0, description="A longer drive is sampled in stretches that sum up to this."
    )
    stretch_scans: int = Field(40, gt=0, description="Sweeps in a row of every stretch.")


@dataclass(frozen=True, eq=False)
class Sharpness:
    """Sharpness of a map; NaN if no cube has enough points and sweeps."""

    thickness_m: float
    """Median over the cubes of the standard deviation across the surface."""
    ground_thickness_m: float
    wall_thickness_m: float
    mean_map_entropy: float
    """Mean over the cubes of ½ ln det(2 π e covariance), nat (Droeschel, Stückler, Behnke 2014); lower is sharper."""
    voxels_per_m: float
    """Occupied voxels per metre driven; NaN where the vehicle stood."""
    voxels: int
    cells: int
    scans: int

    def as_dict(self) -> dict[str, float | int | None]:
        """The figures by name, None for NaN: JSON has no NaN."""
        return {name: value if np.isfinite(value) else None for name, value in asdict(self).items()}


def of_clouds(
    clouds: Iterable[Array], length_m: float, settings: SharpnessSettings | None = None
) -> Sharpness:
    """Sharpness of sweeps with points (n, 3) m in the map frame; `length_m` is the distance driven."""
    settings = settings or SharpnessSettings()
    stretch = _Stretch(settings)
    for p_map in clouds:
        stretch.add(_Cloud.of(p_map, settings))
    return _sharpness([stretch], length_m)


class SweepSample:
    """The sweeps of a drive with which sharpness is measured; those that were saved in `folder` are not read again."""

    def __init__(
        self, log: SensorLog, settings: SharpnessSettings | None = None, folder: Path | None = None
    ) -> None:
        self.settings = settings or SharpnessSettings()
        self.stretches = _stretches(len(log.scans), self.settings)
        numbers = frozenset(chain.from_iterable(self.stretches))
        self.sweeps = ThinnedSweeps(log, "sharpness", self._thinned, numbers, folder)

    def _thinned(self, points: Points) -> Points:
        every = self.settings.every_nth_point
        rows = points.rows.reshape(-1, 4)[::every].copy()
        stamps = None if points.stamps is None else points.stamps[::every].copy()
        return Points(rows[:, :3], rows[:, 3], stamps)


def of_drive(
    log: SensorLog,
    trajectories: Sequence[Trajectory],
    settings: SharpnessSettings | None = None,
    progress: Progress = silent,
) -> list[Sharpness]:
    """Sharpness of one drive by each of several trajectories; see `of_sample`."""
    return of_sample(SweepSample(log, settings), trajectories, progress)


def of_sample(
    sample: SweepSample, trajectories: Sequence[Trajectory], progress: Progress = silent
) -> list[Sharpness]:
    """Sharpness of a drive by each of several trajectories; a sweep that was not saved is read once.

    Sweeps that cannot be read, or that are outside of a trajectory, are left out for all of them. Moving objects are
    included: they blur the map in the same way for every trajectory.
    """
    gathered = [[_Stretch(sample.settings) for _ in sample.stretches] for _ in trajectories]
    stamps: list[list[float]] = [[] for _ in sample.stretches]
    numbered = [(n, number) for n, stretch in enumerate(sample.stretches) for number in stretch]

    def clouds_of(of_stretch: tuple[int, int]) -> list[_Cloud] | None:
        return _clouds(of_stretch[1], sample, trajectories)

    for done, ((n, number), clouds) in enumerate(prefetch(clouds_of, numbered), 1):
        if clouds is not None:
            stamps[n].append(sample.sweeps.log.scans[number].stamp)
            for of_one, cloud in zip(gathered, clouds, strict=True):
                of_one[n].add(cloud)
        progress("sharpness", done, len(numbered))
    lengths = [sum(_length(t, np.array(s)) for s in stamps) for t in trajectories]
    return [_sharpness(of_one, length) for of_one, length in zip(gathered, lengths, strict=True)]


def _stretches(scans: int, settings: SharpnessSettings) -> list[range]:
    """The whole drive, or sections of consecutive sweeps spread evenly over it."""
    if scans <= settings.max_scans:
        return [range(scans)] if scans else []
    count = max(1, settings.max_scans // settings.stretch_scans)
    starts = np.linspace(0, scans - settings.stretch_scans, count).astype(int)
    return [range(start, min(start + settings.stretch_scans, scans)) for start in starts.tolist()]


def _clouds(number: int, sample: SweepSample, trajectories: Sequence[Trajectory]) -> list[_Cloud] | None:
    """A sweep in the map by each trajectory; None if it cannot be read, or is outside of a trajectory or the map."""
    settings, log = sample.settings, sample.sweeps.log
    stamp, T_imu_lidar = log.scans[number].stamp, log.calibration.T_imu_lidar
    nearest_m, farthest_m = settings.nearest_m, settings.farthest_m
    try:
        points = sample.sweeps[number]
        placed = [
            usable_points_in_map(points, stamp, t, T_imu_lidar, nearest_m, farthest_m)[0]
            for t in trajectories
        ]
        return [_Cloud.of(p_map, settings) for p_map in placed]
    except (DataError, MeasurementError):
        return None  # counted when the map is built


def _length(trajectory: Trajectory, stamps: Array) -> float:
    if len(stamps) < 2:
        return 0.0
    # so far apart, jitter does not count as distance
    every = max(1, round(LENGTH_STEP_S / float(np.median(np.diff(stamps)))))
    positions = trajectory.at(np.append(stamps[:-1:every], stamps[-1]), EXTRAPOLATE_S)[:, :3, 3]
    return float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())


@dataclass(frozen=True, eq=False)
class _Cloud:
    """The points (n, 3) m of a sweep in the map, with the keys of their cubes and voxels."""

    p_map: Array
    cubes: Keys
    voxels: Keys

    @classmethod
    def of(cls, p_map: Array, settings: SharpnessSettings) -> _Cloud:
        """Raises DataError for a point that is not inside the map."""
        return cls(p_map, keys_of(p_map, settings.cell_size_m), keys_of(p_map, settings.voxel_size_m))


class _Stretch:
    """Points of consecutive sweeps, as sums per cube and as occupied voxels; memory grows with the mapped area only."""

    def __init__(self, settings: SharpnessSettings) -> None:
        self.scans = 0
        self._settings = settings
        self._cubes, self._voxels = HashTable(CUBE_WORDS, SMALLEST_TABLE), HashTable(1, SMALLEST_TABLE)

    @property
    def voxels(self) -> int:
        """How many are occupied."""
        return self._voxels.count

    def add(self, cloud: _Cloud) -> None:
        """Add one sweep."""
        self.scans += 1
        done = 0
        while done < len(cloud.cubes):
            cubes = self._cubes
            cubes.count, done = _gather(
                cubes.rows, cubes.rows.view(np.float64), cubes.slots, cubes.count, done, cloud.cubes, cloud.p_map,
                self._settings.cell_size_m, self.scans,
            )  # fmt: skip
            if done < len(cloud.cubes):
                cubes.grow()
        done = 0
        while done < len(cloud.voxels):
            voxels = self._voxels
            voxels.count, done = _occupy(voxels.rows, voxels.slots, voxels.count, done, cloud.voxels)
            if done < len(cloud.voxels):
                voxels.grow()

    def surfaces(self) -> tuple[Array, Array]:
        """Variances (c, 3), ascending, of cubes with enough points and sweeps, and |z| of their normals (c,)."""
        cubes = self._cubes.filled
        seen = cubes[:, SCANS] >= self._settings.min_scans
        sums = cubes.view(np.float64)[seen, SUMS:]
        sums = sums[sums[:, 0] >= self._settings.min_points]
        mean = sums[:, 1:4] / sums[:, :1]
        covariances = np.empty((len(sums), 3, 3))
        i, j = UPPER
        covariances[:, i, j] = covariances[:, j, i] = sums[:, 4:] / sums[:, :1] - mean[:, i] * mean[:, j]
        variances, axes = np.linalg.eigh(covariances)
        return np.maximum(variances, THINNEST_M**2), np.abs(axes[:, 2, 0])


@njit(cache=True, nogil=True)
def _gather(
    rows: Keys,
    sums: Array,
    slots: Slots,
    count: int,
    start: int,
    keys: Keys,
    p_map: Array,
    size_m: float,
    scan: int,
) -> tuple[int, int]:
    """Add points from `start` on to their cubes, with moments about the cube's centre, until the table is full.

    `sums` are the rows of the table read as float64. Returns how many cubes there are, and the first point not added.
    """
    room, names, size = room_in(rows, slots), rows[:, 0], len(slots)
    for i in range(start, len(keys)):
        if count == room:
            return count, i
        slot = slot_of(keys[i], names, slots, size)
        if slots[slot] < 0:
            slots[slot], names[count] = count, keys[i]
            count += 1
        row = slots[slot]
        if rows[row, LAST_SCAN] != scan:
            rows[row, LAST_SCAN] = scan
            rows[row, SCANS] += 1
        x, y, z = p_map[i, 0] / size_m, p_map[i, 1] / size_m, p_map[i, 2] / size_m
        x, y, z = (
            (x - np.floor(x) - 0.5) * size_m,
            (y - np.floor(y) - 0.5) * size_m,
            (z - np.floor(z) - 0.5) * size_m,
        )
        here = sums[row, SUMS:]
        here[0] += 1.0
        here[1] += x
        here[2] += y
        here[3] += z
        here[4] += x * x
        here[5] += x * y
        here[6] += x * z
        here[7] += y * y
        here[8] += y * z
        here[9] += z * z
    return count, len(keys)


@njit(cache=True, nogil=True)
def _occupy(rows: Keys, slots: Slots, count: int, start: int, keys: Keys) -> tuple[int, int]:
    """Add keys from `start` on, until the table is full; returns how many there are, and the first not added."""
    room, names, size = room_in(rows, slots), rows[:, 0], len(slots)
    for i in range(start, len(keys)):
        if count == room:
            return count, i
        slot = slot_of(keys[i], names, slots, size)
        if slots[slot] < 0:
            slots[slot], names[count] = count, keys[i]
            count += 1
    return count, len(keys)


def _sharpness(stretches: list[_Stretch], length_m: float) -> Sharpness:
    surfaces = [stretch.surfaces() for stretch in stretches]
    variances = np.concatenate([np.empty((0, 3)), *(variances for variances, _ in surfaces)])
    steepness = np.concatenate([np.empty(0), *(steepness for _, steepness in surfaces)])
    voxels = sum(stretch.voxels for stretch in stretches)
    thickness = np.sqrt(variances[:, 0])
    entropies = 0.5 * (3 * math.log(2 * math.pi * math.e) + np.log(variances).sum(axis=1))
    return Sharpness(
        thickness_m=_median(thickness),
        ground_thickness_m=_median(thickness[steepness > GROUND_NORMAL]),
        wall_thickness_m=_median(thickness[steepness < WALL_NORMAL]),
        mean_map_entropy=float(entropies.mean()) if len(entropies) else float("nan"),
        voxels_per_m=voxels / length_m if length_m > 1.0 else float("nan"),
        voxels=voxels,
        cells=len(thickness),
        scans=sum(stretch.scans for stretch in stretches),
    )


def _median(values: Array) -> float:
    return float(np.median(values)) if len(values) else float("nan")
