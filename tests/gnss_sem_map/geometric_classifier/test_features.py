"""Features against plain sums over all voxels of a window, and what must not change them."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from gnss_sem_map.geometric_classifier import features
from gnss_sem_map.geometric_classifier.features import (
    COLUMN_LEVELS,
    LEVELS,
    NAMES,
    OF_AREA,
    OF_COLUMN,
    OF_SHAPE,
    TALL,
    WINDOW,
    features_of,
    reach_m,
)
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.refinement.height_above_ground import height_over_ground
from gnss_sem_map.voxels.voxel_map import VoxelMap, pack

SIZE_M = 0.2
URBAN = open_label_set()
COLUMN = {name: i for i, name in enumerate(NAMES)}


def scene(rng: np.random.Generator, side: int = 26) -> tuple[VoxelMap, NDArray[np.uint8]]:
    """Ground, a wall, a bush and voxels anywhere, around the origin of the axes; and intensities."""
    ground = [(x, y, x // 9) for x in range(-side, side) for y in range(-side, side)]
    wall = [(x, 5, z) for x in range(-side, side, 2) for z in range(1, 14)]
    bush = rng.integers((-20, -18, -1), (-8, -6, 11), (300, 3))
    anywhere = rng.integers((-side, -side, -3), (side, side, 25), (300, 3))
    indices = np.unique(np.concatenate([ground, wall, bush, anywhere]), axis=0)
    indices = indices[rng.random(len(indices)) < 0.8]
    return of_indices(indices, rng), rng.integers(0, 256, len(indices)).astype(np.uint8)


def of_indices(indices: NDArray[np.int64], rng: np.random.Generator) -> VoxelMap:
    hits = rng.integers(0, 5, len(indices)).astype(np.uint32)
    heights = hits * rng.integers(0, 256, len(indices))
    keys = pack(indices)
    assert (np.diff(keys) > 0).all()
    return VoxelMap(SIZE_M, URBAN, keys, np.zeros((len(keys), 5), np.int32), hits, heights.astype(np.int64))


def z_of(voxels: VoxelMap) -> NDArray[np.float64]:
    """Mean height of the points of each voxel, in voxels."""
    assert voxels.heights is not None
    return voxels.indices[:, 2] + (voxels.heights // np.maximum(voxels.hits, 1)) / 256


def shape_by_hand(
    voxels: VoxelMap, intensity: NDArray[np.uint8], i: int, level: int
) -> tuple[list[float], NDArray[np.float64]]:
    """Of one voxel, in the order of OF_SHAPE, and the eigenvalues, in ascending order."""
    cells, z = voxels.indices >> level, z_of(voxels)
    near = (np.abs(cells - cells[i]) <= WINDOW).all(axis=1)
    places = np.column_stack([voxels.indices[near, :2], z[near]])
    covariance = np.cov(places.T, bias=True) if near.sum() > 1 else np.zeros((3, 3))
    values, axes = np.linalg.eigh(covariance)
    small, middle, large = values
    over = max(large, 1e-6)
    here = intensity[near].astype(np.float64)
    return [
        near.sum(), (large - middle) / over, (middle - small) / over, small / over, abs(axes[2, 0]),
        abs(axes[2, 2]), np.sqrt(max(small, 0)), z[near].std(), z[i] - z[near].mean(),
        here.mean(), here.std(), intensity[i] - here.mean(),
    ], values  # fmt: skip


def test_the_shape_around_a_voxel_is_that_of_the_covariance_of_its_window() -> None:
    rng = np.random.default_rng(0)
    voxels, intensity = scene(rng)
    found = features_of(voxels, intensity)
    for level in LEVELS:
        first = COLUMN[f"{OF_SHAPE[0]}_{level}"]
        for i in rng.choice(len(voxels), 150, replace=False):
            expected, (small, middle, large) = shape_by_hand(voxels, intensity, i, level)
            unclear = set()  # an axis of two equal eigenvalues is any, and so is all of a point
            if middle - small < 0.02 * large:
                unclear.add("normal_z")
            if large - middle < 0.02 * large:
                unclear.add("axis_z")
            if large == 0:
                unclear |= {"linearity", "planarity", "normal_z", "axis_z"}
            for k, name in enumerate(OF_SHAPE):
                if name not in unclear:
                    tolerance = 2e-3 if name in ("roughness", "normal_z", "axis_z") else 1e-4
                    assert found[i, first + k] == pytest.approx(expected[k], abs=tolerance, rel=1e-5), (
                        name,
                        level,
                    )


def test_a_column_says_what_is_over_and_under_a_voxel() -> None:
    voxels, intensity = scene(np.random.default_rng(1))
    found = features_of(voxels, intensity)[:, 2 : 2 + len(OF_COLUMN)]
    columns: dict[tuple[int, int], set[int]] = {}
    for x, y, z in voxels.indices.tolist():
        columns.setdefault((x, y), set()).add(z)
    for (x, y, z), row in zip(voxels.indices.tolist(), found.tolist(), strict=True):
        column = columns[x, y]
        up = next(n for n in range(100) if z + n + 1 not in column)
        down = next(n for n in range(100) if z - n - 1 not in column)
        over, under = [k for k in column if k > z + up], [k for k in column if k < z - down]
        assert row == [
            len(column), max(column) - z, z - min(column),
            min(over) - z - up if over else 0, z - down - max(under) if under else 0, up, down,
        ]  # fmt: skip


def test_the_columns_around_a_voxel_say_how_it_stands_out() -> None:
    rng = np.random.default_rng(2)
    voxels, intensity = scene(rng)
    found, z = features_of(voxels, intensity), z_of(voxels)
    for level in COLUMN_LEVELS:
        cells = voxels.indices[:, :2] >> level
        columns, of_voxel = np.unique(cells, axis=0, return_inverse=True)
        low = np.array([z[of_voxel == k].min() for k in range(len(columns))])
        high = np.array([z[of_voxel == k].max() for k in range(len(columns))])
        first = COLUMN[f"{OF_AREA[0]}_{level}"]
        for i in range(0, len(voxels), 7):
            near = (np.abs(columns - cells[i]) <= WINDOW).all(axis=1)
            expected = [
                z[i] - low[near].min(), z[i] - low[near].mean(), low[near].std(), high[near].max() - z[i],
                (high[near] - low[near] >= TALL).mean(), near.sum(),
            ]  # fmt: skip
            np.testing.assert_allclose(found[i, first : first + len(OF_AREA)], expected, rtol=1e-5, atol=1e-3)


def test_height_and_intensity_are_those_of_the_voxel() -> None:
    voxels, intensity = scene(np.random.default_rng(3))
    found = features_of(voxels, intensity)
    np.testing.assert_array_equal(found[:, COLUMN["height"]], height_over_ground(voxels.centres))
    np.testing.assert_array_equal(found[:, COLUMN["intensity"]], intensity)


@pytest.mark.parametrize("seed", range(3))
def test_a_part_of_a_map_has_the_bits_of_the_whole(seed: int) -> None:
    """Both where some voxels are asked for, and where the map ends as far away as features read."""
    rng = np.random.default_rng(seed)
    voxels, intensity = scene(rng, side=110)
    whole = features_of(voxels, intensity)
    places = np.flatnonzero(rng.random(len(voxels)) < 0.01)
    np.testing.assert_array_equal(features_of(voxels, intensity, places), whole[places])
    low = rng.uniform(-10.0, 5.0, 2)
    distance = np.maximum(low - voxels.centres[:, :2], voxels.centres[:, :2] - low - 3.0).max(axis=1)
    around, inside = np.flatnonzero(distance <= reach_m(SIZE_M)), distance <= 0
    assert 100 < inside.sum() < len(around) < 0.9 * len(voxels)
    part = features_of(voxels[around], intensity[around], np.flatnonzero(inside[around]))
    np.testing.assert_array_equal(part, whole[inside])


@pytest.mark.parametrize("blocks", [(5, -10), (1, 3), (-2, 0)])
def test_a_map_that_is_moved_by_whole_cells_has_the_same_features(blocks: tuple[int, int]) -> None:
    """Blocks of eight voxels; five of them are eight cells of the ground, whose height then stays as well."""
    voxels, intensity = scene(np.random.default_rng(4))
    moved = pack(voxels.indices + 8 * np.array([*blocks, 0]))
    shifted = VoxelMap(SIZE_M, URBAN, moved, voxels.evidence, voxels.hits, voxels.heights)
    before, after = features_of(voxels, intensity), features_of(shifted, intensity)
    np.testing.assert_array_equal(before[:, 1:], after[:, 1:])
    if all(number % 5 == 0 for number in blocks):
        np.testing.assert_allclose(before[:, 0], after[:, 0], atol=1e-5)


def test_features_of_few_voxels_without_intensity_or_heights_are_finite() -> None:
    rng = np.random.default_rng(5)
    for count in (0, 1, 2, 3):
        voxels = of_indices(np.array([(7, 7, 7 + k) for k in range(count)]).reshape(-1, 3), rng)
        voxels = VoxelMap(SIZE_M, URBAN, voxels.keys, voxels.evidence, voxels.hits)
        for places in (None, np.empty(0, np.int64)):
            found = features_of(voxels, np.zeros(count, np.uint8), places)
            assert found.shape == (count if places is None else 0, len(NAMES))
            assert np.isfinite(found).all()
    assert (found[:, [COLUMN[name] for name in features.OF_INTENSITY]] == 0).all()
    voxels, _ = scene(rng)
    assert np.isfinite(features_of(voxels, np.zeros(len(voxels), np.uint8))).all()
