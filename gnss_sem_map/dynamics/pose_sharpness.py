"""How sharp poses are, as the scans tell: whether what stands is seen through."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

OFTEN_HIT = 20
"""What so many scans hit stands, or half of the scans of a shorter drive."""
STANDING_SHARE = 0.9
"""Share of what is often hit that stands for certain: the rest may move, or be leaves."""
LARGEST_MISS_SHARE = 0.03
"""With sharp poses, what stands is seen through in a smaller share of the scans."""
STANDING_SEGMENTS, USUAL_MISS_SHARE = 0.6, 0.0065
"""So many segments are seen through in a smaller share: in a jam far more than a tenth of what is often hit
moves."""


def are_sharp(counts: NDArray[np.int32], places: Sequence[NDArray[np.int32]]) -> bool:
    """Whether poses blur what stands so little that what scans see through is free.

    `counts` are hits and misses (2, v) of voxels, `places` the rows of those that each scan has, all different. The
    share of misses of nine voxels of ten that are often hit is at most 0.014 with poses from LiDAR odometry (three
    simulated drives, KITTI 0005), 0.06 with the poses of the unit of KITTI 0005, and 0.25 with GNSS and IMU alone. A
    drive in which nothing is often hit tells nothing: its poses are not taken to be sharp.
    """
    hits, misses = counts
    scans = np.zeros(len(hits), np.intp)
    for place in places:
        scans[place] += 1
    stands = hits >= min(OFTEN_HIT, max(len(places) // 2, 1))
    share = np.repeat(misses[stands] / (hits + misses)[stands], scans[stands])
    if not len(share):
        return False
    return bool(np.quantile(share, STANDING_SHARE, overwrite_input=True) < LARGEST_MISS_SHARE)


def stand_still(counts: NDArray[np.float64]) -> bool:
    """Whether most segments are hardly ever seen through; `counts` are hits and misses (2, s) of them.

    The quantile is at most 0.0055 with poses from LiDAR odometry (four drives in jams, a usual one, KITTI 0005), at
    least 0.0074 with errors of 2 cm and 0.1 degrees, and 0.029 with the poses of the unit of KITTI 0005.
    """
    hits, misses = counts
    seen = hits + misses > 0
    share = misses[seen] / (hits + misses)[seen]
    return bool(seen.any() and np.quantile(share, STANDING_SEGMENTS) < USUAL_MISS_SHARE)
