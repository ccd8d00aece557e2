"""The map seen from above: the class of every column, as an array and as a GeoTIFF."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gnss_sem_map.errors import DataError
from gnss_sem_map.export.exported import NO_VOXELS, Exported, Extent
from gnss_sem_map.export.georeference import Georeference
from gnss_sem_map.export.point_cloud import UNLABELLED_COLOUR
from gnss_sem_map.files.atomic import replacing
from gnss_sem_map.labels.label_set import UNLABELLED, LabelSet
from gnss_sem_map.voxels.tile_files import TILE_BITS

if TYPE_CHECKING:
    from rasterio.io import DatasetWriter

NOTHING = -2
"""Label of a cell without any voxel."""
GEOTIFF_UNLABELLED, GEOTIFF_NODATA = 254, 255
GEOTIFF_LONGEST_SIDE = 10_000
BLOCK = 256
BLOCKS_AT_ONCE = 2
"""Rows of blocks for which the map is looked at together: more read a tile less often, fewer take less memory."""
GDAL_CACHE_BYTES = 16 << 20
ABOVE_ALL = 1 << 24
"""Above every index of a voxel."""


@dataclass(frozen=True, eq=False)
class TopView:
    """Square cells, north up: row 0 is the northernmost, column 0 the westernmost."""

    cell_m: float
    west: float
    """m, map frame: left edge of column 0."""
    north: float
    """m, map frame: upper edge of row 0."""
    labels: NDArray[np.int8]
    """(rows, columns) class, c for `other`; -1 unlabelled, -2 no voxel."""
    inferred: NDArray[np.bool_]
    """(rows, columns) whether no camera saw that voxel and its class is inferred."""
    heights: NDArray[np.float32]
    """(rows, columns) m, map frame: top of the voxel that is seen; NaN where there is none."""


def top_view(exported: Exported, longest_side: int) -> TopView:
    """Look at the map from above: of every cell, the highest labelled voxel, else the highest unlabelled one.

    The view ends where the labelled voxels end; removed ones are not seen, unless all are. A cell is one voxel, or as
    many as keep the longer side within `longest_side` cells. Raises DataError for a map without voxels.
    """
    cells, voxel_m = Cells.of(exported.extent, longest_side), exported.map.voxel_size_m
    labels, rank, inferred = _seen_in_rows(exported, cells, 0, cells.rows)
    tops = np.where(rank > ABOVE_ALL // 2, rank - ABOVE_ALL, rank)
    heights = np.where(labels == NOTHING, np.float32(np.nan), tops * np.float64(voxel_m)).astype(np.float32)
    cell_m = cells.per_cell * voxel_m
    return TopView(cell_m, cells.west * cell_m, cells.north * cell_m, labels, inferred, heights)


@dataclass(frozen=True)
class Cells:
    """The cells of a view: how many voxels wide, the edges west and north in cells from the origin, and how many."""

    per_cell: int
    west: int
    north: int
    rows: int
    columns: int

    @classmethod
    def of(cls, extent: Extent, longest_side: int) -> Cells:
        if not extent.count:
            raise DataError(NO_VOXELS)
        per_cell = max(1, -(-(1 + int((extent.high - extent.low)[:2].max())) // longest_side))
        west, south, _ = (extent.low // per_cell).tolist()
        east, north, _ = (extent.high // per_cell + 1).tolist()
        return cls(per_cell, west, north, rows=north - south, columns=east - west)


def _seen_in_rows(
    exported: Exported, cells: Cells, first: int, end: int
) -> tuple[NDArray[np.int8], NDArray[np.int32], NDArray[np.bool_]]:
    """Rows [first, end) of a view: label and rank of the voxel that is seen, and whether it is inferred.

    Only the tiles of these rows are read. The rank is the top of the voxel, in voxels, and more by `ABOVE_ALL` where it
    is visible: the highest rank is seen.
    """
    shape = (max(0, end - first), cells.columns)
    labels, rank = np.full(shape, NOTHING, np.int8), np.full(shape, -ABOVE_ALL, np.int32)
    inferred = np.zeros(shape, np.bool_)
    low_y, high_y = (cells.north - end) * cells.per_cell, (cells.north - first) * cells.per_cell
    for tile in exported.map.tiles:
        if tile[1] << TILE_BITS >= high_y or (tile[1] + 1) << TILE_BITS <= low_y:
            continue
        piece, extent = exported.map.read_tile(tile), exported.extent
        _look(
            piece.voxels.indices, piece.labels, piece.inferred, extent.drawable(piece), extent.visible(piece),
            cells.per_cell, cells.west, cells.north - 1 - first, labels, rank, inferred,
        )  # fmt: skip
    return labels, rank, inferred


@njit(cache=True, nogil=True)
def _look(indices, labels, inferred, drawable, visible, per_cell, west, north, seen, rank, seen_inferred):
    """Look at voxels from above: of equal ranks in a cell the last is seen."""
    for i in range(len(indices)):
        row, column = north - indices[i, 1] // per_cell, indices[i, 0] // per_cell - west
        if not drawable[i] or not (0 <= row < rank.shape[0] and 0 <= column < rank.shape[1]):
            continue
        here = indices[i, 2] + 1 + ABOVE_ALL * visible[i]
        if here >= rank[row, column]:
            rank[row, column], seen[row, column], seen_inferred[row, column] = here, labels[i], inferred[i]


def write_topview_geotiff(exported: Exported, path: Path | str) -> None:
    """Write the top view as a cloud-optimised GeoTIFF of class indices in the CRS of the delivery.

    uint8 with a colour table: c is `other`, 254 is mapped but unlabelled, 255 no data; tags name the classes. Every
    pixel takes the cell under its centre, so the grid's convergence and scale are respected. Pixels are one voxel wide,
    or more where the raster would exceed 10,000 on a side. Raises DataError for an empty map, for one without a
    georeference, or when the file cannot be written.
    """
    georeference, label_set = exported.georeference_for("a GeoTIFF"), exported.map.label_set
    cells = Cells.of(exported.extent, GEOTIFF_LONGEST_SIDE)
    grid = Grid.over(cells, exported, georeference)
    with new_cog(path, grid, georeference, "mode", dtype="uint8", count=1, nodata=GEOTIFF_NODATA) as tiff:
        for corner, block in _blocks(exported, cells, grid, georeference):
            tiff.write(block, 1, window=window_of(corner, block.shape))
        tiff.write_colormap(1, _colour_table(label_set))
        tiff.update_tags(1, **{f"class_{i}": name for i, name in enumerate(label_set.legend.names)})


@contextmanager
def new_cog(
    path: Path | str, grid: Grid, georeference: Georeference, resampling: str, **profile: Any
) -> Iterator[DatasetWriter]:
    """A GeoTIFF of a grid to write bands into; when the block succeeds, it becomes a cloud-optimised file.

    `resampling` is for its overviews. Raises DataError when the file cannot be written.
    """
    import rasterio
    import rasterio.shutil
    from rasterio.enums import Resampling

    profile |= {
        "driver": "GTiff", "compress": "deflate", "tiled": True, "blockxsize": BLOCK, "blockysize": BLOCK,
        "width": grid.columns, "height": grid.rows, "crs": f"EPSG:{georeference.horizontal_epsg}",
        "transform": rasterio.Affine(grid.cell_m, 0, grid.west, 0, -grid.cell_m, grid.north),
    }  # fmt: skip
    # GDAL would notice a full disk too late, and keep a twentieth of the memory full of blocks
    with rasterio.Env(GDAL_CACHEMAX=GDAL_CACHE_BYTES), rasterio.MemoryFile() as memory:
        with memory.open(**profile) as tiff:
            yield tiff
            tiff.build_overviews(_overviews(grid), Resampling[resampling])
        # the driver for cloud-optimised files writes no blocks, it only puts those of another file in order
        with rasterio.MemoryFile() as ordered, replacing(path) as file:
            rasterio.shutil.copy(memory.name, ordered.name, driver="COG", compress="deflate", blocksize=BLOCK)
            file.write(ordered.getbuffer())


def window_of(corner: tuple[int, int], shape: tuple[int, ...]) -> tuple[tuple[int, int], ...]:
    """Rows and columns of a block with this upper left pixel, as rasterio takes them."""
    return tuple((start, start + length) for start, length in zip(corner, shape, strict=True))


@dataclass(frozen=True)
class Grid:
    """The pixels of the GeoTIFF: upper left corner, m, size, and the height at which they are transformed."""

    cell_m: float
    west: float
    north: float
    rows: int
    columns: int
    alt_m: float

    @classmethod
    def over(cls, cells: Cells, exported: Exported, georeference: Georeference) -> Grid:
        """Pixels as wide as the cells, over all of these."""
        voxel_m = exported.map.voxel_size_m
        cell_m, height = cells.per_cell * voxel_m, exported.extent.mean[2] * voxel_m
        u, v = map(np.ravel, np.meshgrid(np.linspace(0, cells.columns, 9), np.linspace(0, cells.rows, 9)))
        east, north = (cells.west + u) * cell_m, (cells.north - v) * cell_m
        box = georeference.from_map(np.column_stack([east, north, np.full(len(u), height)]))
        low = np.floor(box[:, :2].min(axis=0) / cell_m).astype(int)
        high = np.ceil(box[:, :2].max(axis=0) / cell_m).astype(int)
        columns, rows = (high - low).tolist()
        return cls(cell_m, low[0] * cell_m, high[1] * cell_m, rows, columns, float(np.median(box[:, 2])))


@dataclass(frozen=True, eq=False)
class Corners:
    """Corners of the blocks of the GeoTIFF: rows (i + 1,) and columns (j + 1,) of pixels, and where they are."""

    rows: NDArray[np.int64]
    columns: NDArray[np.int64]
    places: NDArray[np.float64]
    """(i + 1, j + 1, 2) in cells down and right of the view's upper left corner."""
    lift_m: NDArray[np.float64]
    """(i + 1, j + 1) what heights in the CRS are more than those in the map frame."""

    @classmethod
    def of(cls, cells: Cells, grid: Grid, georeference: Georeference) -> Corners:
        """The way back to the map frame is exact at the corners of the blocks and bilinear between them, which is wrong
        by 3 µm over 256 pixels of 0.2 m. It is taken at one height; a point dh above it is displaced by dh times its
        distance over the Earth's radius: 2 cm for 20 m at 6 km.
        """
        rows = np.append(np.arange(0, grid.rows, BLOCK), grid.rows)
        columns = np.append(np.arange(0, grid.columns, BLOCK), grid.columns)
        v, u = np.meshgrid(rows, columns, indexing="ij")
        corners = np.stack(
            [grid.west + u * grid.cell_m, grid.north - v * grid.cell_m, np.full(u.shape, grid.alt_m)], -1
        )
        east, north, up = np.moveaxis(georeference.to_map(corners), -1, 0)
        places = np.stack([cells.north - north / grid.cell_m, east / grid.cell_m - cells.west], axis=-1)
        return cls(rows, columns, places, grid.alt_m - up)

    def block(self, i: int, j: int) -> tuple[tuple[int, int], tuple[int, int]]:
        """Its upper left pixel, and its shape."""
        corner = int(self.rows[i]), int(self.columns[j])
        return corner, (int(self.rows[i + 1]) - corner[0], int(self.columns[j + 1]) - corner[1])


def _blocks(
    exported: Exported, cells: Cells, grid: Grid, georeference: Georeference
) -> Iterator[tuple[tuple[int, int], NDArray[np.uint8]]]:
    """Row and column of the upper left pixel of every block of the GeoTIFF, and the block."""
    corners = Corners.of(cells, grid, georeference)
    count, columns = (length - 1 for length in corners.lift_m.shape)
    for i in range(0, count, BLOCKS_AT_ONCE):
        end = min(i + BLOCKS_AT_ONCE, count)
        first = max(0, int(corners.places[i : end + 1, :, 0].min()) - 1)
        last = min(cells.rows, int(corners.places[i : end + 1, :, 0].max()) + 2)
        labels, _, _ = _seen_in_rows(exported, cells, first, last)
        for k, j in np.ndindex(end - i, columns):
            corner, shape = corners.block(i + k, j)
            places = corners.places[i + k : i + k + 2, j : j + 2] - (first, 0)
            yield corner, _resampled(labels, places, shape)


def between(corners: NDArray[np.float64], shape: tuple[int, int]) -> NDArray[np.float64]:
    """Values (*shape, k) at the pixels of a block, bilinear between those at its corners (2, 2, k)."""
    down = ((np.arange(shape[0]) + 0.5) / shape[0])[:, None, None]
    right = ((np.arange(shape[1]) + 0.5) / shape[1])[None, :, None]
    upper, lower = ((1 - right) * edge[0] + right * edge[1] for edge in corners)
    return np.asarray((1 - down) * upper + down * lower)


def _resampled(
    labels: NDArray[np.int8], corners: NDArray[np.float64], shape: tuple[int, int]
) -> NDArray[np.uint8]:
    """One block: its corners (2, 2, 2) are places in the array of labels, in cells."""
    rows, columns = np.moveaxis(np.floor(between(corners, shape)).astype(np.int64), -1, 0)
    inside = (rows >= 0) & (rows < labels.shape[0]) & (columns >= 0) & (columns < labels.shape[1])
    block = np.full(shape, NOTHING, np.int16)
    block[inside] = labels[rows[inside], columns[inside]]
    block[block == UNLABELLED] = GEOTIFF_UNLABELLED
    block[block == NOTHING] = GEOTIFF_NODATA
    return block.astype(np.uint8)


def _colour_table(label_set: LabelSet) -> dict[int, tuple[Any, ...]]:
    table = {i: (*rgb, 255) for i, rgb in enumerate(label_set.legend.colours.tolist())}
    return {**table, GEOTIFF_UNLABELLED: (*UNLABELLED_COLOUR, 255), GEOTIFF_NODATA: (0, 0, 0, 0)}


def _overviews(grid: Grid) -> list[int]:
    """Factors of two until the whole raster fits one block."""
    count = int(np.ceil(np.log2(max(grid.rows, grid.columns) / BLOCK)))
    return [2**i for i in range(1, count + 1)]
