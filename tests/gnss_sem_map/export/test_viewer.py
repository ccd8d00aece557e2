"""The viewer page: its structure."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from viewer_pages import decoded, hostile, written

from factor_graphs.trajectory import Trajectory
from gnss_sem_map.errors import DataError
from gnss_sem_map.export.viewer import write_viewer
from gnss_sem_map.voxels.semantic_map import SemanticMap, State
from gnss_sem_map.voxels.tiles import in_memory


def test_the_page_holds_every_voxel_with_its_class_confidence_and_state(
    street: SemanticMap, track: Trajectory, tmp_path: Path
) -> None:
    meta, indices, about = decoded(written(tmp_path, street, track))
    rows = np.lexsort(indices.T[::-1])
    np.testing.assert_array_equal(indices[rows], street.voxels.indices)
    labels = np.where(street.labels < 0, 6, street.labels)
    np.testing.assert_array_equal(about[rows, 0], labels)
    np.testing.assert_allclose(about[rows, 1] / 255, street.confidence, atol=0.5 / 255 + 1e-6)
    np.testing.assert_array_equal(about[rows, 2], street.states)
    assert [c["count"] for c in meta["classes"]] == [
        int((street.labels[street.shown] == i).sum()) for i in range(6)
    ]
    assert meta["inferred"] == street.inferred.sum()
    assert meta["removed"] == (street.states == State.REMOVED).sum()
    (line,) = meta["tracks"]
    path = (np.array(line) + meta["origin"]) * meta["voxel_m"]
    np.testing.assert_allclose(path, track.positions, atol=0.002)


def test_the_page_asks_the_network_for_nothing(
    street: SemanticMap, track: Trajectory, tmp_path: Path
) -> None:
    page = written(tmp_path, street, track)
    assert "default-src 'none'" in page
    assert not re.findall(r"(?:src|href)\s*=|https?://|@import|url\(", page)


def test_names_cannot_leave_their_place(street: SemanticMap, track: Trajectory, tmp_path: Path) -> None:
    page = written(tmp_path, hostile(street), track, title="</title><script>alert(1)</script>")
    assert len(re.findall("<script", page)) == len(re.findall("</script", page)) == 3
    meta, _, _ = decoded(page)
    assert tuple(c["name"] for c in meta["classes"]) == (*hostile(street).voxels.label_set.names, "other")


def test_tiles_without_voxels_are_passed_over(street: SemanticMap, tmp_path: Path) -> None:
    tiled_map, nothing = in_memory(street), street[np.zeros(len(street), bool)]
    pages = []
    for corners in (tiled_map.tiles, (*tiled_map.tiles, (2, 5))):
        with_empty = replace(
            tiled_map,
            tiles=corners,
            read_tile=lambda tile: nothing if tile == (2, 5) else tiled_map.read_tile(tile),
        )
        write_viewer(with_empty, (), tmp_path / "viewer.html")
        pages.append(decoded((tmp_path / "viewer.html").read_text("utf-8"))[1])
    np.testing.assert_array_equal(*pages)


def test_a_page_needs_a_suffix_since_its_folder_has_none(street: SemanticMap, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"viewer: found no suffix, expected a name such as viewer.html"):
        write_viewer(in_memory(street), (), tmp_path / "viewer")


def test_an_empty_map_is_refused(street: SemanticMap, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no voxels to draw"):
        written(tmp_path, SemanticMap.of(street.voxels[np.zeros(len(street), bool)]), None)
