"""Movers that are seen in part: what something nearer hides above or below may be far more than what is seen.

A lorry behind a gap between parked cars is a patch that stays in the gap while the lorry passes. The place and the
speed of such a segment are known less (`object_track`).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.dynamics.clusters import Segments
from gnss_sem_map.dynamics.range_images import hidden_above_or_below
from gnss_sem_map.dynamics.tracking import Segment
from gnss_sem_map.dynamics.visibility import RangeImage

HIDING_M = 0.5
"""Something nearer by this hides a part of an object."""


def with_cover(
    listed: Sequence[Segment],
    segments: Sequence[Segments],
    images: Sequence[RangeImage],
    moved: Iterable[NDArray[np.bool_]],
) -> list[Segment]:
    """The segments of all scans, of which those are marked that moved and that something nearer hides in part.

    `segments`, `images` and which voxels `moved` (v,) are those of each scan. What stands is not asked.
    """
    hidden = [_covered(*of_scan) for of_scan in zip(segments, images, moved, strict=True)]
    pairs = zip(listed, np.concatenate(hidden), strict=True)
    return [replace(one, is_covered=True) if covered else one for one, covered in pairs]


def _covered(segments: Segments, seen: RangeImage, moved: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which segments (s,) of a scan are hidden in part, by their voxels (v,) that moved."""
    voxels, rows = np.flatnonzero(moved), seen.rows
    means = segments.parts.sums[voxels] / segments.parts.points[voxels, None]
    hidden: NDArray[np.bool_] = hidden_above_or_below(
        means, segments.number[voxels], seen.T_lidar_map, rows.of_return, rows.elevations_rad, seen.image,
        len(segments.truncated), HIDING_M,
    )  # fmt: skip
    return hidden
