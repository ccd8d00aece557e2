"""The ground and the surface as GeoTIFFs: heights in the CRS of the delivery, and their standard deviations."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.export.exported import Exported
from gnss_sem_map.export.georeference import Georeference
from gnss_sem_map.export.ground import Heights, ground_of
from gnss_sem_map.export.raster import (
    GEOTIFF_LONGEST_SIDE,
    Cells,
    Corners,
    Grid,
    between,
    new_cog,
    window_of,
)
from gnss_sem_map.files.atomic import adding_folder

NODATA = -9999.0
BANDS = ("height, m", "standard deviation, m")
MODELS = {"dtm": "ground", "dsm": "highest that was seen and stands"}
BLOCKS_AT_ONCE = 4
"""Blocks of pixels along each side of a window: a smaller one is read with more around it."""


def write_terrain(exported: Exported, folder: Path) -> None:
    """Write `dtm.tif`, the ground under everything, and `dsm.tif`, the highest that stands, into a new folder.

    Both are cloud-optimised GeoTIFFs in the CRS of the delivery: heights as it has them, and their standard deviations,
    float32; -9999 is no data. The ground is interpolated under what hides it, see `ground_of`. Pixels are those of
    `write_topview_geotiff`. Raises DataError for an empty map, for one without a georeference, and when a file cannot
    be written.
    """
    georeference = exported.georeference_for("a terrain model")
    cells = Cells.of(exported.extent, GEOTIFF_LONGEST_SIDE)
    grid = Grid.over(cells, exported, georeference)
    profile = {"dtype": "float32", "count": len(BANDS), "nodata": NODATA, "predictor": 3, "zlevel": 1}
    with (
        adding_folder(folder) as inside,
        new_cog(inside / "dtm.tif", grid, georeference, "average", **profile) as dtm,
        new_cog(inside / "dsm.tif", grid, georeference, "average", **profile) as dsm,
    ):
        for corner, (ground, surface) in _blocks(exported, cells, grid, georeference):
            if (ground[0] != NODATA).any() or (surface[0] != NODATA).any():  # what is not written is no data
                dtm.write(ground, window=window_of(corner, ground.shape[1:]))
                dsm.write(surface, window=window_of(corner, surface.shape[1:]))
        for tiff, what in zip((dtm, dsm), MODELS.values(), strict=True):
            tiff.descriptions = BANDS
            tiff.update_tags(what=what, heights=georeference.words)


def _blocks(
    exported: Exported, cells: Cells, grid: Grid, georeference: Georeference
) -> Iterator[tuple[tuple[int, int], tuple[Heights, Heights]]]:
    """Upper left pixel of every block, and its bands (2, rows, columns) of the ground and of the surface."""
    corners = Corners.of(cells, grid, georeference)
    rows, columns = (length - 1 for length in corners.lift_m.shape)
    for i, j in np.ndindex(-(-rows // BLOCKS_AT_ONCE), -(-columns // BLOCKS_AT_ONCE)):
        i, j = i * BLOCKS_AT_ONCE, j * BLOCKS_AT_ONCE
        part = corners.places[i : i + BLOCKS_AT_ONCE + 1, j : j + BLOCKS_AT_ONCE + 1] * cells.per_cell
        first, end = (
            np.floor(part.min(axis=(0, 1))).astype(int) - 1,
            np.ceil(part.max(axis=(0, 1))).astype(int) + 1,
        )
        low = cells.west * cells.per_cell + int(first[1]), cells.north * cells.per_cell - int(end[0])
        bands = _bands(exported, low, (int(end[1] - first[1]), int(end[0] - first[0])))
        for k, m in np.ndindex(*(np.array(part.shape[:2]) - 1)):
            corner, shape = corners.block(i + k, j + m)
            places = between(part[k : k + 2, m : m + 2] - first - 0.5, shape).astype(np.float32)
            lift_m = between(corners.lift_m[i + k : i + k + 2, j + m : j + m + 2, None], shape)[..., 0]
            yield corner, (_sampled(bands[0], places, lift_m), _sampled(bands[1], places, lift_m))


def _bands(
    exported: Exported, low: tuple[int, int], shape: tuple[int, int]
) -> tuple[list[Heights], list[Heights]]:
    """Heights and standard deviations of the ground, and of the surface, as images (rows, columns), north up."""
    ground, size = ground_of(exported, low, shape), exported.map.voxel_size_m
    is_ground = ground.seen & (np.abs(ground.tops - ground.heights) < size / 2)
    tops = np.where(is_ground, ground.heights, ground.tops)
    stddevs = np.where(is_ground, ground.stddevs, np.float32(size / np.sqrt(12)))
    both = [
        [np.ascontiguousarray(band.T[::-1], np.float32) for band in bands]
        for bands in ((ground.heights, ground.stddevs), (tops, stddevs))
    ]
    return both[0], both[1]


def _sampled(bands: list[Heights], places: Heights, lift_m: NDArray[np.float64]) -> Heights:
    """The bands at places (rows, columns, 2) in pixels, bilinear."""
    import cv2

    right, down = np.ascontiguousarray(places[..., 1]), np.ascontiguousarray(places[..., 0])
    heights, stddevs = (cv2.remap(band, right, down, cv2.INTER_LINEAR, borderValue=np.nan) for band in bands)
    found = np.stack([heights + lift_m.astype(np.float32), stddevs])
    return np.where(np.isnan(found[:1]), np.float32(NODATA), found).astype(np.float32)
