"""Free-space evidence: how many keyframe scans hit a position, and how many saw through it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.dynamics import range_images
from gnss_sem_map.dynamics.image_rows import Rows
from gnss_sem_map.process.machine import threads
from gnss_sem_map.process.prefetch import prefetch
from gnss_sem_map.scans.own_vehicle import returns_of
from gnss_sem_map.voxels.voxel_map import limits_of

THREADS = min(threads(), 4)
"""More threads would wait for the one that reads, each with two scans in memory."""
POINTS_PER_BLOCK = 1 << 14
"""Positions that one thread works on at a time."""
CUBE_M = 3.2
"""Edge of the cubes of neighbours: they hide together behind what is nearer."""
APART_M, APART_S = 2.0, 2.0
"""Distance and time between keyframe scans, whichever comes first: the scans take no more memory than the map."""
NEAREST_M = 3.0
"""A scan nearer to a position than this is no evidence: the vehicle itself is in the way."""
SCANS_PER_PART = 64
"""Scans of a part: 8 MB of range images."""
MARGIN_M = 0.3
"""A range within this, plus a share of the range, of a position is a hit: noise of ranges and poses."""
SHARP_RATIO = 0.005
"""That share of a place on a surface, with sharp poses. A larger one takes a wall for the walker in front of it."""
WIDE_RATIO = 0.01
"""That share with poses that blur what stands, and of the centre of a voxel, which a grazing ray passes."""

ASKED_M, BEFORE, ASKED_EVERY = (5.0, 40.0), 0.8, 16
"""A scan is asked about the places at this share of the range of some of its returns: those in a range of so many m."""


@dataclass(frozen=True, eq=False)
class RangeImage:
    """Range image and pose of one scan."""

    image: NDArray[np.uint16]
    """(h, w) cm."""
    T_lidar_map: NDArray[np.float64]
    """(4, 4)."""
    rows: Rows

    @classmethod
    def of(cls, p_map: NDArray[np.float64], T_map_lidar: NDArray[np.float64], rows: Rows) -> RangeImage:
        """The range image of the points (n, 3) m of a scan, seen from its pose (4, 4)."""
        seen = cls(range_images.empty_image(rows), np.asarray(np.linalg.inv(T_map_lidar), np.float64), rows)
        range_images.draw(p_map, seen.T_lidar_map, rows.of_return, seen.image)
        return seen


@dataclass(frozen=True, eq=False)
class KeyframeScans:
    """Range images and poses of scans, for free-space evidence."""

    images: NDArray[np.uint16]
    """(k, h, w) cm: range images."""
    T_lidar_map: NDArray[np.float64]
    """(k, 4, 4): poses."""
    rows: Rows
    """Of all images."""

    @classmethod
    def of(cls, scans: Sequence[RangeImage]) -> KeyframeScans:
        """Range images of one LiDAR with their poses, at least one."""
        images = np.stack([one.image for one in scans])
        return cls(images, np.stack([one.T_lidar_map for one in scans]), scans[0].rows)

    def __len__(self) -> int:
        return len(self.images)

    def parts(self) -> Iterator[KeyframeScans]:
        """The scans, some at a time."""
        for start in range(0, len(self), SCANS_PER_PART):
            part = slice(start, start + SCANS_PER_PART)
            yield replace(self, images=self.images[part], T_lidar_map=self.T_lidar_map[part])


class Keyframes(Protocol):
    """Keyframe scans whose images need not be in memory."""

    @property
    def T_lidar_map(self) -> NDArray[np.float64]:
        """(k, 4, 4): poses, in the order of the parts."""

    def parts(self) -> Iterator[KeyframeScans]:
        """The scans, some at a time."""


def origins_of(T_lidar_map: NDArray[np.float64]) -> NDArray[np.float64]:
    """Where the LiDAR was, in the map (k, 3) m, by poses (k, 4, 4)."""
    return np.asarray(-np.einsum("kji,kj->ki", T_lidar_map[:, :3, :3], T_lidar_map[:, :3, 3]))


def are_near(
    T_lidar_map: NDArray[np.float64], positions: NDArray[np.float64], reach_m: float
) -> NDArray[np.bool_]:
    """Which poses (k, 4, 4) are at most `reach_m` from the bounding box of positions (m, 3) m: (k,)."""
    origins, (low, high) = origins_of(T_lidar_map), limits_of(positions)
    outside = np.maximum(low - origins, origins - high).max(axis=1)
    return np.asarray(outside <= reach_m)


class KeyframeSelector:
    """Selects keyframe scans at regular distances along a drive."""

    def __init__(self) -> None:
        self._kept: list[RangeImage] = []
        self._stamp, self._origin = -np.inf, np.full(3, np.inf)

    def add(self, stamp: float, seen: RangeImage) -> None:
        """Keep a scan that is APART_S or APART_M from the last one that was kept."""
        origin = np.linalg.inv(seen.T_lidar_map)[:3, 3]
        if stamp - self._stamp >= APART_S or np.linalg.norm(origin - self._origin) >= APART_M:
            self._kept.append(seen)
            self._stamp, self._origin = stamp, origin

    def keyframes(self) -> KeyframeScans | None:
        """The selected scans; None if there are none."""
        return KeyframeScans.of(self._kept) if self._kept else None


def spatial_order(positions: NDArray[np.float64]) -> NDArray[np.intp]:
    """An order of positions (v, 3) m in which those that follow each other are neighbours, cube by cube."""
    cubes = (positions / CUBE_M).astype(np.int64)
    x, y, z = (cubes - cubes.min(axis=0, initial=0)).T
    return np.argsort((x << 42) + (y << 21) + z, kind="stable")


def share_seen_through(scans: Sequence[NDArray[np.floating]], rows: Rows) -> float:
    """The share of the returns of some scans (n, 3) m, in LiDAR axes, before which the scan says that nothing is.

    It is low for a pattern that is too sparse for an image: most pixels around a return are empty.
    """
    misses, asked = 0, 0
    for points in scans:
        p_lidar = returns_of(points)
        ranges = np.linalg.norm(p_lidar, axis=1)
        some = BEFORE * p_lidar[(ranges > ASKED_M[0]) & (ranges < ASKED_M[1])][::ASKED_EVERY]
        seen = KeyframeScans.of([RangeImage.of(p_lidar, np.eye(4), rows)])
        misses += int(hits_and_misses(some, seen, ASKED_M[1], SHARP_RATIO)[1].sum())
        asked += len(some)
    return misses / asked if asked else 1.0


def hits_and_misses(
    positions: NDArray[np.float64], keyframes: KeyframeScans, farthest_m: float, margin_ratio: float
) -> NDArray[np.int32]:
    """Count the scans that hit each position (v, 3) m, and those that saw through it: (2, v) hits and misses.

    Scans farther than `farthest_m` are no evidence. `margin_ratio` is SHARP_RATIO or WIDE_RATIO.
    See `range_images.count_hits_and_misses`, which does the visibility test.
    """
    counts = np.zeros((2, len(positions)), np.int32)

    def count(part: slice) -> None:
        close = np.flatnonzero(are_near(keyframes.T_lidar_map, positions[part], farthest_m))
        range_images.count_hits_and_misses(
            positions[part], keyframes.images, keyframes.T_lidar_map, keyframes.rows.around, close,
            NEAREST_M, farthest_m, MARGIN_M, margin_ratio, *counts[:, part],
        )  # fmt: skip

    starts = range(0, len(positions), POINTS_PER_BLOCK)
    for _ in prefetch(count, (slice(start, start + POINTS_PER_BLOCK) for start in starts), THREADS):
        pass
    return counts
