"""What scans say of a place: that something was there, or that they looked through it."""

from __future__ import annotations

import os
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from gnss_sem_map.dynamics import range_images
from gnss_sem_map.scans.prefetch import ahead

THREADS = min(os.cpu_count() or 1, 4)
"""More would wait for the one that reads, each with two scans in memory."""
PLACES_AT_ONCE = 1 << 14
"""Places that one thread looks at before it takes the next."""
APART_M, APART_S = 1.0, 1.0
"""Of a whole drive those scans are kept that are so far apart, in either: they take no more memory than its map."""


class VisibilitySettings(BaseModel):
    """When a range that a scan measured speaks of a place."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    nearest_m: float = Field(default=3.0, gt=0, description="Scans nearer than this are no evidence, m.")
    farthest_m: float = Field(default=40.0, gt=0, description="Scans farther than this are no evidence, m.")
    margin_m: float = Field(default=0.3, ge=0, description="A range within this of a place is a hit, m,")
    margin_ratio: float = Field(default=0.01, ge=0, description="plus this share of the range.")


@dataclass(frozen=True, eq=False)
class Witnesses:
    """Scans that can be asked."""

    images: NDArray[np.uint16]
    """(k, h, w): their range images."""
    T_lidar_map: NDArray[np.float64]
    """(k, 4, 4): where they were."""

    @classmethod
    def of(cls, scans: list[tuple[NDArray[np.uint16], NDArray[np.float64]]]) -> Witnesses:
        """Range images with their poses, at least one."""
        images, poses = zip(*scans, strict=True)
        return cls(np.stack(images), np.stack(poses))

    def near(self, places: NDArray[np.float64], reach_m: float) -> Witnesses:
        """Those that are no farther than that from the box around some places (m, 3) m: in a long drive, few."""
        stood = -np.einsum("kji,kj->ki", self.T_lidar_map[:, :3, :3], self.T_lidar_map[:, :3, 3])
        outside = np.maximum(places.min(axis=0) - stood, stood - places.max(axis=0)).max(axis=1)
        close = outside <= reach_m
        return self if close.all() else Witnesses(self.images[close], self.T_lidar_map[close])


class AlongTheDrive:
    """Collects witnesses from all along a drive, however long it stands and however fast it goes."""

    def __init__(self) -> None:
        self._kept: list[tuple[NDArray[np.uint16], NDArray[np.float64]]] = []
        self._stamp, self._stood = -np.inf, np.full(3, np.inf)

    def add(self, stamp: float, image: NDArray[np.uint16], T_lidar_map: NDArray[np.float64]) -> None:
        """Keep a scan that is APART_S or APART_M from the last one that was kept."""
        stood = np.linalg.inv(T_lidar_map)[:3, 3]
        if stamp - self._stamp >= APART_S or np.linalg.norm(stood - self._stood) >= APART_M:
            self._kept.append((image, T_lidar_map))
            self._stamp, self._stood = stamp, stood

    def witnesses(self) -> Witnesses | None:
        """All that were kept; None without a scan."""
        return Witnesses.of(self._kept) if self._kept else None


def testify(
    places: NDArray[np.float64], witnesses: Witnesses, settings: VisibilitySettings
) -> NDArray[np.int32]:
    """How many witnesses hit each place (v, 3) m, and how many saw through it: (2, v); see `range_images.look_at`."""
    looks = np.zeros((2, len(places)), np.int32)

    def look(part: slice) -> None:
        asked = witnesses.near(places[part], settings.farthest_m)
        range_images.look_at(
            places[part], asked.images, asked.T_lidar_map,
            settings.nearest_m, settings.farthest_m, settings.margin_m, settings.margin_ratio,
            *looks[:, part],
        )  # fmt: skip

    starts = range(0, len(places), PLACES_AT_ONCE)
    for _ in ahead(look, (slice(start, start + PLACES_AT_ONCE) for start in starts), THREADS):
        pass
    return looks
