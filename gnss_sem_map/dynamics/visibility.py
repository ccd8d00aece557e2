"""Free-space evidence: how many keyframe scans hit a position, and how many saw through it."""

from __future__ import annotations

import os
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from gnss_sem_map.dynamics import range_images
from gnss_sem_map.scans.prefetch import prefetch

THREADS = min(os.cpu_count() or 1, 4)
"""More threads would wait for the one that reads, each with two scans in memory."""
POINTS_PER_BLOCK = 1 << 14
"""Positions that one thread works on at a time."""
APART_M, APART_S = 1.0, 1.0
"""Distance and time between keyframe scans, whichever comes first: the scans take no more memory than the map."""


class VisibilitySettings(BaseModel):
    """Which ranges count as hits and misses of a position."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    nearest_m: float = Field(default=3.0, gt=0, description="Scans nearer than this are no evidence, m.")
    farthest_m: float = Field(default=40.0, gt=0, description="Scans farther than this are no evidence, m.")
    margin_m: float = Field(default=0.3, ge=0, description="A range within this of the position is a hit, m,")
    margin_ratio: float = Field(default=0.01, ge=0, description="plus this share of the range.")


@dataclass(frozen=True, eq=False)
class KeyframeScans:
    """Range images and poses of scans, for free-space evidence."""

    images: NDArray[np.uint16]
    """(k, h, w) cm: range images."""
    T_lidar_map: NDArray[np.float64]
    """(k, 4, 4): poses."""

    @classmethod
    def of(cls, scans: list[tuple[NDArray[np.uint16], NDArray[np.float64]]]) -> KeyframeScans:
        """Range images with their poses, at least one."""
        images, poses = zip(*scans, strict=True)
        return cls(np.stack(images), np.stack(poses))

    def near(self, positions: NDArray[np.float64], reach_m: float) -> KeyframeScans:
        """The scans at most `reach_m` from the bounding box of positions (m, 3) m: few scans of a long drive."""
        origins = -np.einsum("kji,kj->ki", self.T_lidar_map[:, :3, :3], self.T_lidar_map[:, :3, 3])
        outside = np.maximum(positions.min(axis=0) - origins, origins - positions.max(axis=0)).max(axis=1)
        close = outside <= reach_m
        return self if close.all() else KeyframeScans(self.images[close], self.T_lidar_map[close])


class KeyframeSelector:
    """Selects keyframe scans at regular distances along a drive."""

    def __init__(self) -> None:
        self._kept: list[tuple[NDArray[np.uint16], NDArray[np.float64]]] = []
        self._stamp, self._origin = -np.inf, np.full(3, np.inf)

    def add(self, stamp: float, image: NDArray[np.uint16], T_lidar_map: NDArray[np.float64]) -> None:
        """Keep a scan that is APART_S or APART_M from the last one that was kept."""
        origin = np.linalg.inv(T_lidar_map)[:3, 3]
        if stamp - self._stamp >= APART_S or np.linalg.norm(origin - self._origin) >= APART_M:
            self._kept.append((image, T_lidar_map))
            self._stamp, self._origin = stamp, origin

    def keyframes(self) -> KeyframeScans | None:
        """The selected scans; None if there are none."""
        return KeyframeScans.of(self._kept) if self._kept else None


def hits_and_misses(
    positions: NDArray[np.float64], keyframes: KeyframeScans, settings: VisibilitySettings
) -> NDArray[np.int32]:
    """Count the scans that hit each position (v, 3) m, and those that saw through it: (2, v) hits and misses.

    See `range_images.count_hits_and_misses`, which does the visibility test.
    """
    counts = np.zeros((2, len(positions)), np.int32)

    def count(part: slice) -> None:
        close = keyframes.near(positions[part], settings.farthest_m)
        range_images.count_hits_and_misses(
            positions[part], close.images, close.T_lidar_map,
            settings.nearest_m, settings.farthest_m, settings.margin_m, settings.margin_ratio,
            *counts[:, part],
        )  # fmt: skip

    starts = range(0, len(positions), POINTS_PER_BLOCK)
    for _ in prefetch(count, (slice(start, start + POINTS_PER_BLOCK) for start in starts), THREADS):
        pass
    return counts
