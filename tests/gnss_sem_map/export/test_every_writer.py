"""What holds for every file that is written: the same bytes each time, and one clear line when the disk is full."""

import resource
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from factor_graphs.geodesy import LocalFrame
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.errors import DataError
from gnss_sem_map.export.copc import write_copc
from gnss_sem_map.export.exported import Exported
from gnss_sem_map.export.flight import write_flight
from gnss_sem_map.export.geopackage import write_geopackage
from gnss_sem_map.export.navigation import write_attitude, write_sbet
from gnss_sem_map.export.pictures import write_perspective, write_topview
from gnss_sem_map.export.point_cloud import write_laz, write_ply, write_removed
from gnss_sem_map.export.raster import write_topview_geotiff
from gnss_sem_map.export.trajectories import write_geojson, write_geoparquet, write_kitti, write_tum
from gnss_sem_map.export.viewer import write_viewer
from gnss_sem_map.voxels.semantic_map import SemanticMap, State
from gnss_sem_map.voxels.tiles import in_memory

Writer = Callable[[SemanticMap, Trajectory, LocalFrame, Path], None]

WRITERS: dict[str, Writer] = {
    "map.ply": lambda m, t, f, path: write_ply(Exported(in_memory(m, f), [t]), path),
    "map.laz": lambda m, t, f, path: write_laz(Exported(in_memory(m, f), [t]), path),
    "removed.laz": lambda m, t, f, path: write_removed(Exported(in_memory(m, f), [t]), path),
    "map.copc.laz": lambda m, t, f, path: write_copc(Exported(in_memory(m, f), [t]), path),
    "map.gpkg": lambda m, t, f, path: write_geopackage(Exported(in_memory(m, f), [t]), path),
    "topview.png": lambda m, t, f, path: write_topview(Exported(in_memory(m, f), [t]), path),
    "perspective.png": lambda m, t, f, path: write_perspective(Exported(in_memory(m, f), [t]), path),
    "flight.webp": lambda m, t, f, path: write_flight(Exported(in_memory(m, f), [t]), path),
    "topview_class.tif": lambda m, t, f, path: write_topview_geotiff(Exported(in_memory(m, f), [t]), path),
    "viewer.html": lambda m, t, f, path: write_viewer(in_memory(m), [t], path),
    "trajectory.tum": lambda m, t, f, path: write_tum(t, path),
    "trajectory_kitti.txt": lambda m, t, f, path: write_kitti(t, path),
    "trajectory.geojson": lambda m, t, f, path: write_geojson(t, f, path),
    "trajectory.sbet": lambda m, t, f, path: write_sbet(t, f, 10**18, path),
    "trajectory_attitude.csv": lambda m, t, f, path: write_attitude(t, f, path),
    "trajectory_wgs84.parquet": lambda m, t, f, path: write_geoparquet(t, f, 10**18, path),
}


@pytest.mark.parametrize("name", WRITERS)
def test_writing_twice_gives_the_same_bytes_and_leaves_one_file(
    name: str, street: SemanticMap, track: Trajectory, karlsruhe: LocalFrame, tmp_path: Path
) -> None:
    path = tmp_path / name
    path.write_bytes(b"an earlier run")
    WRITERS[name](street, track, karlsruhe, path)
    first = path.read_bytes()
    WRITERS[name](street, track, karlsruhe, path)
    assert path.read_bytes() == first != b"an earlier run"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("name", WRITERS)
def test_a_map_that_shows_no_label_is_written_all_the_same(
    name: str, street: SemanticMap, track: Trajectory, karlsruhe: LocalFrame, tmp_path: Path
) -> None:
    """Nothing but what was removed has a label; and everything was removed."""
    removed = street.states == State.REMOVED
    unlabelled = replace(street, labels=np.where(removed, street.labels, -1).astype(np.int8))
    for semantic_map in (unlabelled, replace(street, states=np.full_like(street.states, State.REMOVED))):
        WRITERS[name](semantic_map, track, karlsruhe, tmp_path / name)
        assert (tmp_path / name).stat().st_size > 500
    np.testing.assert_array_equal(Exported(in_memory(unlabelled)).extent.visible(unlabelled), ~removed)


@contextmanager
def room_for(size: int) -> Iterator[None]:
    """The operating system refuses to write more into any file, as a full disk does."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


@pytest.mark.parametrize("name", WRITERS)
def test_a_full_disk_is_one_line_that_names_the_file_and_leaves_nothing(
    name: str, street: SemanticMap, track: Trajectory, karlsruhe: LocalFrame, tmp_path: Path
) -> None:
    with room_for(1000), pytest.raises(DataError) as caught:
        WRITERS[name](street, track, karlsruhe, tmp_path / name)
    assert f"{name}: no room to write it" in str(caught.value)
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_a_full_disk_leaves_nothing_of_a_page_with_levels_of_detail(
    street: SemanticMap, tmp_path: Path
) -> None:
    with room_for(1000), pytest.raises(DataError, match="viewer: no room to write it") as caught:
        write_viewer(in_memory(street), [], tmp_path / "viewer.html", most_voxels=10_000)
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())
