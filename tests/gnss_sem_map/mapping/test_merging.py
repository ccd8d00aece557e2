"""Two maps of one place, made in different frames, become the map of that place."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from chunks import assert_same
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from surfaces import heights_in_voxels

from factor_graphs.geodesy import LocalFrame
from gnss_sem_map.errors import DataError
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.mapping import evidence
from gnss_sem_map.mapping.merging import align, into_frame, merge, merge_runs
from gnss_sem_map.mapping.raw_map import MAP, open_raw
from gnss_sem_map.refinement.by_block import refine
from gnss_sem_map.refinement.crumbs import CrumbSettings
from gnss_sem_map.refinement.state import Evidence
from gnss_sem_map.refinement.steps import RefinementSettings
from gnss_sem_map.voxels import tiles
from gnss_sem_map.voxels.attributes import ATTRIBUTES, Attributes, open_attributes
from gnss_sem_map.voxels.attributes import write as write_attributes
from gnss_sem_map.voxels.semantic_map import SemanticMap, State
from gnss_sem_map.voxels.tiles import indices_by_tile
from gnss_sem_map.voxels.voxel_map import VoxelMap, VoxelTable, keys_of

URBAN = open_label_set()
HERE, THERE = LocalFrame(49.011, 8.423, 112.0), LocalFrame(49.0135, 8.4275, 120.0)


def street(frame: LocalFrame, seed: int = 0, size: float = 0.2) -> VoxelMap:
    """A road and a facade at fixed places of the Earth, seen from a drive whose map has this origin."""
    rng = np.random.default_rng(seed)
    ground = np.column_stack([rng.uniform(-60, 60, (40_000, 2)), rng.normal(0, 0.01, 40_000)])
    wall = np.column_stack([rng.uniform(-60, 60, 20_000), np.full(20_000, 20.0), rng.uniform(0, 8, 20_000)])
    p_map = frame.to_map(*HERE.to_geodetic(np.vstack([ground, wall])))
    classes = np.array([[250, 1, 1, 1, 1, 1], [1, 1, 1, 250, 1, 1]], np.uint8)
    table = VoxelTable(size, URBAN)
    pixels = np.repeat([0, 1], [40_000, 20_000]).astype(np.int32)
    table.add(keys_of(p_map, size), pixels, classes, heights_in_voxels(p_map[:, 2], size))
    return table.to_map()


def write_run(run: Path, static: VoxelMap, moved: VoxelMap, frame: LocalFrame) -> None:
    """The raw map of a run folder."""
    tiles.write(SemanticMap.of(static + moved), run / MAP, frame)
    tiles.write(SemanticMap.of(moved), run / evidence.FOLDER / evidence.MOVED, frame)


def test_two_frames_become_one() -> None:
    """The facade of the second drive stands where that of the first does, to a voxel, and nothing is lost."""
    first, second = street(HERE, 0), street(THERE, 1)
    merged = merge(first, second, HERE, THERE)
    assert merged.hits.sum() == 120_000
    np.testing.assert_array_equal(merged.evidence.sum(axis=0), first.evidence.sum(0) + second.evidence.sum(0))
    moved = into_frame(second, THERE, HERE)
    for voxels in (first, moved):
        wall = voxels.centres[voxels.labels == URBAN.index("building")]
        assert np.abs(wall[:, 1] - 20.0).max() < 0.31
        road = voxels.surface_heights[voxels.labels == URBAN.index("road")]
        assert np.percentile(np.abs(road), 99) < 0.04
    far = second.centres[second.labels == URBAN.index("building")]
    assert np.abs(far[:, 1] - 20.0).min() > 100, "the frames must differ, or this test shows nothing"


def test_one_frame_is_added_exactly() -> None:
    first, second = street(HERE, 0), street(HERE, 1)
    merged, added = merge(first, second, HERE, LocalFrame(49.011, 8.423, 112.0)), first + second
    for name in ("keys", "evidence", "hits"):
        np.testing.assert_array_equal(getattr(merged, name), getattr(added, name))


def test_two_run_folders_merge_with_what_was_removed(tmp_path: Path) -> None:
    """Folders as a run writes them: `map` is everything, `evidence` says what of it moved; crumbs are left alone."""
    settings = RefinementSettings(crumbs=CrumbSettings(enabled=False))
    for name, frame, seed in (("a", HERE, 0), ("b", THERE, 1)):
        voxels = street(frame, seed)
        moved = voxels.labels == URBAN.index("building")
        refined, _ = refine(voxels[~moved], settings, Evidence(moved=voxels[moved]))
        assert np.count_nonzero(refined.states == State.REMOVED) == moved.sum() > 0
        write_run(tmp_path / name, voxels[~moved], voxels[moved], frame)
    runs = merge_runs(tmp_path / "a", tmp_path / "b", match=False)
    static, removed = runs.static, runs.moved
    assert runs.frame == HERE
    assert static.hits.sum() + removed.hits.sum() == 120_000
    assert set(removed.labels) == {URBAN.index("building")}
    assert URBAN.index("building") not in static.labels
    again, _ = refine(static, settings, Evidence(moved=removed))
    assert np.count_nonzero(again.states == State.REMOVED) == np.count_nonzero(
        static.indices_of(removed.keys) < 0
    )


def test_merged_runs_keep_moving_points_in_static_voxels_apart(tmp_path: Path) -> None:
    """The same run twice: twice the evidence of static points and of moving points, also in voxels of both."""
    static, moved = street(HERE, 0), street(HERE, 1)
    for name in ("a", "b"):
        write_run(tmp_path / name, static, moved, HERE)
    runs = merge_runs(tmp_path / "a", tmp_path / "b", match=False)
    for found, once in ((runs.static, static), (runs.moved, moved)):
        np.testing.assert_array_equal(found.keys, once.keys)
        np.testing.assert_array_equal(found.hits, 2 * once.hits)
        np.testing.assert_array_equal(found.evidence, 2 * once.evidence)
    (tmp_path / "merged").mkdir()
    runs.write_raw(tmp_path / "merged")
    raw = open_raw(tmp_path / "merged", URBAN)
    assert_same(raw.fused.whole().voxels, runs.static + runs.moved)
    assert_same(raw.evidence.moved.whole().voxels, runs.moved)


def test_attributes_move_as_the_map_does(tmp_path: Path) -> None:
    """The second frame is half a voxel higher: centres come to lie where voxels meet, and last bits decide."""
    frames = LocalFrame(49, 8.4, 110.0), LocalFrame(49, 8.4, 110.1)
    for name, frame, seed in zip("ab", frames, (0, 1), strict=True):
        static, moved = street(HERE, seed), street(HERE, seed)[:0]
        write_run(tmp_path / name, static, moved, frame)
        points, of_tiles = static.hits.astype(np.int64), indices_by_tile(static.keys)
        known = Attributes(static.keys, points, np.ones_like(points), np.zeros(len(points), np.uint8))
        write_attributes(((tile, known[rows]) for tile, rows in of_tiles), tmp_path / name / ATTRIBUTES)
    (tmp_path / "merged").mkdir()
    merge_runs(tmp_path / "a", tmp_path / "b", match=False).write_raw(tmp_path / "merged")
    merged, attributes = (
        open_raw(tmp_path / "merged", URBAN).fused.whole(),
        open_attributes(tmp_path / "merged"),
    )
    assert attributes is not None
    np.testing.assert_array_equal(attributes.whole().keys, merged.voxels.keys)
    np.testing.assert_array_equal(attributes.whole().points, merged.voxels.hits)


def test_maps_of_different_runs_in_one_folder_are_refused(tmp_path: Path) -> None:
    write_run(tmp_path / "a", street(HERE, 0), street(HERE, 1), HERE)
    write_run(tmp_path / "b", street(HERE, 2), street(HERE, 0), HERE)
    shutil.rmtree(tmp_path / "a" / "map")
    (tmp_path / "b" / "map").rename(tmp_path / "a" / "map")
    with pytest.raises(DataError, match="not of one run"):
        merge_runs(tmp_path / "a", tmp_path / "a")


def corner(seed: int, length_m: float = 60.0) -> NDArray[np.float64]:
    """Points on a road between two facades, and on one across its end; other ones for every seed."""
    rng = np.random.default_rng(seed)
    noise = rng.normal(0, 0.01, (4, 20_000))
    along = rng.uniform(0, length_m, (3, 20_000))
    up, across = rng.uniform(0, 8, (3, 20_000)), rng.uniform(-8, 8, (2, 20_000))
    return np.vstack(
        [
            np.column_stack([along[0], across[0], 0.1 + noise[0]]),
            np.column_stack([along[1], -8.1 + noise[1], up[0]]),
            np.column_stack([along[2], 8.1 + noise[2], up[1]]),
            np.column_stack([length_m + 0.1 + noise[3], across[1], up[2]]),
        ]
    )


def voxels_of(p_map: NDArray[np.float64], label: str = "building") -> VoxelMap:
    table = VoxelTable(0.2, URBAN)
    classes = np.ones((1, 6), np.uint8)
    classes[0, URBAN.index(label)] = 250
    table.add(keys_of(p_map, 0.2), np.zeros(len(p_map), np.int32), classes)
    return table.to_map()


OFF = np.eye(4)
OFF[:3, :3] = Rotation.from_euler("zx", [0.3, 0.1], degrees=True).as_matrix()
OFF[:3, 3] = 0.6, -0.4, 0.3


def test_the_second_map_is_registered_to_the_first() -> None:
    """Two drives of one place, the second's positions off by 0.8 m: its surfaces come back to a few centimetres."""
    there = (corner(1) - OFF[:3, 3]) @ OFF[:3, :3]  # OFF brings it back
    first, second = voxels_of(corner(0)), voxels_of(there)
    alignment = align(first, second, HERE, HERE)
    assert alignment.match is not None, alignment.reason
    back = there @ alignment.match.T_target_source[:3, :3].T + alignment.match.T_target_source[:3, 3]
    assert np.abs(back - corner(1)).max() < 0.05
    assert alignment.overlap[1] > alignment.overlap[0] + 0.3
    together = merge(first, second, HERE, HERE, alignment.match.T_target_source)
    assert len(together) < 0.75 * len(merge(first, second, HERE, HERE))
    assert together.hits.sum() == first.hits.sum() + second.hits.sum()


def test_a_street_without_an_end_is_not_moved_along_itself() -> None:
    """Nothing tells how far along: there the georeference stays, across the street the facades decide."""
    street = corner(0)[:60_000]  # without the facade across
    middle = (street[:, 0] > 10) & (street[:, 0] < 50)  # its ends would tell
    second = voxels_of(corner(1)[:60_000][middle] + np.array([0.5, 0.5, 0.2]))
    alignment = align(voxels_of(street), second, HERE, HERE)
    assert alignment.match is not None, alignment.reason
    np.testing.assert_allclose(alignment.match.T_target_source[:3, :3], np.eye(3), atol=2e-3)
    centre = np.append(second.centres.mean(axis=0), 1)
    moved = alignment.match.T_target_source @ centre - centre
    assert abs(moved[0]) < 0.05
    np.testing.assert_allclose(moved[1:3], [-0.5, -0.2], atol=0.05)


def test_parked_cars_do_not_hold_a_map() -> None:
    """Cars that were parked elsewhere the second time are left out of the registration."""
    rng = np.random.default_rng(5)
    cars = [rng.uniform([10 * k, 3, 0], [10 * k + 4, 5, 1.5], (4_000, 3)) for k in range(1, 5)]
    first, second = (
        voxels_of(corner(seed)) + voxels_of(np.vstack(cars) + np.array([shift, 0, 0]), "vehicle")
        for seed, shift in ((0, 0.0), (1, 1.0))
    )
    alignment = align(first, second, HERE, HERE)
    assert alignment.match is None or alignment.match.shift_m < 0.02


def test_maps_that_share_nothing_lie_by_their_georeference() -> None:
    elsewhere = voxels_of(corner(1) + np.array([300, 0, 0]))
    alignment = align(voxels_of(corner(0)), elsewhere, HERE, HERE)
    assert alignment.match is None
    assert "lie within" in alignment.reason
    assert alignment.overlap == (0.0, 0.0)
    few = align(voxels_of(corner(0)[:100]), elsewhere, HERE, HERE)
    assert "less than 300 voxels" in few.reason


def test_maps_that_do_not_fit_together_are_refused() -> None:
    with pytest.raises(DataError, match="without a georeference"):
        merge(street(HERE), street(HERE), HERE, None)
    with pytest.raises(DataError, match=r"0\.4 m voxels"):
        merge(street(HERE), street(HERE, size=0.4), HERE, HERE)
    with pytest.raises(DataError, match="not inside the map"):
        merge(street(HERE), street(HERE), HERE, LocalFrame(-33.9, 18.4, 0.0))
