"""The voxel map: class evidence per voxel, fused by addition (Bayes' rule, eq. 6, in logarithms).

Evidence is stored as integer sums of log-likelihoods, so addition is exact: any order of scans, any chunking and any
merge give the same map, bit for bit. `VoxelTable` is the mutable table that scans are added to, `VoxelMap` its
immutable result. Sums stop at a limit (`kernels.SUM_LIMIT`), which keeps this law.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property, reduce
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from gnss_sem_map.errors import ConfigError, DataError
from gnss_sem_map.labels.label_set import UNLABELLED, LabelSet
from gnss_sem_map.voxels import attribute_table, kernels
from gnss_sem_map.voxels.hash_table import HashTable
from gnss_sem_map.voxels.kernels import (
    AXIS_BITS,
    AXIS_OFFSET,
    FIRST_SUM,
    HEIGHT_UNITS,
    OF_IMAGES,
    UNITS_PER_NAT,
)

SMALLEST_TABLE = 1 << 16
"""Rows."""
ANSWER_SHARE = 0.5
"""With a confusion model, an observation is half the likelihood of the predicted class and half the probabilities of
the network: of all mixtures tried on held-out drives this was the most robust."""


class MappingSettings(BaseModel):
    """How points are put into voxels."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    voxel_size_m: float = Field(0.2, gt=0.01, le=10, description="Edge of a voxel (the paper: 0.2 m).")
    nearest_m: float | None = Field(
        None,
        ge=0,
        description="Returns nearer to the LiDAR are left out, m; by default as far as those of the vehicle itself"
        " reach, which stay in place in all scans, at most 2.4.",
    )
    farthest_m: float = Field(120.0, gt=0, description="Returns farther from the LiDAR are left out.")


@dataclass(frozen=True, eq=False)
class VoxelMap:
    """Voxels with their evidence; `a + b` merges, `a - b` subtracts a part, `a[mask]` selects."""

    voxel_size_m: float
    label_set: LabelSet
    keys: NDArray[np.int64]
    """(v,) packed indices, sorted, unique."""
    evidence: NDArray[np.int32]
    """(v, c) sums of log-likelihoods in 2^-10 nat; all zero where no image shows the voxel. (v, 0): not read."""
    hits: NDArray[np.uint32]
    """(v,) LiDAR points in the voxel."""
    heights: NDArray[np.int64] | None = None
    """(v,) sums of the points' heights over the bottom of their voxel, in 1/256 of its edge; None where unknown."""
    of_images: NDArray[np.int32] | None = None
    """(v, 2) image observations, and the sum of their probabilities of `other` in 1/255; None where unknown."""

    def __post_init__(self) -> None:
        v, c = len(self.keys), len(self.label_set.names)
        if self.heights is not None and self.heights.shape != (v,):
            raise DataError(f"voxel map: found {v} keys and heights {self.heights.shape}; expected ({v},)")
        if self.of_images is not None and self.of_images.shape != (v, OF_IMAGES):
            raise DataError(
                f"voxel map: found {v} keys and image observations {self.of_images.shape}; expected ({v}, {OF_IMAGES})"
            )
        if self.evidence.shape not in ((v, c), (v, 0)) or self.hits.shape != (v,):
            raise DataError(
                f"voxel map: found {v} keys, evidence {self.evidence.shape}, hits {self.hits.shape};"
                f" expected ({v}, {c}) and ({v},)"
            )
        if v > 1 and not (self.keys[1:] > self.keys[:-1]).all():
            raise DataError(
                "voxel map: keys are not sorted and unique; select voxels by a mask or increasing indices"
            )

    def __len__(self) -> int:
        return len(self.keys)

    @staticmethod
    def words(label_set: LabelSet) -> int:
        """Width of a row: the key, the sums and hits two to a word, and the heights."""
        return (FIRST_SUM + len(label_set.names) + OF_IMAGES + 1 + 1) // 2 + 1

    def __add__(self, other: VoxelMap) -> VoxelMap:
        """Sum of the evidence of both maps per voxel; raises DataError for another voxel size or class set."""
        if self.voxel_size_m != other.voxel_size_m or self.label_set.names != other.label_set.names:
            raise DataError(
                f"cannot add a map of {other.voxel_size_m} m voxels and classes {list(other.label_set.names)} to one of"
                f" {self.voxel_size_m} m and {list(self.label_set.names)}; build both with the same settings"
            )
        room, c = len(self) + len(other), self.evidence.shape[1]
        keys, evidence = np.empty(room, np.int64), np.empty((room, c), np.int32)
        hits, heights = np.empty(room, np.uint32), np.empty(room, np.int64)
        of_images = np.empty((room, OF_IMAGES), np.int32)
        count = kernels.merge(
            self.keys, self.evidence, self._known_of_images, self.hits, self._known_heights,
            other.keys, other.evidence, other._known_of_images, other.hits, other._known_heights,
            keys, evidence, of_images, hits, heights,
        )  # fmt: skip
        if count < 0:
            raise DataError("cannot add these maps: a voxel would have more than 2^31 points")
        return VoxelMap(
            self.voxel_size_m,
            self.label_set,
            keys[:count],
            evidence[:count],
            hits[:count],
            None if self.heights is None or other.heights is None else heights[:count],
            None if self.of_images is None or other.of_images is None else of_images[:count],
        )

    def __sub__(self, part: VoxelMap) -> VoxelMap:
        """This map without a part that was added to it; raises DataError if `part` is not a part of it."""
        rows = self.indices_of(part.keys)
        is_part = self.voxel_size_m == part.voxel_size_m and self.label_set.names == part.label_set.names
        if not is_part or (rows < 0).any() or (self.hits[rows] < part.hits).any():
            raise DataError("cannot subtract a map that is not part of the other; were both of one run?")
        stays = self.hits[rows] > part.hits  # else all points of the voxel are of the part
        gone = rows[~stays]
        if (self.evidence[gone] != part.evidence[~stays]).any():
            raise DataError("cannot subtract a map with other evidence; were both of one run?")
        kept = np.delete(np.arange(len(self)), gone)
        evidence, hits, heights = self.evidence.take(kept, axis=0), self.hits[kept], self._known_heights[kept]
        of_images = self._known_of_images.take(kept, axis=0)
        places = np.searchsorted(kept, rows[stays])
        evidence[places] -= part.evidence[stays]
        hits[places] -= part.hits[stays]
        heights[places] -= part._known_heights[stays]
        of_images[places] -= part._known_of_images[stays]
        return VoxelMap(
            self.voxel_size_m,
            self.label_set,
            self.keys[kept],
            evidence,
            hits,
            None if self.heights is None or part.heights is None else heights,
            None if self.of_images is None or part.of_images is None else of_images,
        )

    def __getitem__(self, selection: NDArray[np.bool_] | NDArray[np.int64]) -> VoxelMap:
        """The voxels of a boolean mask (v,), or those at increasing indices; raises DataError for another order."""
        # with indices, `take` of rows is four times as fast as indexing with a mask
        places = np.arange(len(self))[selection]
        if len(places) == len(self) and (places[1:] > places[:-1]).all():
            return self
        return VoxelMap(
            self.voxel_size_m,
            self.label_set,
            self.keys[places],
            self.evidence.take(places, axis=0),
            self.hits[places],
            None if self.heights is None else self.heights[places],
            None if self.of_images is None else self.of_images.take(places, axis=0),
        )

    @cached_property
    def indices(self) -> NDArray[np.int32]:
        """(v, 3) integer voxel coordinates."""
        return unpack(self.keys)

    @property
    def centres(self) -> NDArray[np.float64]:
        """(v, 3) m, in the map frame."""
        return (self.indices + np.float64(0.5)) * self.voxel_size_m

    @property
    def surface_heights(self) -> NDArray[np.float64]:
        """(v,) m: mean height of the points in the voxel, in the map frame; NaN where it is unknown."""
        if self.heights is None:
            return np.full(len(self), np.nan)
        # heights were rounded down, by half a unit on average
        inside = (self.heights / np.maximum(self.hits, 1) + 0.5) / HEIGHT_UNITS
        return np.where(self.hits > 0, (self.indices[:, 2] + inside) * self.voxel_size_m, np.nan)

    @property
    def _known_heights(self) -> NDArray[np.int64]:
        return np.zeros(len(self), np.int64) if self.heights is None else self.heights

    @property
    def _known_of_images(self) -> NDArray[np.int32]:
        return np.zeros((len(self), OF_IMAGES), np.int32) if self.of_images is None else self.of_images

    @property
    def other_share(self) -> NDArray[np.float32]:
        """(v,) mean probability of `other` in the images; 0 where none shows the voxel, or it is unknown."""
        observations, mass = self._known_of_images.T
        return np.asarray(mass / (255 * np.maximum(observations, 1)), np.float32)

    @property
    def _sums(self) -> NDArray[np.int32]:
        """The evidence; raises DataError where it was not read."""
        if self.evidence.shape[1] != len(self.label_set.names):
            raise DataError(
                "voxel map: it was read without its sums; open it with them to ask what images show"
            )
        return self.evidence

    @cached_property
    def observed(self) -> NDArray[np.bool_]:
        """(v,) whether any image shows the voxel."""
        return np.asarray(reduce(np.bitwise_or, self._sums.T, np.zeros(len(self), np.int32)) != 0)

    @cached_property
    def labels(self) -> NDArray[np.int8]:
        """(v,) most probable class (eq. 7), -1 where no image shows the voxel."""
        return best_classes(self.evidence, self.observed)

    @cached_property
    def probabilities(self) -> NDArray[np.float32]:
        """(v, c) class probabilities (eq. 6, normalised); uniform where no image shows the voxel."""
        return softmax(self._sums.astype(np.float32) / np.float32(UNITS_PER_NAT))

    def indices_of(self, keys: NDArray[np.int64]) -> NDArray[np.int64]:
        """Index (n,) in the map of each voxel key (n,), or -1 where the map has no such voxel."""
        found = np.empty(len(keys), np.int64)
        kernels.find(self.keys, keys, found)
        return found


Seen = tuple[NDArray[np.int16], NDArray[np.int64]]
"""Intensities (n,) of points, WAITS for one that is seen later, and when each was measured; see `attribute_table`."""
NONE_SEEN: Seen = (np.empty(0, np.int16), np.empty(0, np.int64))


class VoxelTable:
    """Hash table of voxels that scans are added to; it grows as needed."""

    def __init__(
        self,
        voxel_size_m: float,
        label_set: LabelSet,
        probability_floor: float = 0.05,
        answers: NDArray[np.float64] | None = None,
        abstain: bool = False,
        *,
        with_attributes: bool = False,
    ) -> None:
        """`probability_floor`: least probability of a class in one observation, in whole percent (real data: 0.05).

        `answers` (c + 1, c) nat: the confusion model's log-likelihoods of the true classes for each predicted class;
        see ANSWER_SHARE. `abstain`: pixels with the predicted class `other` are ignored. `with_attributes`: scans tell
        them, too.
        """
        if not voxel_size_m > 0:
            raise ConfigError(f"voxel size: found {voxel_size_m} m, expected more than 0")
        self.voxel_size_m, self.label_set = voxel_size_m, label_set
        self._floor_percent = round(100 * probability_floor)
        self._words = VoxelMap.words(label_set) + (attribute_table.WORDS if with_attributes else 0)
        self._columns = tuple(range(len(label_set.names)))
        self._sums = tuple(range(len(label_set.names) + OF_IMAGES))
        self._table, self._knows_heights = HashTable(self._words, SMALLEST_TABLE), True
        share = 1.0 if answers is None else 1.0 - ANSWER_SHARE
        self._log_table = log_table(len(label_set.names), self._floor_percent, share)
        self._log_percent = self._log_table[100 * np.arange(256)]
        self._answers, self._abstain = answer_table(answers, len(label_set.names)), abstain

    def __len__(self) -> int:
        return self._table.count

    def add(
        self,
        keys: NDArray[np.int64],
        pixels: NDArray[np.int32] | None = None,
        classes: NDArray[np.uint8] | None = None,
        heights: NDArray[np.uint8] | None = None,
        seen: Seen = NONE_SEEN,
    ) -> None:
        """Add the points of one scan: their voxel keys (n,) and their class probabilities (eq. 6).

        `pixels` (n,) is the row in `classes` of each point, -1 for none; `classes` (p, c + 1) are uint8 probabilities,
        `other` last. `heights` (n,) are those of the points over the bottom of their voxels, in 1/256 of the edge; if
        they are not given, the map has no heights. `seen` is for a table with attributes. Raises DataError when a
        voxel would have more than 2^31 points.
        """
        if pixels is None or classes is None:
            pixels = np.full(len(keys), -1, np.int32)
            classes = np.zeros((0, len(self._columns) + 1), np.uint8)
        if heights is None:
            self._knows_heights, heights = False, np.zeros(len(keys), np.uint8)
        observations = np.empty((len(classes), len(self._sums)), np.int32)
        kernels.log_likelihoods(
            classes, self._log_table, self._log_percent, self._floor_percent, self._answers, self._abstain,
            self._columns, observations,
        )  # fmt: skip
        done = 0
        while done < len(keys):
            self._table.count, done = kernels.fuse(
                *self._views, len(self), done, keys, pixels, heights, observations, *seen, self._sums
            )
            if done < 0:
                voxel = unpack(keys[[-1 - done]])[0]
                raise DataError(
                    f"voxel {voxel.tolist()} would have more than 2^31 points; does the vehicle stand there for days?"
                )
            if done < len(keys):
                self._table.grow()

    def see(self, keys: NDArray[np.int64], seen: Seen) -> None:
        """Add attributes of points (n,) that were added without."""
        kernels.see(*self._views, keys, *seen)

    @property
    def _views(self) -> tuple[NDArray[np.int64], NDArray[np.int32], NDArray[np.uint8], NDArray[np.int32]]:
        rows = self._table.rows
        return rows, rows.view(np.int32), rows.view(np.uint8), self._table.slots

    def put_aside(self, path: Path) -> None:
        """Write the rows into a file: until `take_back`, they take no memory and cannot be used. Raises OSError."""
        path.write_bytes(self._table.filled.data)  # `tofile` does not say why it failed
        self._table.rows = np.empty((0, self._words), np.int64)

    def take_back(self, path: Path) -> None:
        """Read the rows that were put aside, and remove the file; raises OSError."""
        self._table.rows = np.fromfile(path, np.dtype((np.int64, self._words)))
        path.unlink()

    @property
    def nbytes(self) -> int:
        """Size of the table in memory."""
        return self._table.nbytes

    def to_map(self) -> VoxelMap:
        """The voxels so far, sorted by key."""
        rows = self._table.filled
        order = np.argsort(rows[:, 0])
        ints, last = rows.view(np.int32), FIRST_SUM + len(self._columns)
        end = last + OF_IMAGES
        return VoxelMap(
            self.voxel_size_m,
            self.label_set,
            keys=rows[order, 0],
            evidence=ints[order, FIRST_SUM:last],
            hits=ints[order, end].astype(np.uint32),
            heights=rows[order, end // 2 + 1] if self._knows_heights else None,
            of_images=ints[order, last:end],
        )

    def attributes(self) -> tuple[NDArray[Any], ...]:
        """Those of the voxels so far, as the columns of `Attributes`."""
        return attribute_table.columns_of(self._table.filled)


def keys_of(p_map: NDArray[np.float64], voxel_size_m: float) -> NDArray[np.int64]:
    """Voxel key of every point (n, 3) m; raises DataError for a point that is NaN or beyond +-2^20 voxels."""
    keys = np.empty(len(p_map), np.int64)
    kernels.pack_keys(p_map, voxel_size_m, keys)
    if not keys.all():
        bad = int(np.flatnonzero(keys == 0)[0])
        raise DataError(
            f"point {bad} of {len(p_map)} at {p_map[bad].tolist()} m is not inside the map, which reaches"
            f" {AXIS_OFFSET * voxel_size_m / 1000:.0f} km from its origin; check the poses"
        )
    return keys


def unpack(keys: NDArray[np.int64]) -> NDArray[np.int32]:
    """Integer voxel coordinates (v, 3) of packed keys."""
    indices = np.empty((len(keys), 3), np.int32)
    kernels.unpack_keys(keys, indices)
    return indices


def limits_of(rows: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """The least and the largest value of each column of (n, k) rows, at least one.

    Column by column this takes a twentieth of the time of `min(axis=0)`.
    """
    return np.stack([column.min() for column in rows.T]), np.stack([column.max() for column in rows.T])


def pack(indices: NDArray[np.integer]) -> NDArray[np.int64]:
    """Packed keys of integer voxel coordinates (v, 3); they sort like (x, y, z)."""
    x, y, z = (np.asarray(indices, np.int64) + AXIS_OFFSET).T
    return np.asarray((x << (2 * AXIS_BITS)) | (y << AXIS_BITS) | z)


@cache
def log_table(number_of_classes: int, floor_percent: int, share: float = 1.0) -> NDArray[np.int32]:
    """round(1024 share ln i) for every integer i in the normalisation of floored uint8 probabilities; read-only."""
    largest = number_of_classes * max(100 * 255, floor_percent * 255 * number_of_classes)
    numbers = np.arange(largest + 1, dtype=np.float64)
    numbers[0] = 1.0
    table = np.asarray(np.rint(share * UNITS_PER_NAT * np.log(numbers)), np.int32)
    table.flags.writeable = False
    return table


def answer_table(answers: NDArray[np.float64] | None, number_of_classes: int) -> NDArray[np.int32]:
    """The confusion model's share of an observation in 2^-10 nat, (c + 1, c); no rows without a confusion model."""
    if answers is None:
        return np.empty((0, number_of_classes), np.int32)
    return np.asarray(np.rint(ANSWER_SHARE * UNITS_PER_NAT * answers), np.int32)


def best_classes(scores: NDArray[np.number], known: NDArray[np.bool_]) -> NDArray[np.int8]:
    """The class (v,) of the highest score (v, c), the first of equal ones; UNLABELLED where nothing is known."""
    labels = np.full(len(scores), UNLABELLED, np.int8)
    kernels.find_largest(scores, known, labels)
    return labels


def softmax(log_scores: NDArray[np.float32]) -> NDArray[np.float32]:
    """Probabilities from log scores, row by row."""
    probabilities = np.empty(log_scores.shape, np.float32)
    kernels.subtract_largest(log_scores, probabilities)
    np.exp(probabilities, out=probabilities)
    kernels.normalise(probabilities)
    return probabilities
