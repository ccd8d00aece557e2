"""How sharp poses are, as the scans tell: whether what stands is seen through."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

OFTEN_HIT = 20
"""What so many scans hit stands, or half of the scans of a shorter drive."""
STANDING_SHARE = 0.9
"""Share of what is often hit that stands for certain: the rest may move, or be leaves."""
LARGEST_MISS_SHARE = 0.03
"""With sharp poses, what stands is seen through in a smaller share of the scans."""


def are_sharp(counts: Iterable[NDArray[np.int32]], scans: int) -> bool:
    """Whether poses blur what stands so little that what scans see through is free.

    `counts` are hits and misses (2, v) of the voxels of each of so many scans. The share of misses of nine voxels of
    ten that are often hit is at most 0.014 with poses from LiDAR odometry (three simulated drives, KITTI 0005), 0.06
    with the poses of the unit of KITTI 0005, and 0.25 with GNSS and IMU alone. A drive in which nothing is often hit
    tells nothing: its poses are not taken to be sharp.
    """
    often = min(OFTEN_HIT, max(scans // 2, 1))
    share = np.concatenate([_miss_shares(of_scan, often) for of_scan in counts])
    if not len(share):
        return False
    return bool(np.quantile(share, STANDING_SHARE, overwrite_input=True) < LARGEST_MISS_SHARE)


def _miss_shares(counts: NDArray[np.int32], often: int) -> NDArray[np.float64]:
    """Shares of misses of the voxels of a scan (2, v) that are often hit."""
    hits, misses = counts
    stands = hits >= often
    return np.asarray(misses[stands] / (hits + misses)[stands], np.float64)
