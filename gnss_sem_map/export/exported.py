"""What is exported: a map in tiles, and what of the whole map must be known before its first tile is written."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from factor_graphs.trajectory import Trajectory
from gnss_sem_map.config import Nav2Settings, TerrainSettings
from gnss_sem_map.errors import DataError
from gnss_sem_map.export.georeference import Georeference
from gnss_sem_map.labels.label_set import UNLABELLED
from gnss_sem_map.voxels.attributes import Attributes, TiledAttributes
from gnss_sem_map.voxels.semantic_map import SemanticMap, State
from gnss_sem_map.voxels.tile_files import Tile
from gnss_sem_map.voxels.tiles import TiledMap
from gnss_sem_map.voxels.voxel_map import limits_of

NO_VOXELS = "the map has no voxels to draw; run.json lists what was skipped"


@dataclass(frozen=True, eq=False)
class Exported:
    """A refined map and what its files say beside it."""

    map: TiledMap
    tracks: Sequence[Trajectory] = ()
    """Of every drive; pictures show the map from them."""
    title: str | None = None
    changes: Sequence[Mapping[str, Any]] = ()
    """What changed between drives, as `Change.about` tells it."""
    epsg: int | None = None
    """CRS of the files, see `Georeference`."""
    geoid: Path | None = None
    attributes: TiledAttributes | None = None
    """Of its voxels; None where they are not known."""
    raw: TiledMap | None = None
    """The map before refinement, which knows how high the points lie in their voxels."""
    nav2: Nav2Settings = field(default_factory=Nav2Settings)
    terrain: TerrainSettings = field(default_factory=TerrainSettings)

    def tiles(self) -> Iterator[tuple[SemanticMap, Attributes | None]]:
        """The map tile by tile, with the attributes of its voxels; raises DataError."""
        return (self.tile(tile) for tile in self.map.tiles)

    def tile(self, tile: Tile) -> tuple[SemanticMap, Attributes | None]:
        """One of them."""
        piece = self.map.read_tile(tile)
        return piece, None if self.attributes is None else self.attributes.of(tile, piece.voxels.keys)

    @cached_property
    def measured(self) -> TiledMap:
        """The map with the heights of the points that stand in its voxels, and their number, where they are known."""
        return self.map if self.raw is None else replace(self.map, read_tile=self._measured_tile)

    def _measured_tile(self, tile: Tile) -> SemanticMap:
        piece = self.map.read_tile(tile)
        assert self.raw is not None
        if tile not in self.raw.tiles or (raw := self.raw.read_tile(tile).voxels).heights is None:
            return piece
        places = raw.indices_of(piece.voxels.keys)  # -1: of what moved alone
        hits, heights = (np.where(places >= 0, values[places], 0) for values in (raw.hits, raw.heights))
        return replace(piece, voxels=replace(piece.voxels, hits=hits, heights=heights))

    @cached_property
    def georeference(self) -> Georeference | None:
        """None for a map in its drive's own poses."""
        return None if self.map.frame is None else Georeference(self.map.frame, self.epsg, self.geoid)

    def georeference_for(self, what: str) -> Georeference:
        """The georeference, for a file that needs one; raises DataError where there is none."""
        if self.georeference is None:
            raise DataError(
                f"{self.title}: {what} needs a georeference; this map is in its drive's own poses"
            )
        return self.georeference

    @cached_property
    def extent(self) -> Extent:
        """Reads every tile once."""
        return Extent.of(self.map)


def sure_part(tiled_map: TiledMap, min_confidence: float) -> TiledMap:
    """The map in which voxels whose label is less sure than `min_confidence` (0 to 1) have none."""
    if min_confidence == 0:
        return tiled_map

    def read_tile(tile: Tile) -> SemanticMap:
        piece = tiled_map.read_tile(tile)
        unsure = piece.confidence < np.float32(min_confidence)
        return replace(
            piece,
            labels=np.where(unsure, np.int8(UNLABELLED), piece.labels),
            confidence=np.where(unsure, np.float32(0), piece.confidence),
            # without its inferred label, it is what no camera saw
            states=np.where(unsure & piece.inferred, np.uint8(State.UNOBSERVED), piece.states),
        )

    return replace(tiled_map, read_tile=read_tile)


@dataclass(frozen=True, eq=False)
class Extent:
    """Which voxels files show, and how far these reach.

    `drawable` voxels may be seen in a picture, `visible` ones define where it ends.
    """

    has_standing: bool
    """Whether any voxel was not removed; if not, the removed ones are shown."""
    has_labels: bool
    """Whether any of those has a label; if not, all of them are visible."""
    labels: NDArray[np.int64]
    """(c + 2,) drawable voxels of every class, of `other`, and those without."""
    inferred: int
    """Drawable voxels that no camera saw, of which the class is inferred."""
    count: int
    """Visible voxels."""
    low: NDArray[np.int64]
    """(3,) lowest index of the visible voxels along each axis."""
    high: NDArray[np.int64]
    """(3,) highest index."""
    mean: NDArray[np.float64]
    """(3,) mean index."""

    @classmethod
    def of(cls, tiled_map: TiledMap) -> Extent:
        classes, inferred = len(tiled_map.label_set.legend.names), 0
        labelled, standing, removed = _Sums(classes), _Sums(classes), _Sums(classes)
        for piece in tiled_map:
            was_removed = piece.states == State.REMOVED
            inferred += int(np.count_nonzero(piece.inferred))
            indices = piece.voxels.indices
            for sums, chosen in ((labelled, piece.shown), (standing, ~was_removed), (removed, was_removed)):
                places = np.flatnonzero(chosen)
                sums.add(indices.take(places, axis=0), piece.labels[places])
        drawable = standing if standing.count else removed
        visible = labelled if labelled.count else drawable
        return cls(
            has_standing=standing.count > 0,
            has_labels=labelled.count > 0,
            labels=drawable.labels,
            inferred=inferred,
            count=visible.count,
            low=visible.low,
            high=visible.high,
            mean=visible.total / max(visible.count, 1),
        )

    def drawable(self, piece: SemanticMap) -> NDArray[np.bool_]:
        """Voxels that a picture may show: all but the removed ones, or the removed ones if there are no others."""
        return np.asarray((piece.states != State.REMOVED) == self.has_standing)

    def visible(self, piece: SemanticMap) -> NDArray[np.bool_]:
        """Voxels that define where a picture ends: the labelled ones, or all drawable ones in a map without labels."""
        return piece.shown if self.has_labels else self.drawable(piece)


class _Sums:
    """Number, bounds and labels of voxels."""

    def __init__(self, classes: int) -> None:
        self.count = 0
        self.low, self.high = np.full(3, 1 << 40, np.int64), np.full(3, -(1 << 40), np.int64)
        self.total = np.zeros(3, np.int64)
        self.labels = np.zeros(classes + 1, np.int64)

    def add(self, indices: NDArray[np.int32], labels: NDArray[np.int8]) -> None:
        if not len(labels):
            return
        self.count += len(labels)
        low, high = limits_of(indices)
        self.low, self.high = np.minimum(self.low, low), np.maximum(self.high, high)
        self.total += indices.sum(axis=0, dtype=np.int64)
        self.labels += np.roll(np.bincount(labels + 1, minlength=len(self.labels)), -1)
