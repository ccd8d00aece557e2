"""What stands is hit from everywhere; what moved leaves voxels that scan after scan looks through."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import DENSE

from gnss_sem_map.dynamics import range_images, visibility
from gnss_sem_map.dynamics.visibility import POINTS_PER_BLOCK, KeyframeScans, KeyframeSelector, RangeImage
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.refinement import free_space
from gnss_sem_map.refinement.by_block import refine
from gnss_sem_map.refinement.free_space import FreeSpaceSettings, traversed
from gnss_sem_map.refinement.state import Evidence
from gnss_sem_map.refinement.steps import RefinementSettings
from gnss_sem_map.voxels.semantic_map import Reason, State
from gnss_sem_map.voxels.voxel_map import VoxelMap, VoxelTable, keys_of

URBAN = open_label_set()
EYE_M = 1.8
FACADE_M = 8.0


def ground_and_facades(eye_x: float) -> NDArray[np.float64]:
    """What a LiDAR at x sees of a long street with a facade on either side, in the map, without noise."""
    azimuths, elevations = np.meshgrid(
        np.radians(np.arange(0, 360, 0.2)), np.radians(np.arange(-24, 3, 0.42))
    )
    a, e = azimuths.ravel(), elevations.ravel()
    ray = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=1)
    with np.errstate(divide="ignore"):
        to_facade = FACADE_M / np.abs(ray[:, 1])
        to_ground = np.where(ray[:, 2] < 0, EYE_M / -ray[:, 2], np.inf)
    r = np.minimum(to_facade, to_ground)
    seen = r < 100
    return r[seen, None] * ray[seen] + [eye_x, 0, EYE_M]


def pose(eye_x: float) -> NDArray[np.float64]:
    T_map_lidar = np.eye(4)
    T_map_lidar[:3, 3] = eye_x, 0, EYE_M
    return T_map_lidar


def witness(eye_x: float) -> RangeImage:
    return RangeImage.of(ground_and_facades(eye_x), pose(eye_x), DENSE)


STREET = [float(x) for x in range(0, 30, 2)]
GHOST = np.column_stack([10.1 + 0.2 * np.arange(51), np.full(51, 3.1), np.full(51, 1.1)])
"""Where somebody walked, one point in each voxel."""


def street_map(*more: NDArray[np.float64]) -> VoxelMap:
    table = VoxelTable(0.2, URBAN)
    for points in (*(ground_and_facades(x) for x in STREET), *more):
        table.add(keys_of(np.ascontiguousarray(points), 0.2))
    return table.to_map()


def cleared(voxels: VoxelMap, settings: FreeSpaceSettings | None = None) -> NDArray[np.bool_]:
    witnesses = KeyframeScans.of([witness(x) for x in STREET])
    return traversed(voxels, witnesses, settings or FreeSpaceSettings())


def test_a_trail_is_cleared_and_what_stands_stays() -> None:
    voxels = street_map(GHOST)
    ghost = np.isin(voxels.keys, keys_of(GHOST, 0.2))
    assert ghost.sum() == 51
    empty = cleared(voxels)
    np.testing.assert_array_equal(empty, ghost)


def test_what_was_hit_often_stays_whoever_looks_through() -> None:
    """A fence is looked through and stands: it holds many points."""
    voxels = street_map(*[GHOST] * 100)
    assert not cleared(voxels).any()


@pytest.mark.parametrize(("hit_by", "goes"), [(2, True), (10, False)])
def test_what_more_scans_hit_than_see_through_stays(hit_by: int, goes: bool) -> None:
    voxels = street_map(GHOST)
    seen = [np.concatenate([ground_and_facades(x), GHOST[: 51 * (k < hit_by)]]) for k, x in enumerate(STREET)]
    witnesses = KeyframeScans.of(
        [RangeImage.of(points, pose(x), DENSE) for points, x in zip(seen, STREET, strict=True)]
    )
    empty = traversed(voxels, witnesses, FreeSpaceSettings())
    np.testing.assert_array_equal(empty, np.isin(voxels.keys, keys_of(GHOST, 0.2)) & goes)


def test_too_few_witnesses_clear_nothing_and_nothing_low_is_cleared(monkeypatch: pytest.MonkeyPatch) -> None:
    voxels = street_map(GHOST)
    assert not cleared(voxels, FreeSpaceSettings(least_misses=len(STREET) + 1)).any()
    monkeypatch.setattr(free_space, "OVER_M", (1.6, 3.0))
    assert not cleared(voxels).any()


@pytest.mark.parametrize("scans_per_part", [1, 3, 1000])
def test_it_does_not_matter_how_many_witnesses_are_asked_at_a_time(
    monkeypatch: pytest.MonkeyPatch, scans_per_part: int
) -> None:
    """Voxels that cannot become free are asked about no longer: the rest is decided by all scans."""
    voxels = street_map(GHOST)
    at_once = cleared(voxels)
    monkeypatch.setattr(visibility, "SCANS_PER_PART", scans_per_part)
    np.testing.assert_array_equal(cleared(voxels), at_once)
    assert at_once.any()
    assert not at_once.all()


@pytest.mark.parametrize("reach_m", [10.0, 40.0])
def test_only_near_witnesses_are_asked_and_none_is_missed(reach_m: float) -> None:
    """In a drive of kilometres most scans are far from a place: leaving them out changes nothing."""
    rng = np.random.default_rng(0)
    far = [float(x) for x in range(0, 2000, 20)]
    witnesses = KeyframeScans(
        np.stack([witness(0.0).image] * len(far)), np.linalg.inv([pose(x) for x in far]), DENSE
    )
    places = rng.uniform([0, -8, 0], [2000, 8, 3], (POINTS_PER_BLOCK + 5000, 3))
    places = places[np.argsort(places[:, 0])]
    assert visibility.are_near(witnesses.T_lidar_map, places[:1000], reach_m).sum() < len(far) / 5
    looks = visibility.hits_and_misses(places, witnesses, reach_m, visibility.WIDE_RATIO)
    hits, misses = np.zeros((2, len(places)), np.int32)
    range_images.count_hits_and_misses(
        places, witnesses.images, witnesses.T_lidar_map, DENSE.around, np.arange(len(far)), visibility.NEAREST_M,
        reach_m, visibility.MARGIN_M, visibility.WIDE_RATIO, hits, misses,
    )  # fmt: skip
    np.testing.assert_array_equal(looks, [hits, misses])
    assert looks.any(axis=1).all()


def test_the_refined_map_keeps_what_was_cleared_as_a_layer() -> None:
    voxels = street_map(GHOST)
    ghost = np.isin(voxels.keys, keys_of(GHOST, 0.2))
    witnesses = KeyframeScans.of([witness(x) for x in STREET])
    refined, report = refine(voxels, beside=Evidence(keyframes=witnesses))
    np.testing.assert_array_equal(refined.states == State.REMOVED, ghost)
    np.testing.assert_array_equal(refined.told_reasons, np.where(ghost, Reason.FREE_SPACE, Reason.NONE))
    assert {step.name: step.changed for step in report.steps}["free_space"] == ghost.sum()
    for settings, asked in ((RefinementSettings(free_space={"enabled": False}), witnesses), (None, None)):
        refined, report = refine(voxels, settings, Evidence(keyframes=asked))
        assert not (refined.states == State.REMOVED).any()
        assert next(step for step in report.steps if step.name == "free_space").skipped


def test_witnesses_are_two_metres_or_two_seconds_apart() -> None:
    """However long the drive stands or how fast it goes, they take no more memory than the map that they are for."""
    stood = [0.0] * 40 + [0.5 * k for k in range(1, 11)]
    along = KeyframeSelector()
    assert along.keyframes() is None
    for k, x in enumerate(stood):
        along.add(0.1 * k, RangeImage.of(np.empty((0, 3)), pose(x), DENSE))
    kept = along.keyframes()
    assert kept is not None
    x = np.linalg.inv(kept.T_lidar_map)[:, 0, 3]
    np.testing.assert_allclose(x, [0, 0, 0.5, 2.5, 4.5], atol=1e-9)


def test_a_border_of_tiles_changes_nothing_though_all_other_steps_are_off() -> None:
    """Beside x = 0 a ghost goes with the next one, beyond the border, which stands over ground yet one farther."""
    ghosts = np.array([(-0.1, 3.1, 1.1), *[(0.1, 3.1, 1.1)] * 5])
    ground = np.array([(-0.3, 3.1, 0.1), (0.3, 3.1, 0.1)])
    witnesses = KeyframeScans.of([witness(x - 15.0) for x in STREET])
    settings = RefinementSettings(
        **{
            name: {"enabled": False}
            for name in vars(RefinementSettings())
            if name not in ("free_space", "decision")
        }
    )
    for shift in (0.0, 0.2, 1.0):
        table = VoxelTable(0.2, URBAN)
        table.add(keys_of(np.concatenate([ghosts, ground]) + np.array([shift, 0.0, 0.0]), 0.2))
        refined, _ = refine(table.to_map(), settings, Evidence(keyframes=witnesses))
        np.testing.assert_array_equal(
            refined.states == State.REMOVED, refined.voxels.indices[:, 2] == 5, f"{shift}"
        )
