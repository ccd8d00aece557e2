"""The map from above, against a dictionary of columns; the GeoTIFF, as rasterio and pyproj see it."""

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio

from factor_graphs.geodesy import LocalFrame
from gnss_sem_map.errors import DataError
from gnss_sem_map.export.exported import Exported
from gnss_sem_map.export.georeference import Georeference
from gnss_sem_map.export.raster import (
    GEOTIFF_NODATA,
    GEOTIFF_UNLABELLED,
    NOTHING,
    top_view,
    write_topview_geotiff,
)
from gnss_sem_map.labels.label_set import OTHER_COLOUR
from gnss_sem_map.voxels.semantic_map import SemanticMap, State
from gnss_sem_map.voxels.tiles import in_memory

AT_THE_EDGE_OF_A_ZONE = LocalFrame(60.0, 6.02, 40.0)  # convergence -2.6 degrees


def seen(semantic_map: SemanticMap, per_cell: int) -> dict[tuple[int, int], tuple[bool, int, int]]:
    """(column, row) in cells from the origin -> labelled or not, index along z, label: the highest of these wins."""
    best: dict[tuple[int, int], tuple[bool, int, int]] = {}
    for (x, y, z), label, state in zip(
        semantic_map.voxels.indices.tolist(), semantic_map.labels.tolist(), semantic_map.states, strict=True
    ):
        cell = (x // per_cell, y // per_cell)
        if state != State.REMOVED:
            best[cell] = max(best.get(cell, (False, -999, -1)), (label >= 0, z, label))
    return best


@pytest.mark.parametrize(("longest_side", "per_cell"), [(10_000, 1), (300, 1), (299, 2), (75, 4), (30, 10)])
def test_the_top_view_is_the_highest_labelled_voxel_of_every_column_else_the_highest(
    street: SemanticMap, longest_side: int, per_cell: int
) -> None:
    view = top_view(Exported(in_memory(street)), longest_side)
    expected = seen(street, per_cell)
    assert view.cell_m == pytest.approx(0.2 * per_cell)
    assert (view.labels != NOTHING).sum() == len(expected)
    for (column, row), (_, z, label) in expected.items():
        i = round(view.north / view.cell_m) - 1 - row
        j = column - round(view.west / view.cell_m)
        assert view.heights[i, j] == pytest.approx(0.2 * (z + 1), abs=1e-5)
        if per_cell == 1:
            assert view.labels[i, j] == label


@pytest.mark.parametrize(
    "frame", [LocalFrame(49.0, 8.4, 115.0), AT_THE_EDGE_OF_A_ZONE, LocalFrame(-33.9, 151.2, 0)]
)
def test_rasterio_finds_every_class_where_pyproj_says_it_is(
    frame: LocalFrame, street: SemanticMap, tmp_path: Path
) -> None:
    write_topview_geotiff(Exported(in_memory(street, frame)), tmp_path / "topview_class.tif")
    view = top_view(Exported(in_memory(street)), 10_000)
    rows, columns = np.nonzero(inside_one_class(view.labels))
    assert len(rows) > 5000
    east, north = view.west + (columns + 0.5) * 0.2, view.north - (rows + 0.5) * 0.2
    utm = Georeference(frame).from_map(np.column_stack([east, north, view.heights[rows, columns]]))
    with rasterio.open(tmp_path / "topview_class.tif") as tiff:
        assert tiff.crs.to_epsg() == frame.utm_epsg
        found = np.array([value for (value,) in tiff.sample(utm[:, :2])])
    labels = view.labels[rows, columns].astype(int)
    np.testing.assert_array_equal(found, np.where(labels == -1, GEOTIFF_UNLABELLED, labels))


def inside_one_class(labels: np.ndarray) -> np.ndarray:
    """Cells whose eight neighbours are of their class: half a pixel of rounding cannot change what lies there."""
    padded = np.pad(labels, 1, constant_values=NOTHING)
    neighbours = [
        padded[1 + i : 1 + i + labels.shape[0], 1 + j : 1 + j + labels.shape[1]]
        for i in (-1, 0, 1)
        for j in (-1, 0, 1)
    ]
    return np.asarray((labels != NOTHING) & np.all([n == labels for n in neighbours], axis=0))


def test_what_lies_outside_the_labelled_part_is_left_out_of_the_frame(street: SemanticMap) -> None:
    only_the_car = np.where(street.labels == 2, street.labels, -1).astype(np.int8)
    view = top_view(Exported(in_memory(replace(street, labels=only_the_car))), 10_000)
    assert view.labels.shape == (10, 20)
    assert (view.labels == 2).all()


def test_resampling_keeps_the_area_of_every_class(street: SemanticMap, tmp_path: Path) -> None:
    write_topview_geotiff(Exported(in_memory(street, AT_THE_EDGE_OF_A_ZONE)), tmp_path / "topview_class.tif")
    with rasterio.open(tmp_path / "topview_class.tif") as tiff:
        classes = tiff.read(1)
    labels = top_view(Exported(in_memory(street)), 10_000).labels
    for label in range(6):
        assert (classes == label).sum() == pytest.approx((labels == label).sum(), rel=0.02)
    assert set(np.unique(classes)) == {0, 1, 2, 3, 4, 5, GEOTIFF_UNLABELLED, GEOTIFF_NODATA}


def test_the_geotiff_says_what_its_values_mean(
    street: SemanticMap, karlsruhe: LocalFrame, tmp_path: Path
) -> None:
    write_topview_geotiff(Exported(in_memory(street, karlsruhe)), tmp_path / "topview_class.tif")
    label_set = street.voxels.label_set
    with rasterio.open(tmp_path / "topview_class.tif") as tiff:
        assert (tiff.dtypes, tiff.nodata, tiff.compression.name) == (("uint8",), GEOTIFF_NODATA, "deflate")
        assert tiff.overviews(1) == [2]
        assert tiff.colormap(1)[3][:3] == tuple(label_set.colours[3])
        assert tiff.tags(1)["class_3"] == "building"
        assert tiff.colormap(1)[5][:3] == OTHER_COLOUR
        assert tiff.tags(1)["class_5"] == "other"
        assert tiff.res == pytest.approx((0.2, 0.2))


def test_the_geotiff_is_a_valid_cog(town: SemanticMap, karlsruhe: LocalFrame, tmp_path: Path) -> None:
    """As `rio cogeo validate --strict` checks it."""
    write_topview_geotiff(Exported(in_memory(town, karlsruhe)), tmp_path / "topview_class.tif")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of its imports
        from rio_cogeo import cog_validate
    assert cog_validate(tmp_path / "topview_class.tif", strict=True) == (True, [], [])
    with rasterio.open(tmp_path / "topview_class.tif") as tiff:
        assert len(tiff.overviews(1)) > 1
        assert tiff.colormap(1)[3][:3] == tuple(town.voxels.label_set.colours[3])


def test_utm_there_and_back_is_the_identity(street: SemanticMap) -> None:
    centres = street.voxels.centres[::100]
    for frame in (AT_THE_EDGE_OF_A_ZONE, LocalFrame(-33.9, 151.2, 0)):
        utm = Georeference(frame)
        np.testing.assert_allclose(utm.to_map(utm.from_map(centres)), centres, atol=1e-6)


def test_the_blocks_of_a_large_raster_join_without_a_seam(
    street: SemanticMap, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_topview_geotiff(Exported(in_memory(street, AT_THE_EDGE_OF_A_ZONE)), tmp_path / "whole.tif")
    monkeypatch.setattr("gnss_sem_map.export.raster.BLOCK", 16)
    monkeypatch.setattr("gnss_sem_map.export.raster.BLOCKS_AT_ONCE", 1)
    write_topview_geotiff(Exported(in_memory(street, AT_THE_EDGE_OF_A_ZONE)), tmp_path / "blocks.tif")
    with rasterio.open(tmp_path / "whole.tif") as whole, rasterio.open(tmp_path / "blocks.tif") as blocks:
        np.testing.assert_array_equal(whole.read(1), blocks.read(1))


def test_an_empty_map_has_no_top_view(street: SemanticMap, karlsruhe: LocalFrame, tmp_path: Path) -> None:
    empty = SemanticMap.of(street.voxels[np.zeros(len(street), bool)])
    with pytest.raises(DataError, match="no voxels to draw"):
        write_topview_geotiff(Exported(in_memory(empty, karlsruhe)), tmp_path / "topview_class.tif")
