"""COPC as laspy and copclib read it, which do not pack it: every voxel once, coarse levels first."""

from pathlib import Path

import copclib
import laspy
import numpy as np
import pytest
from scipy.spatial import cKDTree

from factor_graphs.geodesy import LocalFrame
from gnss_sem_map.errors import DataError
from gnss_sem_map.export.copc import write_copc
from gnss_sem_map.export.exported import Exported
from gnss_sem_map.export.point_cloud import write_laz
from gnss_sem_map.voxels.semantic_map import SemanticMap
from gnss_sem_map.voxels.tiles import in_memory

NAMES = ("X", "Y", "Z", "classification", "red", "sem_label", "confidence", "hits", "state")


def sorted_points(points: laspy.ScaleAwarePointRecord) -> np.ndarray:
    return np.sort(np.rec.fromarrays([np.asarray(points[name]) for name in NAMES], names=NAMES))


def test_the_octree_holds_the_points_of_the_laz_and_a_coarser_picture_of_them(
    town: SemanticMap, karlsruhe: LocalFrame, tmp_path: Path
) -> None:
    exported = Exported(in_memory(town, karlsruhe))
    write_copc(exported, tmp_path / "map.copc.laz")
    write_laz(exported, tmp_path / "map.laz")
    plain = laspy.read(tmp_path / "map.laz")
    with laspy.CopcReader.open(tmp_path / "map.copc.laz") as reader:
        np.testing.assert_array_equal(sorted_points(reader.query()), sorted_points(plain.points))
        whole = np.asarray(plain.xyz)
        half = reader.query(bounds=laspy.copc.Bounds(whole.min(axis=0), whole.mean(axis=0)))
        assert len(half) == ((whole <= whole.mean(axis=0)).all(axis=1)).sum()
        coarse = reader.query(resolution=4 * 0.2)
        assert 0 < len(coarse) < len(plain.points) / 4
        seen = np.column_stack([coarse.x, coarse.y, coarse.z])
    with laspy.open(tmp_path / "map.copc.laz") as file:
        np.testing.assert_allclose(file.header.mins, plain.header.mins, atol=1e-9)
        np.testing.assert_allclose(file.header.maxs, plain.header.maxs, atol=1e-9)
        assert file.header.point_count == len(plain.points)
        assert file.header.number_of_points_by_return.tolist() == [len(plain.points), *[0] * 14]
    assert cKDTree(seen).query(whole)[0].max() < 3.2  # no part of the map is left out
    with laspy.open(tmp_path / "map.copc.laz") as file:
        assert file.header.parse_crs().to_epsg() == 32632


def test_another_unpacker_finds_the_same_bytes(
    town: SemanticMap, karlsruhe: LocalFrame, tmp_path: Path
) -> None:
    write_copc(Exported(in_memory(town, karlsruhe)), tmp_path / "map.copc.laz")
    reader = copclib.FileReader(str(tmp_path / "map.copc.laz"))
    packed_once_more = copclib.FileWriter(str(tmp_path / "again.copc.laz"), reader.copc_config)
    for node in reader.GetAllNodes():
        packed_once_more.AddNode(node.key, reader.GetPointData(node))
    packed_once_more.Close()
    ours, theirs = laspy.read(tmp_path / "map.copc.laz"), laspy.read(tmp_path / "again.copc.laz")
    np.testing.assert_array_equal(np.sort(ours.points.array), np.sort(theirs.points.array))


def test_an_empty_map_is_refused(street: SemanticMap, karlsruhe: LocalFrame, tmp_path: Path) -> None:
    empty = SemanticMap.of(street.voxels[np.zeros(len(street), bool)])
    with pytest.raises(DataError, match="no voxels to draw"):
        write_copc(Exported(in_memory(empty, karlsruhe)), tmp_path / "map.copc.laz")
    assert not list(tmp_path.iterdir())
