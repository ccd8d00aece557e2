"""What every block must know of the whole map: sums over its blocks, and the figures that follow from them.

Sums are whole numbers, so they add to the same in any order. Figures are rounded, so that a drive more in a large map
seldom changes them: a block with the same voxels around it and the same figures is refined to the same.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields

import numpy as np

FIXED_POINT = 1024
"""Units of one, in sums of what is no whole number."""
STEP = 0.005
"""Rates are rounded to whole multiples of this, the logarithm of a ratio to ten of them."""
MOST_SYSTEMATIC = 0.5
PSEUDO_COUNTS = 3.0
"""Overdispersion: a column's share of right labels is Beta with so many pseudo-counts, since views err as a whole."""
LEAST_ERROR_RATE, MOST_ERROR_RATE = 0.05, 1 / 3
"""Limits of an error rate that is estimated from the map: self-agreement is not accuracy."""


@dataclass(frozen=True)
class Sums:
    """What one block, or several, add to the figures; `a + b` adds, and `Sums()` is that of no block."""

    observed: int = 0
    """Voxels that some image shows."""
    observations: int = 0
    """Of these, 1/1024."""
    by_geometry: int = 0
    """Observations, 1/1024, of voxels in which geometry overrules the images."""
    by_neighbours: int = 0
    by_both: int = 0
    column_pairs: int = 0
    """Pairs of building and vegetation voxels of one column, once per voxel of both."""
    disagreeing_pairs: int = 0
    """1/1024, of those the ones of different classes."""
    buildings: int = 0
    """Voxels called building,"""
    vegetation: int = 0
    roads: int = 0
    moved: int = 0
    """Points of moving objects in voxels that some image shows,"""
    moved_otherwise: int = 0
    """and of these, the ones in voxels that the images call something else than vehicle."""

    def __add__(self, other: Sums) -> Sums:
        return Sums(**{name: value + getattr(other, name) for name, value in asdict(self).items()})

    def to_json(self) -> dict[str, int]:
        """Of whole numbers; `from_json` reads it back."""
        return asdict(self)

    @classmethod
    def from_json(cls, content: Mapping[str, object]) -> Sums:
        """Raises ValueError for anything but whole numbers of these names."""
        numbers = {name: value for name, value in dict(content).items() if type(value) is int and value >= 0}
        names = {field.name for field in fields(cls)}
        if set(content) != names or len(numbers) < len(names):
            raise ValueError(
                f"sums of a block: found {str(dict(content))[:200]}, expected whole numbers {sorted(names)};"
                " refine the map again"
            )
        return cls(**numbers)


@dataclass(frozen=True)
class Figures:
    """Of the whole map; those of a map of which nothing is known yet, by default."""

    systematic_error: float = 0.0
    """Share of observations, 0 to 0.5, that are wrong in all views alike."""
    column_error_rate: float = LEAST_ERROR_RATE
    """Share of building and vegetation labels that are wrong, from how often two of one column disagree."""
    building_log_odds: float = 0.0
    """Of building against vegetation, before anything is seen."""
    has_road: bool = True
    moved_otherwise: float = 1.0
    """Share of the points of moving objects that are of no vehicle, by the images; 1 where no image shows any."""


def figures_of(sums: Sums) -> Figures:
    """The rounded figures that follow from the sums over all blocks."""
    odds = np.log((sums.buildings + 1) / (sums.vegetation + 1))
    return Figures(
        _rounded(systematic_errors(sums)),
        _rounded(column_error_rate(sums)),
        _rounded(float(odds), 10 * STEP),
        sums.roads > 0,
        _rounded(moved_otherwise(sums)),
    )


def systematic_errors(sums: Sums) -> float:
    """Share of observations, 0 to 0.5, that are wrong in all views alike, by capture and recapture.

    Two independent sources (geometry and neighbours) overrule the images. The first finds the same share of all errors
    as of those that the second one finds: all = first * second / both. With one source only, its errors are the
    estimate. A voxel is weighted with its observations.
    Source: Chapman, "Some properties of the hypergeometric distribution" (1951), which is unbiased for small numbers.
    """
    if not sums.observed:
        return 0.0
    mean = sums.observations / sums.observed
    first, second, both = (found / mean for found in (sums.by_geometry, sums.by_neighbours, sums.by_both))
    errors = (first + 1) * (second + 1) / (both + 1) - 1
    return float(min(errors / sums.observed, MOST_SYSTEMATIC))


def column_error_rate(sums: Sums) -> float:
    """The rate at which labels of a column are wrong, from how often two of them disagree.

    With Beta(a, b) the distribution of the share of right labels, a + b = PSEUDO_COUNTS and b = rate (a + b), two
    disagree in 2 a b / ((a + b) (a + b + 1)) of the cases.
    """
    disagreement = sums.disagreeing_pairs / FIXED_POINT / max(sums.column_pairs, 1)
    product = disagreement * (PSEUDO_COUNTS + 1) / (2 * PSEUDO_COUNTS)
    rate = (1 - np.sqrt(max(1 - 4 * product, 0.0))) / 2
    return float(np.clip(rate, LEAST_ERROR_RATE, MOST_ERROR_RATE))


def moved_otherwise(sums: Sums) -> float:
    """Share of the points of moving objects that are of no vehicle, by what the images say of those that they show."""
    return max(sums.moved_otherwise / sums.moved, LEAST_ERROR_RATE) if sums.moved else 1.0


def _rounded(value: float, step: float = STEP) -> float:
    return round(round(value / step) * step, 6)
