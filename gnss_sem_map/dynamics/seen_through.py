"""Objects that other scans see through: a person close to a wall is one cluster with it, but only the wall stands.

What stands is hit by the scans that look at it; the place of somebody who walks past is free in all scans but a few.
So evidence tells the two apart, voxel by voxel, where distance does not. Single returns from glass and edges are free
by their counts, too, but low: what is as high as an object, and free, moved.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.dynamics.clusters import Segments, boxes_of, cluster

LEAST_MISSES, MISSES_PER_HIT = 3, 1.0
"""A voxel is free if at least so many scans saw through it, and more than so many per scan that hit it."""
LEAST_HEIGHT_M = 0.4
"""Free voxels moved if the lowest and the highest of them are so far apart,"""
CERTAIN_MISSES_PER_HIT = 5.0
"""or if all together have more misses per hit than this: what is far away returns one ring or two. Of two simulated
drives, 2 in 100,000 standing points are free by that, and 93 of 100 of people."""
PERSON_M, CYCLIST_M, LENGTH_PER_HEIGHT = 1.2, 2.3, 1.5
"""In an object, only a person or a cyclist is told from the rest, by length and height,"""
PERSON_MISSES_PER_HIT = 2.0
"""and only with more misses per hit than this: through the windows of a car, some views show what is behind it."""


def free_groups(
    segments: Segments, hits: NDArray[np.int32], misses: NDArray[np.int32], eps_m: float
) -> NDArray[np.int32]:
    """For every voxel (v,) the group of free voxels that moved, -1 for none; voxels nearer than `eps_m` are of a group.

    `hits` and `misses` (v,) count the scans that hit each voxel and that saw through it. Needs sharp poses.
    """
    groups = np.full(len(segments.keys), -1, np.int32)
    free = np.flatnonzero((misses >= LEAST_MISSES) & (misses > MISSES_PER_HIT * hits))
    if not len(free):
        return groups
    group, points = cluster(segments.keys[free], eps_m), segments.parts.points[free]
    lowest, highest = boxes_of(segments.parts.sums[free] / points[:, None], group, group.max() + 1)
    size = highest - lowest
    hit, missed = (np.bincount(group, points * counts[free]) for counts in (hits, misses))
    moved = (size[:, 2] > LEAST_HEIGHT_M) | (missed > CERTAIN_MISSES_PER_HIT * hit)
    longest = np.maximum(PERSON_M, np.minimum(LENGTH_PER_HEIGHT * size[:, 2], CYCLIST_M))
    is_person = (np.hypot(size[:, 0], size[:, 1]) < longest) & (missed > PERSON_MISSES_PER_HIT * hit)
    moved = moved[group] & ((segments.number[free] < 0) | is_person[group])
    groups[free[moved]] = group[moved]
    return groups


def with_free_groups(segments: Segments, groups: NDArray[np.int32]) -> Segments:
    """The segments, and the groups (v,) of free voxels that are in none."""
    loose = np.flatnonzero((groups >= 0) & (segments.number < 0))
    if not len(loose):
        return segments
    used, part = np.unique(groups[loose], return_inverse=True)
    number = segments.number.copy()
    number[loose] = part + len(segments.truncated)
    truncated = np.concatenate([segments.truncated, np.zeros(len(used), np.bool_)])
    return replace(segments, number=number, truncated=truncated)
