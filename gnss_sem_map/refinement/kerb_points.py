"""Points of kerbs: a voxel where road meets sidewalk holds both; position and height classify each point."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from gnss_sem_map.voxels import kernels

SUREST = 0.98
"""Upper limit of the difference of probabilities by position alone, so that height can change it."""
POINT_STDDEV_M = 0.05
"""Points lie so far over or under the level that they belong to."""
FACE_BEGINS = 0.3
"""Share of the step, from the road up, where what lies there is as likely the kerb's face, so sidewalk."""


@dataclass(frozen=True, eq=False)
class Kerbs:
    """The e voxels of a map where road and sidewalk meet at a step."""

    voxel_size_m: float
    classes: tuple[int, int]
    """Road and sidewalk."""
    keys: NDArray[np.int64]
    """(e,) packed voxels, sorted."""
    leaning: NDArray[np.float32]
    """(e, 3, 3) probability of road minus that of sidewalk in the voxel and those beside it in x and y, 0 elsewhere."""
    known: NDArray[np.bool_]
    """(e, 3, 3) which of those are either of the two."""
    levels: NDArray[np.float64]
    """(2, e) m, height of the road and of the sidewalk here."""

    def __getitem__(self, chosen: NDArray[np.int64]) -> Kerbs:
        """Those at increasing places."""
        return replace(
            self,
            keys=self.keys[chosen],
            leaning=self.leaning[chosen],
            known=self.known[chosen],
            levels=self.levels[:, chosen],
        )

    def decide(
        self, keys: NDArray[np.int64], p_map: NDArray[np.float64]
    ) -> tuple[NDArray[np.int64], NDArray[np.int8], NDArray[np.float32]]:
        """Which of the points (n, 3) m lie in a kerb (k,), the class of each (k,), and how probable that is (k,).

        `keys` (n,) are the points' packed voxels. Two independent sources: log odds
        of the place, bilinear between the centres of the voxels of one layer, and of the height, two normal
        distributions around the levels.
        """
        rows = np.empty(len(keys), np.int64)
        kernels.find(self.keys, keys, rows)
        inside = np.flatnonzero(rows >= 0)
        rows, p_map = rows[inside], p_map[inside]
        log_odds = self._of_place(rows, p_map) + self._of_height(rows, p_map[:, 2])
        road, sidewalk = self.classes
        chosen = np.where(log_odds >= 0, road, sidewalk).astype(np.int8)
        return inside, chosen, np.asarray(expit(np.abs(log_odds)), np.float32)

    def _of_place(self, rows: NDArray[np.int64], p_map: NDArray[np.float64]) -> NDArray[np.float64]:
        from_centre = np.mod(p_map[:, :2] / self.voxel_size_m, 1) - 0.5
        (x, y), (a, b) = np.where(from_centre < 0, 0, 2).T, np.abs(from_centre).T
        corners = (
            (1, 1, (1 - a) * (1 - b)), (x, 1, a * (1 - b)), (1, y, (1 - a) * b), (x, y, a * b)
        )  # fmt: skip
        leaning = sum(weight * self.leaning[rows, i, j] for i, j, weight in corners)
        known = sum(weight * self.known[rows, i, j] for i, j, weight in corners)
        return np.asarray(2 * np.arctanh(np.clip(leaning / known, -SUREST, SUREST)))

    def _of_height(self, rows: NDArray[np.int64], z: NDArray[np.float64]) -> NDArray[np.float64]:
        road, sidewalk = self.levels[:, rows]
        step = sidewalk - road
        turning = road + FACE_BEGINS * step
        return np.asarray(step * (turning - z) / POINT_STDDEV_M**2)


def joined(parts: Sequence[Kerbs]) -> Kerbs | None:
    """The kerbs of parts of one map that share no voxel; None for no part."""
    if not parts:
        return None
    keys = np.concatenate([part.keys for part in parts])
    order = np.argsort(keys)
    return replace(
        parts[0],
        keys=keys[order],
        leaning=np.concatenate([part.leaning for part in parts])[order],
        known=np.concatenate([part.known for part in parts])[order],
        levels=np.concatenate([part.levels for part in parts], axis=1)[:, order],
    )
