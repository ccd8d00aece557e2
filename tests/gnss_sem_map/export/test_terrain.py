"""The terrain models, as rasterio and pyproj see them, against a street that is known exactly."""

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
from hillside import CANOPY, CAR, HEDGE, KERB_M, MOVED, SIZE, Part, exported, ground

from factor_graphs.geodesy import LocalFrame
from gnss_sem_map.config import TerrainSettings
from gnss_sem_map.errors import DataError
from gnss_sem_map.export import raster, terrain
from gnss_sem_map.export.georeference import Georeference
from gnss_sem_map.export.terrain import NODATA, write_terrain

FRAMES = [LocalFrame(49.0, 8.4, 115.0), LocalFrame(60.0, 6.02, 40.0)]


def read(file: Path, frame: LocalFrame) -> tuple[np.ndarray, np.ndarray]:
    """Places (n, 3) in the map frame of the pixels with data, and their standard deviations (n,)."""
    with rasterio.open(file) as tiff:
        assert tiff.crs.to_epsg() == frame.utm_epsg
        assert tiff.nodata == NODATA
        up, stddevs = tiff.read()
        rows, columns = np.nonzero(up != NODATA)
        x, y = tiff.transform @ (columns + 0.5, rows + 0.5)
    p = Georeference(frame).to_map(np.column_stack([x, y, up[rows, columns].astype(float)]))
    return p, stddevs[rows, columns]


def inside(p: np.ndarray, part: Part, margin: float = 0.3) -> np.ndarray:
    (x0, x1), (y0, y1) = part.x, part.y
    return np.asarray(
        (p[:, 0] > x0 + margin) & (p[:, 0] < x1 - margin) & (p[:, 1] > y0 + margin) & (p[:, 1] < y1 - margin)
    )


@pytest.mark.parametrize("frame", FRAMES)
def test_the_ground_is_known_where_it_was_seen_and_under_what_hides_it(
    frame: LocalFrame, tmp_path: Path
) -> None:
    write_terrain(exported(frame), tmp_path / "terrain")
    p, stddevs = read(tmp_path / "terrain" / "dtm.tif", frame)
    errors = p[:, 2] - ground(p[:, 0], p[:, 1])
    road = inside(p, Part((0, 40), (-6, 4), 0)) & ~inside(p, CAR, -0.3)
    # heights in voxels are in steps of 0.8 mm, and float32 of 8 um
    assert np.abs(errors[road]).max() < 0.006
    assert np.sqrt((errors[inside(p, CAR)] ** 2).mean()) < 0.02
    assert (np.abs(errors) < 3 * stddevs + KERB_M * (np.abs(p[:, 1] - 4) < SIZE)).mean() > 0.99
    assert (stddevs[inside(p, CAR, 0.7)] > 2 * stddevs[road].max()).all()


def test_ground_is_unknown_farther_from_where_it_was_seen_than_is_said(tmp_path: Path) -> None:
    frame, near = FRAMES[0], TerrainSettings(farthest_m=0.5)
    write_terrain(replace(exported(frame), terrain=near), tmp_path / "terrain")
    p, _ = read(tmp_path / "terrain" / "dtm.tif", frame)
    car, core = inside(p, CAR, 0), inside(p, CAR, 0.8)
    assert car.any()
    assert not core.any()
    assert p[:, 1].max() < 8 + 0.5 + SIZE


def test_the_surface_is_the_highest_that_stands(tmp_path: Path) -> None:
    frame = FRAMES[0]
    write_terrain(exported(frame), tmp_path / "terrain")
    p, _ = read(tmp_path / "terrain" / "dsm.tif", frame)
    above = p[:, 2] - ground(p[:, 0], p[:, 1])
    np.testing.assert_allclose(above[inside(p, replace(CANOPY, y=(-4, 4)))], 3.2, atol=0.01)
    np.testing.assert_allclose(above[inside(p, CAR)], 1.25, atol=0.01)
    np.testing.assert_allclose(above[inside(p, MOVED)], 0, atol=0.01)
    assert p[:, 1].max() < HEDGE.y[1] + SIZE


def test_both_are_valid_cogs_whose_bands_have_names(tmp_path: Path) -> None:
    write_terrain(exported(FRAMES[0]), tmp_path / "terrain")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of its imports
        from rio_cogeo import cog_validate
    for name in terrain.MODELS:
        file = tmp_path / "terrain" / f"{name}.tif"
        assert cog_validate(file, strict=True) == (True, [], [])
        with rasterio.open(file) as tiff:
            assert tiff.descriptions == terrain.BANDS
            assert "heights above the WGS 84 ellipsoid" in tiff.tags()["heights"]


def test_windows_join_without_a_seam(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_terrain(exported(FRAMES[1]), tmp_path / "whole")
    monkeypatch.setattr(raster, "BLOCK", 16)
    monkeypatch.setattr(terrain, "BLOCKS_AT_ONCE", 3)
    write_terrain(exported(FRAMES[1]), tmp_path / "parts")
    for name in terrain.MODELS:
        with (
            rasterio.open(tmp_path / "whole" / f"{name}.tif") as whole,
            rasterio.open(tmp_path / "parts" / f"{name}.tif") as parts,
        ):
            np.testing.assert_allclose(parts.read(), whole.read(), atol=1e-3)


def test_a_map_in_its_own_poses_has_no_terrain_model(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="a terrain model needs a georeference"):
        write_terrain(exported(), tmp_path / "terrain")
    assert not list(tmp_path.iterdir())
