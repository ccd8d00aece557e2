"""The map seen from above: the class of every column, as an array and as a GeoTIFF."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from factor_graphs.geodesy import LocalFrame
from gnss_sem_map.errors import DataError
from gnss_sem_map.export.point_cloud import UNLABELLED_COLOUR, drawable, visible
from gnss_sem_map.export.utm import from_utm, to_utm
from gnss_sem_map.files.atomic import replacing
from gnss_sem_map.labels.label_set import UNLABELLED
from gnss_sem_map.voxels.semantic_map import SemanticMap

NOTHING = -2
"""Label of a cell without any voxel."""
NO_VOXELS = "the map has no voxels to draw; run.json lists what was skipped"
GEOTIFF_UNLABELLED, GEOTIFF_NODATA = 254, 255
GEOTIFF_LONGEST_SIDE = 10_000
BLOCK = 256


@dataclass(frozen=True, eq=False)
class TopView:
    """Square cells, north up: row 0 is the northernmost, column 0 the westernmost."""

    cell_m: float
    west: float
    """m, map frame: left edge of column 0."""
    north: float
    """m, map frame: upper edge of row 0."""
    labels: NDArray[np.int8]
    """(rows, columns) class; -1 unlabelled, -2 no voxel."""
    heights: NDArray[np.float32]
    """(rows, columns) m, map frame: top of the voxel that is seen; NaN where there is none."""


def top_view(semantic_map: SemanticMap, longest_side: int) -> TopView:
    """Look at the map from above: of every cell, the highest labelled voxel, else the highest unlabelled one.

    The view ends where the labelled voxels end; removed ones are not seen, unless all are. A cell is one voxel, or as
    many as keep the longer side within `longest_side` cells. Raises DataError for a map without voxels.
    """
    kept = drawable(semantic_map)
    framed = visible(semantic_map)[kept]
    if not framed.any():
        raise DataError(NO_VOXELS)
    x, y, z = semantic_map.voxels.indices[kept].T
    per_cell = max(1, -(-(1 + max(np.ptp(x[framed]), np.ptp(y[framed]))) // longest_side))
    columns, rows = x // per_cell, -(y // per_cell)
    west, north = columns[framed].min(), rows[framed].min()
    shape = (int(rows[framed].max() - north) + 1, int(columns[framed].max() - west) + 1)
    inside = (columns >= west) & (columns < west + shape[1]) & (rows >= north) & (rows < north + shape[0])
    order = np.flatnonzero(inside)[np.lexsort((z[inside], framed[inside]))]
    cells = np.ravel_multi_index((rows[order] - north, columns[order] - west), shape)
    labels, heights = np.full(shape, NOTHING, np.int8), np.full(shape, np.nan, np.float32)
    voxel_m = semantic_map.voxels.voxel_size_m
    labels.ravel()[cells] = semantic_map.labels[kept][order]  # of repeated cells the last one stays
    heights.ravel()[cells] = (z[order] + 1) * voxel_m
    cell_m = float(per_cell * voxel_m)
    return TopView(cell_m, west=west * cell_m, north=(1 - north) * cell_m, labels=labels, heights=heights)


def write_topview_geotiff(semantic_map: SemanticMap, frame: LocalFrame, path: Path | str) -> None:
    """Write the top view as a GeoTIFF of class indices in the UTM zone of the map's origin.

    uint8 with a colour table: 254 is mapped but unlabelled, 255 no data; tags name the classes. Every pixel takes
    the cell under its centre, so the grid's convergence and scale are respected. Pixels are one voxel wide, or more
    where the raster would exceed 10,000 on a side. Raises DataError for an empty map or when the file cannot be
    written.
    """
    import rasterio
    from rasterio.enums import Resampling

    view = top_view(semantic_map, GEOTIFF_LONGEST_SIDE)
    grid = _utm_grid(view, frame)
    names = semantic_map.voxels.label_set.names
    profile = {
        "driver": "GTiff", "dtype": "uint8", "count": 1, "nodata": GEOTIFF_NODATA, "compress": "deflate",
        "tiled": True, "blockxsize": BLOCK, "blockysize": BLOCK, "width": grid.columns, "height": grid.rows,
        "crs": f"EPSG:{frame.utm_epsg}",
        "transform": rasterio.Affine(view.cell_m, 0, grid.west, 0, -view.cell_m, grid.north),
    }  # fmt: skip
    with rasterio.MemoryFile() as memory:  # GDAL would notice a full disk too late
        with memory.open(**profile) as tiff:
            for row in range(0, grid.rows, BLOCK):
                for column in range(0, grid.columns, BLOCK):
                    block = _resampled(view, grid, frame, row, column)
                    height, width = block.shape
                    tiff.write(block, 1, window=((row, row + height), (column, column + width)))
            tiff.write_colormap(1, _colour_table(semantic_map))
            tiff.update_tags(1, **{f"class_{i}": name for i, name in enumerate(names)})
            tiff.build_overviews(_overviews(grid), Resampling.mode)
        with replacing(path) as file:
            file.write(memory.getbuffer())


@dataclass(frozen=True)
class _Grid:
    """The pixels of the GeoTIFF: upper left corner in UTM m, size, and the height at which they are transformed."""

    west: float
    north: float
    rows: int
    columns: int
    alt_m: float


def _utm_grid(view: TopView, frame: LocalFrame) -> _Grid:
    rows, columns = view.labels.shape
    height = float(np.nanmedian(view.heights))
    u, v = (np.ravel(part) for part in np.meshgrid(np.linspace(0, columns, 9), np.linspace(0, rows, 9)))
    east, north = view.west + u * view.cell_m, view.north - v * view.cell_m
    box = to_utm(frame, np.column_stack([east, north, np.full(len(u), height)]))
    low = np.floor(box[:, :2].min(axis=0) / view.cell_m).astype(int)
    high = np.ceil(box[:, :2].max(axis=0) / view.cell_m).astype(int)
    columns, rows = (high - low).tolist()
    return _Grid(low[0] * view.cell_m, high[1] * view.cell_m, rows, columns, float(np.median(box[:, 2])))


def _resampled(view: TopView, grid: _Grid, frame: LocalFrame, row: int, column: int) -> NDArray[np.uint8]:
    """One block of the GeoTIFF.

    The way back to the map frame is exact at the block's corners and bilinear between them, which is wrong by 3 µm
    over 256 pixels of 0.2 m. It is taken at one height; a point dh above it is displaced by dh times its distance
    over the Earth's radius: 2 cm for 20 m at 6 km.
    """
    rows, columns = min(BLOCK, grid.rows - row), min(BLOCK, grid.columns - column)
    u, v = np.arange(columns) + 0.5, np.arange(rows) + 0.5
    easting = grid.west + (column + np.array([0, columns, 0, columns])) * view.cell_m
    northing = grid.north - (row + np.array([0, 0, rows, rows])) * view.cell_m
    corners = from_utm(frame, np.column_stack([easting, northing, np.full(4, grid.alt_m)]))[:, :2]
    right, down = (u / columns)[None, :, None], (v / rows)[:, None, None]
    upper = (1 - right) * corners[0] + right * corners[1]
    lower = (1 - right) * corners[2] + right * corners[3]
    east, north = np.moveaxis((1 - down) * upper + down * lower, -1, 0)
    view_columns = np.floor((east - view.west) / view.cell_m).astype(np.int64)
    view_rows = np.floor((view.north - north) / view.cell_m).astype(np.int64)
    inside = (view_columns >= 0) & (view_columns < view.labels.shape[1])
    inside &= (view_rows >= 0) & (view_rows < view.labels.shape[0])
    block = np.full((rows, columns), NOTHING, np.int16)
    block[inside] = view.labels[view_rows[inside], view_columns[inside]]
    block[block == UNLABELLED] = GEOTIFF_UNLABELLED
    block[block == NOTHING] = GEOTIFF_NODATA
    return block.astype(np.uint8)


def _colour_table(semantic_map: SemanticMap) -> dict[int, tuple[Any, ...]]:
    colours = semantic_map.voxels.label_set.colours.tolist()
    table = {i: (*rgb, 255) for i, rgb in enumerate(colours)}
    return {**table, GEOTIFF_UNLABELLED: (*UNLABELLED_COLOUR, 255), GEOTIFF_NODATA: (0, 0, 0, 0)}


def _overviews(grid: _Grid) -> list[int]:
    """Factors of two until the whole raster fits one block."""
    count = int(np.ceil(np.log2(max(grid.rows, grid.columns) / BLOCK)))
    return [2**i for i in range(1, count + 1)]
