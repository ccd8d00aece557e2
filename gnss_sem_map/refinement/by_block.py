"""Refinement block by block: from its voxels, those in a halo around it, and figures of the whole map.

A map is refined in two passes. The first adds up `sums_of` every block, in any order; `figures_of` the sums are what a
block must know of the whole map. The second refines every block for itself. All maps are refined so, those in memory
too: what comes out depends neither on the order of the blocks nor on who refines which.

Before a step, the block is cut down to what this step and the later ones reach. So the steps see the same in a map of
any size, and the work in the halo shrinks from step to step.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import reduce
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.process.memory import release_memory
from gnss_sem_map.refinement import (
    count_grid,
    geometric_prior,
    height_above_ground,
    kerb_points,
    removed_layer,
    systematic_error,
    vehicles,
)
from gnss_sem_map.refinement.figures import Figures, Sums, figures_of
from gnss_sem_map.refinement.state import Evidence, MapState, NotApplicable
from gnss_sem_map.refinement.steps import STEPS, RefinementReport, RefinementSettings, do
from gnss_sem_map.voxels.blocks import Block, blocks_of
from gnss_sem_map.voxels.semantic_map import SemanticMap
from gnss_sem_map.voxels.tile_files import Tile
from gnss_sem_map.voxels.tiles import indices_by_tile, joined, joined_voxels, places_around
from gnss_sem_map.voxels.voxel_map import VoxelMap

WORTH_CUTTING_M = 2.0
"""The halo is cut down by no less than this at a time: cutting is work, too."""


def halo_m(settings: RefinementSettings, voxel_size_m: float) -> float:
    """How far around a block voxels are read to refine it, m: for its height over ground, and for all steps."""
    return max(
        height_above_ground.REACH_M + _reach_from(0, settings, voxel_size_m),
        sums_halo_m(settings, voxel_size_m),
    )


def geometry_halo_m(settings: RefinementSettings, voxel_size_m: float) -> float:
    """How far around a block the geometric classifier is asked, m."""
    names = [step.name for step in STEPS]
    return _reach_from(names.index("geometric_labels"), settings, voxel_size_m)


def sums_halo_m(settings: RefinementSettings, voxel_size_m: float) -> float:
    """How far around a block voxels are read for its sums, m."""
    return height_above_ground.REACH_M + _sums_reach_m(settings, voxel_size_m)


def sums_of(block: Block, around: VoxelMap, beside: Evidence, settings: RefinementSettings) -> Sums:
    """What a block adds to the figures of the map, from its voxels and those of its halo, and what moved there."""
    size = around.voxel_size_m
    around = around[places_around(around, block, sums_halo_m(settings, size))]
    heights = height_above_ground.height_over_ground(around.centres)
    near = places_around(around, block, _sums_reach_m(settings, size))
    state = MapState.of(around[near], beside, heights=heights[near])
    state, _ = do(STEPS[0], state, settings)
    images = state.scores
    state, _ = do(STEPS[1], state, settings)
    own, sums = _inside(state.voxels, block), Sums()
    moved = None if beside.moved is None else beside.moved[places_around(beside.moved, block, 0)]
    measured = (
        (
            settings.systematic_error,
            lambda: systematic_error.measure(state, images, settings.systematic_error, own),
        ),
        (settings.count_grid, lambda: count_grid.measure(state, settings.count_grid, own)),
        (settings.vehicles, lambda: vehicles.measure(state, settings.vehicles, own)),
        (settings.removed_layer, lambda: removed_layer.measure(moved)),
    )
    for section, measure in measured:
        try:
            sums += measure() if section.enabled else Sums()
        except NotApplicable:
            continue  # the step will say so
    return sums


def refine_block(
    block: Block, around: VoxelMap, beside: Evidence, settings: RefinementSettings, figures: Figures
) -> tuple[MapState, RefinementReport]:
    """Refine a block, from its static voxels and those of its halo: the last state of the block alone, decided.

    Of what is `around` and `beside` the block there may be more than its halo. The report counts changes and objects of
    the block alone; reports of blocks add up.
    """
    size, reports = around.voxel_size_m, []
    halo = _reach_from(0, settings, size)
    if beside.moved is not None:
        beside = replace(beside, moved=beside.moved[places_around(beside.moved, block, halo)])
    around = around[places_around(around, block, halo_m(settings, size))]
    heights, near = height_above_ground.height_over_ground(around.centres), places_around(around, block, halo)
    around, heights = around[near], heights[near]
    state = MapState.of(around, beside, figures, heights)
    del around  # 50 MB: the steps see less and less of it
    own = _inside(state.voxels, block)
    for i, step in enumerate(STEPS):
        release_memory()  # of the steps before
        needed = _reach_from(i, settings, size)
        if halo - needed >= WORTH_CUTTING_M or needed == 0 < halo:
            state, halo = _cut(state, block, needed), needed
            own = _inside(state.voxels, block)
        state, report = do(step, state, settings, own if halo else None)
        reports.append(report)
    assert state.decided is not None
    # of a long object every block sees another part, with another centre; but blocks that meet see the same first tile
    state = replace(state, vehicles=tuple(thing for thing in state.vehicles if thing.tile in block))
    return state, RefinementReport(tuple(reports), state.vehicles, systematic_errors=state.systematic_error)


def refine(
    voxels: VoxelMap, settings: RefinementSettings | None = None, beside: Evidence | None = None
) -> tuple[SemanticMap, RefinementReport]:
    """Refine a map in memory; no voxel is deleted, and what no camera saw stays unlabelled unless it is inferred."""
    state, report = run_steps(voxels, settings, beside)
    assert state.decided is not None
    return state.decided, report


def run_steps(
    voxels: VoxelMap, settings: RefinementSettings | None = None, beside: Evidence | None = None
) -> tuple[MapState, RefinementReport]:
    """Refine a map in memory, block by block: the last state, decided, and what each step changed."""
    settings, beside = settings or RefinementSettings(), beside or Evidence()
    blocks = blocks_of(voxels_by_tile(*(one for one in (voxels, beside.moved) if one is not None)))
    sums = sum((sums_of(block, voxels, beside, settings) for block in blocks), Sums())
    figures = figures_of(sums)
    parts = [refine_block(block, voxels, beside, settings, figures) for block in blocks]
    report = RefinementReport.joined([report for _, report in parts])
    return replace(_joined([state for state, _ in parts]), vehicles=report.objects), report


def voxels_by_tile(*maps: VoxelMap) -> dict[Tile, int]:
    """How many voxels the maps have together in each tile that has one."""
    keys = reduce(np.union1d, (voxels.keys for voxels in maps))
    return {tile: len(places) for tile, places in indices_by_tile(keys)}


def _sums_reach_m(settings: RefinementSettings, voxel_size_m: float) -> float:
    measured = (
        systematic_error.measure_reach_m(voxel_size_m),
        count_grid.reach_m(settings.count_grid, voxel_size_m),
    )
    return geometric_prior.reach_m(settings.geometric_prior, voxel_size_m) + max(measured)


def _reach_from(first: int, settings: RefinementSettings, voxel_size_m: float) -> float:
    """How far a step and those after it reach, of those that are switched on."""
    reaches = ((step.settings(settings), step.reach_m) for step in STEPS[first:])
    return sum((reach(section, voxel_size_m) for section, reach in reaches if section.enabled), 0.0)


def _inside(voxels: VoxelMap, block: Block) -> NDArray[np.bool_]:
    """Which voxels (v,) lie in a block."""
    inside = np.zeros(len(voxels), np.bool_)
    inside[places_around(voxels, block, 0)] = True
    return inside


def _cut(state: MapState, block: Block, margin_m: float) -> MapState:
    """The state of a block and a margin around it, and what moved there."""
    if (moved := state.beside.moved) is not None:
        moved = moved[places_around(moved, block, margin_m)]
    return replace(
        state[places_around(state.voxels, block, margin_m)], beside=replace(state.beside, moved=moved)
    )


def _joined(parts: Sequence[MapState]) -> MapState:
    """The state of a map, of those of its blocks."""
    if len(parts) == 1:
        return parts[0]
    keys = np.concatenate([part.voxels.keys for part in parts])
    order = np.argsort(keys, kind="stable")  # quick: sorted parts

    def column(of: Callable[[MapState], NDArray[Any]]) -> NDArray[Any]:
        return np.concatenate([of(part) for part in parts])[order]

    first = parts[0].voxels
    voxels = joined_voxels([part.voxels for part in parts], first.voxel_size_m, first.label_set)
    return replace(
        parts[0],
        voxels=voxels,
        heights=column(lambda part: part.heights),
        scores=column(lambda part: part.scores),
        removed=column(lambda part: part.removed),
        inferred=column(lambda part: part.inferred),
        kerbs=kerb_points.joined([part.kerbs for part in parts if part.kerbs is not None]),
        decided=_map_of([part.decided for part in parts if part.decided is not None]),
    )


def _map_of(parts: Sequence[SemanticMap]) -> SemanticMap:
    voxels = parts[0].voxels
    order = np.argsort(np.concatenate([part.voxels.keys for part in parts]), kind="stable")
    entropy = [part.entropy for part in parts if part.entropy is not None]
    return replace(
        joined(parts, voxels.voxel_size_m, voxels.label_set), entropy=np.concatenate(entropy)[order]
    )
