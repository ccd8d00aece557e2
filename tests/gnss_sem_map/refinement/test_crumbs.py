"""Crumbs go with the mover that left them; what stands beside it, and the ground under it, stay."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from surfaces import with_heights

from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.refinement.by_block import refine, run_steps
from gnss_sem_map.refinement.columns import points_between
from gnss_sem_map.refinement.crumbs import CrumbSettings, apply
from gnss_sem_map.refinement.state import Evidence, MapState
from gnss_sem_map.refinement.surroundings import points_around
from gnss_sem_map.voxels.semantic_map import Reason, SemanticMap, State
from gnss_sem_map.voxels.tile_files import TILE_BITS
from gnss_sem_map.voxels.voxel_map import VoxelMap, pack

URBAN = open_label_set()
MANY = 100


def voxel_map(indices: NDArray[np.int64], hits: NDArray[np.int64]) -> VoxelMap:
    keys = pack(indices)
    order = np.argsort(keys)
    evidence = np.zeros((len(keys), len(URBAN.names)), np.int32)
    return VoxelMap(0.2, URBAN, keys[order], evidence, hits[order].astype(np.uint32))


def box(low: tuple[int, int, int], high: tuple[int, int, int]) -> NDArray[np.int64]:
    return np.stack(
        np.meshgrid(*(np.arange(a, b) for a, b in zip(low, high, strict=True)), indexing="ij"), -1
    ).reshape(-1, 3)


ROAD = box((0, 0, 0), (40, 20, 1))
WALL = box((0, 18, 1), (40, 19, 12))
MOVER = box((10, 5, 2), (20, 10, 8))
CRUMBS = np.array([[9, 5, 2], [20, 9, 7], [15, 10, 3], [15, 7, 8]])
"""Beside the voxels of the mover."""


def shifted(indices: NDArray[np.int64], x: int) -> NDArray[np.int64]:
    return np.asarray(indices + np.array([x, 0, 0]), np.int64)


def street(*crumbs: NDArray[np.int64], shift: int = 0) -> tuple[VoxelMap, VoxelMap]:
    """A road, a wall, and crumbs of two points each; and the mover."""
    solid, loose = np.concatenate([ROAD, WALL]), np.concatenate([np.empty((0, 3), np.int64), *crumbs])
    hits = np.repeat([MANY, 2], [len(solid), len(loose)])
    static = voxel_map(shifted(np.concatenate([solid, loose]), shift), hits)
    return static, voxel_map(shifted(MOVER, shift), np.full(len(MOVER), 3))


def removed(static: VoxelMap, moved: VoxelMap, most_points: int = 16) -> NDArray[np.bool_]:
    state = replace(MapState.of(static, Evidence(moved=moved)), decided=SemanticMap.of(static))
    return apply(state, CrumbSettings(most_points=most_points)).is_removed


def test_crumbs_go_and_wall_and_road_stay() -> None:
    static, moved = street(CRUMBS)
    np.testing.assert_array_equal(static.keys[removed(static, moved)], np.sort(pack(CRUMBS)))


def test_the_ground_under_a_mover_stays_however_seldom_it_is_seen() -> None:
    static, _ = street()
    seldom = voxel_map(static.indices.astype(np.int64), np.ones(len(static), np.int64))
    over = voxel_map(MOVER - [0, 0, 1], np.full(len(MOVER), 50))
    assert not removed(seldom, over).any()


@pytest.mark.parametrize(
    ("ground_m", "inside_m", "goes"),
    [(0.19, 0.01, False), (0.19, 0.1, True), (0.16, 0.01, True), (0.1, 0.01, True)],
)
def test_ground_that_touches_two_voxels_stays_and_a_crumb_on_it_goes(
    ground_m: float, inside_m: float, goes: bool
) -> None:
    """Ground under the mover, just at the edge of two voxels: few of its points are in the upper one.

    What is there but far over the ground is none of it.
    """
    upper = np.array([[15, 7, 1]])
    static, _ = street(upper)
    z = static.centres[:, 2] + ground_m - 0.1
    z[static.indices_of(pack(upper))] = 0.2 + inside_m
    over = voxel_map(MOVER - [0, 0, 1], np.full(len(MOVER), 50))
    removed_here = removed(with_heights(static, z), over)
    np.testing.assert_array_equal(static.keys[removed_here], pack(upper)[: int(goes)])


def test_what_has_many_points_stays_and_so_does_what_is_far_from_the_mover() -> None:
    static, moved = street(CRUMBS)
    assert not removed(static, moved, most_points=1).any()
    static, moved = street(*[np.array([[30, 8, k]]) for k in (3, 4, 5)])
    assert not removed(static, moved).any()


LORRY_TOP, BRANCH, OVER_LORRY = (np.array([at]) for at in ([15, 7, 14], [30, 8, 14], [15, 7, 22]))
"""2.8 m over the road, but only one where something moved, and 4.4 m."""


@pytest.mark.parametrize(
    ("what", "points", "ground", "goes"),
    [
        (np.array([[30, 8, 4]]), 2, MANY, True),
        (np.array([[30, 8, 4]]), 6, MANY, False),
        (np.array([[30, 8, 4]]), 2, 30, False),
        (LORRY_TOP, 2, MANY, True),
        (BRANCH, 2, MANY, False),
        (OVER_LORRY, 2, MANY, False),
    ],
)
def test_what_was_gone_whenever_the_ground_under_it_was_seen_goes(
    what: NDArray[np.int64], points: int, ground: int, goes: bool
) -> None:
    """Far from any mover up to the height of a person, and up to that of a lorry over what moved."""
    solid = np.concatenate([ROAD, WALL])
    static = voxel_map(np.concatenate([solid, what]), np.r_[np.full(len(solid), ground), points])
    _, moved = street()
    np.testing.assert_array_equal(static.keys[removed(static, moved)], pack(what)[: int(goes)])


def test_the_edge_of_what_stands_stays_over_ground_that_is_seen_beside_it() -> None:
    """A voxel at the edge of a roof: of what stands in the columns around it there is more than enough."""
    parked, edge = box((25, 8, 1), (35, 12, 7)), np.array([[24, 9, 7]])
    static = voxel_map(np.concatenate([ROAD, parked, edge]), np.r_[np.full(len(ROAD) + len(parked), MANY), 2])
    _, moved = street()
    assert not removed(static, moved).any()


def test_a_walker_before_a_wall_leaves_no_crumbs_and_the_wall_stays_where_it_is_seen_seldom() -> None:
    """The wall has more points than moved around it, but not in the columns of the walker."""
    walker, seldom = box((14, 17, 2), (17, 18, 9)), np.array([[13, 18, 12], [20, 18, 12]])
    left = np.array([[15, 17, 4], [16, 17, 9]])
    static, _ = street(left, seldom)
    moved = voxel_map(walker, np.full(len(walker), 1))
    np.testing.assert_array_equal(static.keys[removed(static, moved)], np.sort(pack(left)))


def test_what_hangs_where_no_ground_is_seen_stays() -> None:
    """A voxel of a wall that hides its own ground, however much passed there."""
    part = np.array([[15, 30, 3]])
    wall = box((10, 31, 0), (20, 32, 12))
    solid = np.concatenate([ROAD, wall])
    static = voxel_map(np.concatenate([solid, part]), np.r_[np.full(len(solid), MANY), 2])
    moved = voxel_map(np.array([[15, 30, 4]]), np.array([9]))
    assert not removed(static, moved).any()


def test_points_between_two_heights_of_a_column_are_counted() -> None:
    rng = np.random.default_rng(0)
    indices = np.unique(rng.integers(-5, 5, (300, 3)), axis=0)
    voxels = voxel_map(indices, rng.integers(1, 9, len(indices)))
    off = voxels.indices[None] - voxels.indices[:, None]
    inside = (off[..., :2] == 0).all(axis=2) & (off[..., 2] >= -3) & (off[..., 2] <= 1)
    np.testing.assert_array_equal(
        points_between(voxels.keys, voxels.keys, voxels.hits, -3, 1), inside @ voxels.hits
    )


def test_a_part_of_what_stands_beside_the_mover_stays() -> None:
    """A voxel of few points at the side of a parked car: more of what is around it stands than moved."""
    parked = box((10, 11, 1), (20, 15, 7))
    static = voxel_map(
        np.concatenate([ROAD, parked, [[12, 10, 3]]]), np.r_[np.full(len(ROAD) + len(parked), MANY), 2]
    )
    _, moved = street()
    assert not removed(static, moved).any()


@pytest.mark.parametrize("seed", range(3))
def test_points_around_are_counted(seed: int) -> None:
    rng = np.random.default_rng(seed)
    voxels = voxel_map(np.unique(rng.integers(-6, 6, (300, 3)), axis=0), rng.integers(1, 9, 300))
    asked = np.unique(pack(rng.integers(-7, 7, (100, 3))))
    shown = VoxelMap(0.2, URBAN, asked, np.zeros((len(asked), 5), np.int32), np.ones(len(asked), np.uint32))
    near = abs(shown.indices[:, None] - voxels.indices[None]).max(axis=2) <= 1
    np.testing.assert_array_equal(points_around(asked, voxels.keys, voxels.hits), near @ voxels.hits)


def test_the_refined_map_holds_crumbs_as_removed_and_counts_them_as_such() -> None:
    static, moved = street(CRUMBS)
    refined, report = refine(static, beside=Evidence(moved=moved))
    assert {step.name: step.changed for step in report.steps}["crumbs"] == len(CRUMBS)
    gone = refined.voxels.keys[refined.states == State.REMOVED]
    np.testing.assert_array_equal(gone, np.union1d(pack(CRUMBS), moved.keys))
    for reason, keys in ((Reason.CRUMB, pack(CRUMBS)), (Reason.MOVED, moved.keys)):
        np.testing.assert_array_equal(refined.voxels.keys[refined.told_reasons == reason], np.sort(keys))
    assert refined.removed_hits.sum() == moved.hits.sum() + 2 * len(CRUMBS)
    assert refined.voxels.hits.sum() == moved.hits.sum() + static.hits.sum()


@pytest.mark.parametrize("cut_at", [9, 10, 15, 19, 20])
def test_the_edge_of_a_tile_changes_nothing(cut_at: int) -> None:
    """Between two tiles a mover leaves the same crumbs as in one."""
    shift = (1 << TILE_BITS) - cut_at
    static, moved = street(CRUMBS, shift=shift)
    state, report = run_steps(static, beside=Evidence(moved=moved))
    assert state.decided is not None
    gone = state.decided.voxels.keys[state.decided.states == State.REMOVED]
    np.testing.assert_array_equal(gone, np.union1d(pack(shifted(CRUMBS, shift)), moved.keys))
    assert np.count_nonzero(state.decided.told_reasons == Reason.CRUMB) == len(CRUMBS)
    assert {step.name: step.changed for step in report.steps}["crumbs"] == len(CRUMBS)
