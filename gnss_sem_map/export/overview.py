"""The whole map on a coarse grid, for pages: where it was seen, and its classes before and after refinement."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.evaluation.metrics import LOOKS
from gnss_sem_map.voxels.semantic_map import State
from gnss_sem_map.voxels.tile_files import TILE_BITS
from gnss_sem_map.voxels.tiles import TiledMap

MOST_CELLS = 800
"""Cells along the longer side of all tiles."""
AREA_CELL_M = 1.0
NO_LABEL, NOTHING = (205, 209, 217), (255, 255, 255)
"""Colours of pixels, RGB."""
CUTS = np.linspace(0, 0.95, 20).astype(np.float32)
"""Confidences below which a label may be left out."""
ORIGINS = ("observed", "inferred", "without a class")


@dataclass(frozen=True, eq=False)
class Overview:
    """A map from above, north up: the first row is the northernmost."""

    cell_m: float
    hits: NDArray[np.int64]
    """(rows, columns) LiDAR points of the voxels that were not removed."""
    labels: NDArray[np.int8]
    """(rows, columns) the class of most labelled voxels, c for `other`; -1: only unlabelled ones, -2: none."""
    area_m2: float
    """Of the squares with a voxel that was not removed, with edges of about `AREA_CELL_M`."""
    not_looked_at: float
    """Share of these LiDAR points in voxels that no labelled image shows."""
    undecided: float
    """Share of those in voxels that images show, but to which they give no class."""
    origins: dict[str, float]
    """Share of the voxels that were not removed: observed, inferred, and without a class."""
    kept: dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]]
    """Of all, and of what no camera saw if any of it is inferred: for the `CUTS` that leave some label, the share of
    the LiDAR points that keep it, and its mean confidence in these."""
    confidence: dict[str, tuple[int, float]]
    """Class: labelled voxels and their mean confidence."""
    colours: dict[str, str]
    """Class: its colour as CSS has it."""
    by_looks: dict[int, tuple[int, float]]
    """Lower end of the LiDAR points of a voxel (`LOOKS`): labelled voxels and their mean confidence."""


def overview_of(tiled: TiledMap) -> Overview | None:
    """Read every tile of a map once; None for a map without tiles."""
    if not tiled.tiles:
        return None
    tiles = np.array(tiled.tiles)
    low, high = tiles.min(axis=0) << TILE_BITS, (tiles.max(axis=0) + 1) << TILE_BITS
    shift = max(0, int(np.ceil(np.log2((high - low).max() / MOST_CELLS))))
    columns, rows = ((high - low) >> shift) + 1
    area_shift = max(0, round(np.log2(AREA_CELL_M / tiled.voxel_size_m)))
    names, colours = tiled.label_set.legend.names, tiled.label_set.legend.colours
    votes = np.zeros((len(names) + 1, rows * columns), np.int32)
    hits, squares, without = np.zeros(rows * columns), 0, np.zeros(2)
    classes, looks = np.zeros((len(names), 2)), np.zeros((len(LOOKS), 2))
    origins, unseen, cut = np.zeros(3), 0.0, np.zeros((2, len(CUTS), 2))
    for piece in tiled:
        stands = piece.states != State.REMOVED
        places, labels = piece.voxels.indices[stands, :2].astype(np.int64), piece.labels[stands]
        cells = (places - low) >> shift
        flat = cells[:, 1] * columns + cells[:, 0]
        weights = piece.voxels.hits[stands].astype(np.float64)
        hits += np.bincount(flat, weights, len(hits))
        for label in range(-1, len(names)):
            votes[label + 1] += np.bincount(flat[labels == label], minlength=len(hits)).astype(np.int32)
        x, y = (places >> area_shift).T
        squares += len(np.unique(x << 32 | y & 0xFFFFFFFF))
        known, sure = labels >= 0, piece.confidence[stands]
        was_seen = piece.states[stands] != State.UNOBSERVED
        without += weights[~known & ~was_seen].sum(), weights[~known & was_seen].sum()
        inferred = piece.inferred[stands]
        origins += [np.count_nonzero(mask) for mask in (known & ~inferred, inferred, ~known)]
        unseen += weights[inferred | ~was_seen].sum()
        for sums, mask in zip(cut, (known, inferred), strict=True):
            groups = np.searchsorted(CUTS, sure[mask], side="right") - 1
            sums += _sums(groups, sure[mask], len(CUTS), weights[mask])
        classes += _sums(labels[known], sure[known], len(classes))
        groups = np.searchsorted(LOOKS, weights[known], side="right") - 1
        looks += _sums(groups, sure[known], len(looks))
    winners = votes[1:].argmax(axis=0)
    labels = np.where(votes[1:].any(axis=0), winners, np.where(votes[0] > 0, -1, -2)).astype(np.int8)
    not_looked_at, undecided = (without / max(hits.sum(), 1.0)).tolist()
    grid = _filled(hits.reshape(rows, columns))
    return Overview(
        cell_m=tiled.voxel_size_m * (1 << shift),
        hits=hits.astype(np.int64).reshape(rows, columns)[grid][::-1],
        labels=labels.reshape(rows, columns)[grid][::-1],
        area_m2=squares * (tiled.voxel_size_m * (1 << area_shift)) ** 2,
        not_looked_at=not_looked_at,
        undecided=undecided,
        origins=dict(zip(ORIGINS, (origins / max(origins.sum(), 1.0)).tolist(), strict=True)),
        kept={
            name: _kept(sums, total)
            for name, sums, total in (("all", cut[0], hits.sum()), ("not seen by a camera", cut[1], unseen))
            if sums.any()
        },
        confidence=dict(zip(names, map(_mean, classes), strict=True)),
        colours={name: "#" + bytes(rgb).hex() for name, rgb in zip(names, colours, strict=True)},
        by_looks=dict(zip(LOOKS, map(_mean, looks), strict=True)),
    )


def coverage_pixels(overview: Overview) -> NDArray[np.uint8]:
    """Pixels (rows, columns, 3) RGB: the darker, the more LiDAR points, on a logarithmic scale; white: none."""
    depth = np.log1p(overview.hits) / max(float(np.log1p(overview.hits).max()), 1.0)
    light, dark = np.array([214, 228, 250]), np.array([16, 42, 110])
    pixels = light + depth[..., None] * (dark - light)
    return np.where(overview.hits[..., None] > 0, pixels, 255).astype(np.uint8)


def label_pixels(overview: Overview) -> NDArray[np.uint8]:
    """Pixels (rows, columns, 3) RGB in the colours of the classes; grey: no label, white: nothing."""
    colours = [bytes.fromhex(colour[1:]) for colour in overview.colours.values()]
    table = np.array([*map(list, colours), NOTHING, NO_LABEL], np.uint8)  # -2 and -1 count from the end
    return table[overview.labels]


def _sums(
    groups: NDArray[np.integer],
    values: NDArray[np.float32],
    count: int,
    weights: NDArray[np.float64] | float = 1.0,
) -> NDArray[np.float64]:
    """(count, 2): number of values of every group, and their sum, both weighted."""
    weights = weights * np.ones(len(values))
    return np.stack([np.bincount(groups, each, count) for each in (weights, weights * values)], axis=1)


def _kept(sums: NDArray[np.float64], total: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """`Overview.kept`, of the points and the sums of their confidence (k, 2) from every cut to the next."""
    points, confidence = np.cumsum(sums[::-1], axis=0)[::-1].T
    some = points > 0
    return points[some] / total, confidence[some] / points[some]


def _filled(cells: NDArray[np.float64]) -> tuple[slice, slice]:
    """The part of a grid outside which all is zero; the whole of a grid of zeros."""
    rows, columns = (np.flatnonzero(cells.any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        return slice(None), slice(None)
    return slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)


def _mean(sums: NDArray[np.float64]) -> tuple[int, float]:
    return int(sums[0]), float(sums[1] / max(sums[0], 1))
