"""Two maps of one place, made in different frames, become the map of that place."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from factor_graphs.geodesy import LocalFrame
from gnss_sem_map import tiles
from gnss_sem_map.errors import DataError
from gnss_sem_map.labels import label_set
from gnss_sem_map.merging import into_frame, merge, merge_runs
from gnss_sem_map.refinement import refine
from gnss_sem_map.voxel_map import SemanticMap, State, VoxelMap, VoxelTable, keys_of

URBAN = label_set()
HERE, THERE = LocalFrame(49.011, 8.423, 112.0), LocalFrame(49.0135, 8.4275, 120.0)


def street(frame: LocalFrame, seed: int = 0, size: float = 0.2) -> VoxelMap:
    """A road and a facade at fixed places of the Earth, seen from a drive whose map has this origin."""
    rng = np.random.default_rng(seed)
    ground = np.column_stack([rng.uniform(-60, 60, (40_000, 2)), rng.normal(0, 0.01, 40_000)])
    wall = np.column_stack([rng.uniform(-60, 60, 20_000), np.full(20_000, 20.0), rng.uniform(0, 8, 20_000)])
    p_map = frame.to_map(*HERE.to_geodetic(np.vstack([ground, wall])))
    classes = np.array([[250, 1, 1, 1, 1, 1], [1, 1, 1, 250, 1, 1]], np.uint8)
    table = VoxelTable(size, URBAN)
    table.add(keys_of(p_map, size), np.repeat([0, 1], [40_000, 20_000]).astype(np.int32), classes)
    return table.to_map()


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
    far = second.centres[second.labels == URBAN.index("building")]
    assert np.abs(far[:, 1] - 20.0).min() > 100, "the frames must differ, or this test shows nothing"


def test_one_frame_is_added_exactly() -> None:
    first, second = street(HERE, 0), street(HERE, 1)
    merged, added = merge(first, second, HERE, LocalFrame(49.011, 8.423, 112.0)), first + second
    for name in ("keys", "evidence", "hits"):
        np.testing.assert_array_equal(getattr(merged, name), getattr(added, name))


def test_two_run_folders_merge_with_what_was_removed(tmp_path: Path) -> None:
    """Folders as a run writes them: `map` is everything, `refined` says what of it moved."""
    for name, frame, seed in (("a", HERE, 0), ("b", THERE, 1)):
        voxels = street(frame, seed)
        moved = voxels.labels == URBAN.index("building")
        refined, _ = refine(voxels[~moved], removed=voxels[moved])
        assert np.count_nonzero(refined.states == State.REMOVED) == moved.sum() > 0
        tiles.write(SemanticMap.of(voxels), tmp_path / name / "map", frame)
        tiles.write(refined, tmp_path / name / "refined", frame)
    stands, removed, frame = merge_runs(tmp_path / "a", tmp_path / "b")
    assert frame == HERE
    assert stands.hits.sum() + removed.hits.sum() == 120_000
    assert set(removed.labels) == {URBAN.index("building")}
    assert URBAN.index("building") not in stands.labels
    again, _ = refine(stands, removed=removed)
    assert np.count_nonzero(again.states == State.REMOVED) == np.count_nonzero(
        stands.places(removed.keys) < 0
    )


def test_maps_that_do_not_fit_together_are_refused() -> None:
    with pytest.raises(DataError, match="without a georeference"):
        merge(street(HERE), street(HERE), HERE, None)
    with pytest.raises(DataError, match=r"0\.4 m voxels"):
        merge(street(HERE), street(HERE, size=0.4), HERE, HERE)
    with pytest.raises(DataError, match="not inside the map"):
        merge(street(HERE), street(HERE), HERE, LocalFrame(-33.9, 18.4, 0.0))
