"""A trajectory on disk in short: its length, and a few hundred poses of it with their standard deviations."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from factor_graphs.trajectory import Trajectory

MOST_POSES = 400
SHARE_95 = 1.96
"""Standard deviations on both sides that hold 95 % of a normal distribution."""
SHARE_95_PLANE = 2.45
"""The same for a distance in the plane: the square root of chi-squared with two degrees of freedom at 95 %."""


@dataclass(frozen=True, eq=False)
class Track:
    """Where a drive was mapped."""

    length_m: float
    stamps: NDArray[np.float64]
    """(k,) s, of the poses that are kept."""
    positions: NDArray[np.float64]
    """(k, 3) m, east, north, up."""
    horizontal_95_m: NDArray[np.float64] | None
    """(k,) radius that holds 95 % by the claimed covariance (its larger horizontal axis); None without."""
    vertical_95_m: NDArray[np.float64] | None


def read_track(path: Path, scans_s: tuple[float, float] | None = None) -> Track:
    """Read a `trajectory.parquet`, the part with scans if it is known; raises MeasurementError."""
    trajectory = Trajectory.load(path)
    if scans_s is not None:
        trajectory = trajectory.during(*scans_s)
    steps = np.linalg.norm(np.diff(trajectory.positions, axis=0), axis=1)
    kept = trajectory[np.unique(np.linspace(0, len(trajectory) - 1, MOST_POSES).astype(np.intp))]
    horizontal = vertical = None
    if kept.covariances is not None:
        covariances = kept.position_covariances
        largest = np.linalg.eigvalsh(covariances[:, :2, :2])[:, -1]
        horizontal, vertical = (
            SHARE_95_PLANE * np.sqrt(largest.clip(0)),
            SHARE_95 * np.sqrt(covariances[:, 2, 2].clip(0)),
        )
    return Track(
        float(steps.sum()),
        kept.stamps,
        kept.positions,
        horizontal,
        vertical,
    )
