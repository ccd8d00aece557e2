"""A map is refined block by block: nobody needs the whole map, and nobody can tell the order."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import reduce
from operator import add

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from long_street import SIZE_M, URBAN, keyframes, street

from gnss_sem_map.refinement.by_block import (
    geometry_halo_m,
    halo_m,
    refine_block,
    run_steps,
    sums_of,
    voxels_by_tile,
)
from gnss_sem_map.refinement.figures import Figures, Sums, figures_of
from gnss_sem_map.refinement.state import Evidence, GeometricEvidence, MapState
from gnss_sem_map.refinement.steps import RefinementReport, RefinementSettings
from gnss_sem_map.voxels.blocks import Block, blocks_of
from gnss_sem_map.voxels.voxel_map import VoxelMap, pack, unpack

VOXELS = street()
ALL = RefinementSettings()
PAPER = RefinementSettings.model_validate(
    {"count_grid": {"method": "paper"}, "vehicles": {"method": "paper"}}
)
MOVED = replace(VOXELS, keys=VOXELS.keys + 3)[np.arange(0, len(VOXELS), 7)]


def by_shape() -> GeometricEvidence:
    """What two drives say of the shape of some voxels."""
    rng = np.random.default_rng(1)
    keys = VOXELS.keys[rng.random(len(VOXELS)) < 0.9]
    sums = 1000 - rng.integers(1, 3000, (len(keys), len(URBAN.names) + 2), np.int32)
    return GeometricEvidence(keys, sums, rng.integers(1, 3, len(keys), np.int32))


BY_SHAPE = by_shape()
BESIDE = Evidence(moved=MOVED, keyframes=keyframes(), geometry=BY_SHAPE)
PER_VOXEL = ("heights", "scores", "removed", "inferred")
OF_MAP = ("labels", "confidence", "states", "entropy", "removed_hits")


def assert_same(found: MapState, expected: MapState) -> None:
    for name in PER_VOXEL:
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), name)
    assert found.decided is not None
    assert expected.decided is not None
    np.testing.assert_array_equal(found.decided.voxels.keys, expected.decided.voxels.keys)
    for name in OF_MAP:
        np.testing.assert_array_equal(getattr(found.decided, name), getattr(expected.decided, name), name)
    assert (found.kerbs is None) == (expected.kerbs is None)
    if found.kerbs is not None and expected.kerbs is not None:
        for name in ("keys", "leaning", "known", "levels"):
            np.testing.assert_array_equal(getattr(found.kerbs, name), getattr(expected.kerbs, name), name)


def near(voxels: VoxelMap, block: Block, margin_m: float) -> VoxelMap:
    """The voxels of a block and of a margin, by their centres."""
    low, high = np.min(block, axis=0) * 102.4 - margin_m, (np.max(block, axis=0) + 1) * 102.4 + margin_m
    xy = voxels.centres[:, :2]
    return voxels[((xy > low) & (xy < high)).all(axis=1)]


def shape_near(block: Block, margin_m: float) -> GeometricEvidence:
    """What is said of the shape of a block and of a margin."""
    chosen = np.isin(BY_SHAPE.keys, near(VOXELS, block, margin_m).keys)
    return GeometricEvidence(BY_SHAPE.keys[chosen], BY_SHAPE.sums[chosen], BY_SHAPE.drives[chosen])


@pytest.mark.parametrize("block", [((3, 0),), ((3, 0), (4, 0))], ids=["tile", "block"])
@pytest.mark.parametrize("settings", [ALL, PAPER], ids=["evidence", "paper"])
def test_a_block_needs_no_more_of_the_map_than_its_halo(settings: RefinementSettings, block: Block) -> None:
    margin = halo_m(settings, SIZE_M)
    assert margin < 30
    part = near(VOXELS, block, margin)
    assert len(part) < len(VOXELS) * (len(block) + 1) / 6
    geometry = shape_near(block, geometry_halo_m(settings, SIZE_M))
    assert len(geometry.keys) < len(part)
    beside = replace(BESIDE, moved=near(MOVED, block, 0), geometry=geometry)
    sums = sums_of(block, VOXELS, BESIDE, settings)
    assert sums == sums_of(block, part, beside, settings)
    assert sums.roads > 0
    assert sums.moved > sums.moved_otherwise > 0
    whole, report = refine_block(block, VOXELS, BESIDE, settings, figures_of(sums))
    cut, of_cut = refine_block(block, part, beside, settings, figures_of(sums))
    assert_same(cut, whole)
    assert report.steps == of_cut.steps
    assert len(cut.voxels) == len(near(VOXELS, block, 0))


def test_the_map_is_the_sum_of_its_blocks_in_any_order() -> None:
    blocks = blocks_of(voxels_by_tile(VOXELS, MOVED))
    assert [len(block) for block in blocks] == [1, 2, 2, 2]
    sums = reduce(add, (sums_of(block, VOXELS, BESIDE, ALL) for block in reversed(blocks)))
    parts = [refine_block(block, VOXELS, BESIDE, ALL, figures_of(sums)) for block in reversed(blocks)]
    state, report = run_steps(VOXELS, ALL, BESIDE)
    of_parts = RefinementReport.joined([report for _, report in parts])
    assert of_parts.steps == report.steps
    assert of_parts.systematic_errors == report.systematic_errors > 0
    assert [thing.voxels for thing in of_parts.objects] == [thing.voxels for thing in report.objects]
    assert [thing.number for thing in report.objects] == list(range(len(report.objects)))
    assert state.decided is not None
    for block, (part, _) in zip(reversed(blocks), parts, strict=True):
        assert part.decided is not None
        places = state.decided.voxels.indices_of(part.decided.voxels.keys)
        assert (places >= 0).all()
        for name in OF_MAP:
            np.testing.assert_array_equal(getattr(part.decided, name), getattr(state.decided, name)[places])
        assert len(part.decided) == len(near(state.decided.voxels, block, 0))
    changed = {step.name: step.changed for step in report.steps}
    assert state.inferred.any()
    assert changed["geometric_labels"] > np.count_nonzero(state.inferred)
    assert changed["removed_layer"] == len(MOVED) - (VOXELS.indices_of(MOVED.keys) >= 0).sum()


def test_tiles_are_decided_alike_alone_and_in_a_block() -> None:
    block = ((3, 0), (4, 0))
    figures = figures_of(sums_of(block, VOXELS, BESIDE, ALL))
    together, of_block = refine_block(block, VOXELS, BESIDE, ALL, figures)
    alone = [refine_block((tile,), VOXELS, BESIDE, ALL, figures) for tile in block]
    assert together.decided is not None
    for name in ("labels", "states", "removed_hits"):
        of_tiles = [getattr(one.decided, name) for one, _ in alone]
        np.testing.assert_array_equal(np.concatenate(of_tiles), getattr(together.decided, name), name)
    assert RefinementReport.joined([report for _, report in alone]).steps == of_block.steps


def test_nobody_sees_where_blocks_meet() -> None:
    """The same street half a tile farther on: seams lie elsewhere, and cells of a metre lie the same."""
    moved_on = pack(VOXELS.indices + np.array([250, 0, 0]))
    moved_shape = replace(BY_SHAPE, keys=pack(unpack(BY_SHAPE.keys) + np.array([250, 0, 0])))
    here = run_steps(VOXELS, ALL, Evidence(geometry=BY_SHAPE))[0]
    there = run_steps(replace(VOXELS, keys=moved_on), ALL, Evidence(geometry=moved_shape))[0]
    assert here.decided is not None
    assert there.decided is not None
    assert (here.decided.labels == there.decided.labels).mean() > 0.999
    np.testing.assert_allclose(here.decided.confidence, there.decided.confidence, atol=0.05)


@pytest.mark.parametrize("along", [0, 1])
@pytest.mark.parametrize("before", [20, 100, 180])
def test_an_object_longer_than_a_halo_is_reported_once(along: int, before: int) -> None:
    """A row of cars of 40 m, a bit askew, of which so many voxels are before the border of two tiles."""
    row, across, up = (part.ravel() for part in np.meshgrid(range(200), range(9), range(1, 7), indexing="ij"))
    cars = np.stack([row + 512 - before, across + 105 - abs(row - 100) // 10, up], axis=1)
    road = np.stack(np.meshgrid(range(300, 724), range(80, 130), [0], indexing="ij"), -1).reshape(-1, 3)
    indices = np.concatenate([cars, road])
    classes = np.repeat([URBAN.index("vehicle"), URBAN.index("road")], [len(cars), len(road)])
    keys = pack(indices if along == 0 else indices[:, [1, 0, 2]])
    evidence = np.full((len(keys), len(URBAN.names)), -3000, np.int32)
    evidence[np.arange(len(keys)), classes] = 0
    order = np.argsort(keys)
    voxels = VoxelMap(SIZE_M, URBAN, keys[order], evidence[order], np.ones(len(keys), np.uint32))
    _, report = run_steps(voxels)
    [found] = report.objects
    assert found.tile == (0, 0)


counts = st.integers(0, 2**60)


@given(st.lists(counts, min_size=20, max_size=20))
def test_sums_add_exactly_and_come_back_from_json(numbers: list[int]) -> None:
    a, b = (Sums(*some) for some in (numbers[:10], numbers[10:]))
    assert a + b == b + a
    assert a + Sums() == a
    assert Sums.from_json(json.loads(json.dumps((a + b).to_json()))) == a + b


@pytest.mark.parametrize("change", [{"roads": -1}, {"roads": 1.5}, {"roads": True}, {"paths": 1}])
def test_sums_that_are_none_are_refused(change: dict[str, object]) -> None:
    with pytest.raises(ValueError, match="refine the map again"):
        Sums.from_json(Sums().to_json() | change)


def test_a_little_more_of_the_same_changes_no_figure() -> None:
    sums = Sums(
        100_000, 300_000_000, 9_100_000, 6_000_000, 1_200_000, 10**6, 200 * 10**6, 50_000, 30_000, 9, 10**6, 81_000,
    )  # fmt: skip
    more = Sums(900, 2_800_000, 80_000, 60_000, 11_000, 10**4, 2 * 10**6, 480, 310, 5, 10**4, 900)
    assert figures_of(sums) == figures_of(sums + more)
    assert figures_of(sums) != figures_of(sums + reduce(add, [replace(more, by_both=0)] * 50))
    assert figures_of(Sums()) == Figures(has_road=False)
