"""How sharp the map is: bad poses, calibration or time offsets show as blur, and need no truth to be seen.

Points are gathered in cubes of half a metre. Where many sweeps saw the same cube, its points should lie on one
surface: the standard deviation across the surface is its thickness. Sharpness is consistency, not accuracy: a bent
map can be sharp.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from factor_graphs.errors import MeasurementError
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.account import Progress, silent
from gnss_sem_map.deskew import EXTRAPOLATE_S, points_in_map
from gnss_sem_map.errors import DataError
from gnss_sem_map.sensor_log import Points, Scan, SensorLog
from gnss_sem_map.voxel_map import keys_of

Array = NDArray[np.float64]

UPPER = np.triu_indices(3)
GROUND_NORMAL, WALL_NORMAL = 0.9, 0.3
"""A surface is ground when its normal is steeper than the first (its z), a wall when flatter than the second."""
LENGTH_STEP_S = 1.0
THINNEST_M = 1e-4
"""No LiDAR measures finer: keeps the logarithm of the entropy finite."""


class SharpnessSettings(BaseModel):
    """How sharpness is measured; figures are comparable only with the same settings."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    nearest_m: float = Field(3.5, ge=0, description="Nearer returns are left out.")
    farthest_m: float = Field(50.0, gt=0, description="Farther returns are left out.")
    every_nth_point: int = Field(3, gt=0, description="Of every sweep, this part of the points is used.")
    cell_size_m: float = Field(0.5, gt=0, description="Edge of the cubes whose thickness is measured.")
    min_points: int = Field(30, ge=4, description="Cubes with fewer points do not count.")
    min_scans: int = Field(10, gt=0, description="Nor do those that fewer sweeps saw.")
    voxel_size_m: float = Field(0.2, gt=0, description="Edge of the voxels that are counted.")
    max_scans: int = Field(
        400, gt=0, description="A longer drive is sampled in stretches that sum up to this."
    )
    stretch_scans: int = Field(40, gt=0, description="Sweeps in a row of every stretch.")


@dataclass(frozen=True, eq=False)
class Sharpness:
    """How sharp a map is; NaN where no cube was seen often enough."""

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
    """Sharpness of sweeps whose points (n, 3) are in the map; `length_m` is how far the vehicle drove."""
    settings = settings or SharpnessSettings()
    blocks = [_block(p_map, settings) for p_map in clouds]
    return _merge([blocks], length_m, settings)


def of_drive(
    log: SensorLog,
    trajectories: Sequence[Trajectory],
    settings: SharpnessSettings | None = None,
    progress: Progress = silent,
) -> list[Sharpness]:
    """Sharpness of one drive by each of several trajectories; every sweep is read once.

    Sweeps that cannot be read, or that leave a trajectory, are left out for all of them. What moves is not taken
    out: it blurs alike for every trajectory.
    """
    settings = settings or SharpnessSettings()
    stretches: list[list[list[_Block]]] = []
    lengths = np.zeros(len(trajectories))
    chosen = _stretches(log.scans, settings)
    total, done = sum(len(stretch) for stretch in chosen), 0
    for stretch in chosen:
        seen: list[tuple[float, list[_Block]]] = []
        for scan in stretch:
            done += 1
            progress("sharpness", done, total)
            try:
                points = _in_range(scan.read(), settings)
                clouds = [
                    points_in_map(points, scan.stamp, t, log.calibration.T_imu_lidar) for t in trajectories
                ]
                seen.append((scan.stamp, [_block(p_map, settings) for p_map in clouds]))
            except (DataError, MeasurementError):
                continue  # counted when the map is built
        stamps = np.array([stamp for stamp, _ in seen])
        lengths += [_length(t, stamps) for t in trajectories]
        stretches.append([blocks for _, blocks in seen])
    return [
        _merge([[blocks[k] for blocks in stretch] for stretch in stretches], float(lengths[k]), settings)
        for k in range(len(trajectories))
    ]


def _stretches(scans: tuple[Scan, ...], settings: SharpnessSettings) -> list[tuple[Scan, ...]]:
    """The whole drive, or stretches of neighbouring sweeps spread evenly over it."""
    if len(scans) <= settings.max_scans:
        return [scans] if scans else []
    count = max(1, settings.max_scans // settings.stretch_scans)
    starts = np.linspace(0, len(scans) - settings.stretch_scans, count).astype(int)
    return [scans[start : start + settings.stretch_scans] for start in starts.tolist()]


def _in_range(points: Points, settings: SharpnessSettings) -> Points:
    ranges = np.sqrt(np.einsum("ij,ij->i", points.xyz, points.xyz))
    use = (ranges >= settings.nearest_m) & (ranges <= settings.farthest_m)  # False for NaN
    use[np.arange(len(use)) % settings.every_nth_point > 0] = False
    return points[use]


def _length(trajectory: Trajectory, stamps: Array) -> float:
    if len(stamps) < 2:
        return 0.0
    every = max(1, round(LENGTH_STEP_S / float(np.median(np.diff(stamps)))))  # jitter is no way driven
    positions = trajectory.at(np.append(stamps[:-1:every], stamps[-1]), EXTRAPOLATE_S)[:, :3, 3]
    return float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())


@dataclass(frozen=True, eq=False)
class _Block:
    """One sweep as sums per cube; they add up over sweeps."""

    keys: NDArray[np.int64]
    sums: Array
    """(c, 10): number of points, first and second moments about the cube's middle."""
    voxels: NDArray[np.int64]


def _block(p_map: Array, settings: SharpnessSettings) -> _Block:
    keys, place = np.unique(keys_of(p_map, settings.cell_size_m), return_inverse=True)
    from_middle = p_map - (np.floor(p_map / settings.cell_size_m) + 0.5) * settings.cell_size_m
    columns = np.column_stack(
        [
            np.ones(len(p_map)),
            from_middle,
            *(from_middle[:, i] * from_middle[:, j] for i, j in zip(*UPPER, strict=True)),
        ]
    )
    return _Block(keys, _sum_by(place, columns, len(keys)), np.unique(keys_of(p_map, settings.voxel_size_m)))


def _sum_by(place: NDArray[np.intp], columns: Array, n: int) -> Array:
    return np.column_stack([np.bincount(place, column, n) for column in columns.T])


def _merge(stretches: list[list[_Block]], length_m: float, settings: SharpnessSettings) -> Sharpness:
    scans = sum(len(stretch) for stretch in stretches)
    parts = [_surfaces(stretch, settings) for stretch in stretches if stretch]
    variances = np.concatenate([np.empty((0, 3)), *(part[0] for part in parts)])
    steepness = np.concatenate([np.empty(0), *(part[1] for part in parts)])
    voxels = sum(
        len(np.unique(np.concatenate([b.voxels for b in stretch]))) for stretch in stretches if stretch
    )
    thickness = np.sqrt(variances[:, 0])
    entropies = 0.5 * (3 * np.log(2 * np.pi * np.e) + np.log(variances).sum(axis=1))
    return Sharpness(
        thickness_m=_median(thickness),
        ground_thickness_m=_median(thickness[steepness > GROUND_NORMAL]),
        wall_thickness_m=_median(thickness[steepness < WALL_NORMAL]),
        mean_map_entropy=float(entropies.mean()) if len(entropies) else float("nan"),
        voxels_per_m=voxels / length_m if length_m > 1.0 else float("nan"),
        voxels=voxels,
        cells=len(thickness),
        scans=scans,
    )


def _surfaces(stretch: list[_Block], settings: SharpnessSettings) -> tuple[Array, Array]:
    """Variances (c, 3), smallest first, of the cubes seen often enough, and the |z| of their normals (c,)."""
    keys, place, seen = np.unique(
        np.concatenate([block.keys for block in stretch]), return_inverse=True, return_counts=True
    )
    sums = _sum_by(place, np.concatenate([block.sums for block in stretch]), len(keys))
    sums = sums[(sums[:, 0] >= settings.min_points) & (seen >= settings.min_scans)]
    mean = sums[:, 1:4] / sums[:, :1]
    covariances = np.empty((len(sums), 3, 3))
    i, j = UPPER
    covariances[:, i, j] = covariances[:, j, i] = sums[:, 4:] / sums[:, :1] - mean[:, i] * mean[:, j]
    variances, axes = np.linalg.eigh(covariances)
    return np.maximum(variances, THINNEST_M**2), np.abs(axes[:, 2, 0])


def _median(values: Array) -> float:
    return float(np.median(values)) if len(values) else float("nan")
