"""How honest the covariances of bound drives are: many draws of simulated sensors, exact places, no LiDAR.

Two drives along one track see it with different errors of the same kind of unit (`gnss_sem_map.simulation.oxts`). The
errors of two drives that are bound are nearly one shift, so every draw counts once: a hundred draws tell a share of
0.9 to 0.03.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from factor_graphs.alignment import AttitudePrior
from factor_graphs.chi_square import quantile
from factor_graphs.condensing import CondensedDrive
from factor_graphs.geodesy import LocalFrame
from factor_graphs.measurements import GnssFixes, ImuSamples
from factor_graphs.relative_poses import RelativePoses
from factor_graphs.sessions import AnchorPairs, bind
from factor_graphs.simulation import Motion, random_drive
from factor_graphs.smoothing import Solution, smooth
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.config import Settings
from gnss_sem_map.datasets.kitti_oxts import ATTITUDE_STDDEVS_RAD, OXTS_NOISE
from gnss_sem_map.simulation.oxts import COLUMNS, Gnss, oxts_rows

Array = NDArray[np.float64]

FRAME = LocalFrame(49.0131, 8.4044, 115.0)
SECONDS = 30.0
# Of the poses of sweeps to each other, and of places that are passed again: rad, m.
STDDEVS = np.repeat([5e-4, 5e-3], 3)
# A place every so many anchors.
EVERY_NTH = 3


def coverage(gnss: Gnss, draws: int) -> dict[str, Any]:
    """Share of positions inside their 90 % ellipsoids, and squared errors over the variances claimed, with errors."""
    rows = [_draw(gnss, seed) for seed in range(draws)]
    found: dict[str, Any] = {"draws": draws}
    for name, column in (("alone", 0), ("bound", 1)):
        inside, squares = np.array([row[column] for row in rows]).T
        found[f"covered_{name}"] = float(inside.mean())
        found[f"covered_{name}_stderr"] = float(inside.std(ddof=1) / np.sqrt(draws))
        found[f"squares_{name}"] = float(squares.mean())
    return found


def _draw(gnss: Gnss, seed: int) -> tuple[tuple[float, float], tuple[float, float]]:
    """Two drives alone, and bound: the share of positions inside, and the mean squared whitened error of an axis."""
    rng = np.random.default_rng([seed, 22])
    motion = random_drive(SECONDS, rng)
    days = [_located(motion, gnss, rng) for _ in range(2)]
    drives = [_condensed(day) for day in days]
    bound = bind(drives, _places(motion, drives, rng))
    tracks = [correction.of(day.trajectory) for correction, day in zip(bound.corrections, days, strict=True)]
    alone, together = (
        np.concatenate([_squares(track, motion) for track in of_days])
        for of_days in ([day.trajectory for day in days], tracks)
    )
    inside = quantile(0.9, 3)
    return (
        (float(np.mean(alone < inside)), float(alone.mean() / 3)),
        (float(np.mean(together < inside)), float(together.mean() / 3)),
    )


def _located(motion: Motion, gnss: Gnss, rng: np.random.Generator) -> Solution:
    """A drive as a navigation unit and a LiDAR see it."""
    stamps = np.arange(0.0, SECONDS, 0.01)
    rows = dict(zip(COLUMNS, oxts_rows(motion, stamps, FRAME, rng, gnss).T, strict=True))
    imu = ImuSamples(
        stamps,
        np.column_stack([rows[name] for name in ("ax", "ay", "az")]),
        np.column_stack([rows[name] for name in ("wx", "wy", "wz")]),
    )
    tenth = slice(2, -10, 10)
    positions = FRAME.to_map(*(rows[name][tenth] for name in ("lat", "lon", "alt")))
    claimed = np.repeat(rows["pos_accuracy"][tenth, None], 3, axis=1)
    attitude = Rotation.from_euler("ZYX", [rows[name][0] for name in ("yaw", "pitch", "roll")]).as_matrix()
    sweeps = _sweeps(motion, np.arange(0.05, SECONDS - 0.1, 0.1), rng)
    settings = Settings().trajectory.model_copy(update={"imu_noise": OXTS_NOISE})
    prior = AttitudePrior(attitude, ATTITUDE_STDDEVS_RAD)
    fixes = GnssFixes(stamps[tenth], positions, claimed)
    return smooth(imu, fixes, FRAME, settings, np.zeros(3), prior, sweeps, condensed=True)


def _sweeps(motion: Motion, stamps: Array, rng: np.random.Generator) -> RelativePoses:
    """Each bound to the one before and to the last of ten."""
    later = np.arange(1, len(stamps))
    pairs = np.concatenate(
        [np.column_stack([before, later]) for before in (later - 1, (later - 1) // 10 * 10)]
    )
    pairs = np.unique(pairs, axis=0)
    T = motion.poses(stamps)
    between = np.linalg.inv(T[pairs[:, 0]]) @ T[pairs[:, 1]] @ _noise(len(pairs), rng)
    return RelativePoses(stamps[pairs], between, np.tile(np.diag(STDDEVS**2), (len(pairs), 1, 1)))


def _places(motion: Motion, drives: Sequence[CondensedDrive], rng: np.random.Generator) -> AnchorPairs:
    """Registrations of the second drive to the first, as good as they say."""
    first, second = (drive.stamps for drive in drives)
    later = np.arange(1, len(second) - 1, EVERY_NTH)
    earlier = np.abs(first[:, None] - second[later]).argmin(axis=0)
    T = np.linalg.inv(motion.poses(first[earlier])) @ motion.poses(second[later]) @ _noise(len(later), rng)
    covariances = np.tile(np.diag(STDDEVS**2), (len(later), 1, 1))
    return AnchorPairs(np.tile([0, 1], (len(later), 1)), np.column_stack([earlier, later]), T, covariances)


def _noise(count: int, rng: np.random.Generator) -> Array:
    tangents = STDDEVS * rng.standard_normal((count, 6))
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(tangents[:, :3]).as_matrix()
    T[:, :3, 3] = tangents[:, 3:]
    return T


def _condensed(solution: Solution) -> CondensedDrive:
    assert solution.condensed is not None
    return solution.condensed


def _squares(track: Trajectory, motion: Motion) -> Array:
    """Squared whitened errors of positions twice a second: chi2 of 3 dof where covariances are honest."""
    some = track[np.arange(50, len(track) - 50, 50)]
    assert some.covariances is not None
    off, R = some.positions - motion.poses(some.stamps)[:, :3, 3], some.T_map_imu[:, :3, :3]
    covariances = R @ some.covariances[:, 3:, 3:] @ np.swapaxes(R, 1, 2)
    found: Array = np.einsum("ki,ki->k", off, np.linalg.solve(covariances, off[..., None])[..., 0])
    return found
