"""The map as vectors: areas of road and sidewalk, kerb lines, and outlines of buildings and vehicles.

Ground is vectorised tile by tile. The cells of a tile with nothing on them and a ring around it take part, so every
edge is shared by two areas: simplified edges leave neither gaps nor overlaps, and end at the border of the tile where
they did before. What stands on the ground is followed across tiles, and is finished when no tile beside it is left.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy import ndimage

from gnss_sem_map.export.georeference import Georeference
from gnss_sem_map.labels.roles import Role
from gnss_sem_map.voxels.dbscan import dbscan
from gnss_sem_map.voxels.semantic_map import SemanticMap, State
from gnss_sem_map.voxels.tile_files import TILE_BITS, Tile
from gnss_sem_map.voxels.tiles import TiledMap

# Said of an array in memory, which has none. rasterio ignores the warning itself, but not when two threads export.
warnings.filterwarnings("ignore", "Dataset has no geotransform")

Array = NDArray[np.float64]
SMALLEST_AREA_M2 = 2.0
"""Smaller areas and holes belong to what is around them."""
SIMPLIFIED_M = 0.5
"""Corners whose triangle is smaller than the square of this are cut: Visvalingam and Whyatt (1993)."""
OUTLINE_M = 0.3
"""Outlines differ by so much from those of the cells: Douglas and Peucker (1973)."""
SHORTEST_KERB_M = 1.0
GROUND = (Role.ROAD, Role.SIDEWALK)
"""Layers of these names."""
NOTHING, AROUND = 0, 255


@dataclass(frozen=True)
class Layer:
    """A table of features; its columns are numbers."""

    name: str
    kind: str
    what: str
    columns: tuple[str, ...]


LAYERS = (
    Layer("road", "POLYGON", "area seen as road, cut at tiles of 102.4 m", ("area_m2", "height_m", "confidence")),
    Layer(
        "sidewalk", "POLYGON", "area seen as sidewalk, cut at tiles of 102.4 m",
        ("area_m2", "height_m", "confidence"),
    ),
    Layer("kerbs", "LINESTRING", "where road and sidewalk meet", ("length_m", "confidence")),
    Layer(
        "buildings", "POLYGON", "outlines of what was seen of buildings, which is their facades",
        ("area_m2", "base_m", "top_m", "confidence", "voxels"),
    ),
    Layer(
        "vehicles", "POLYGON", "rectangles around standing vehicles",
        ("length_m", "width_m", "base_m", "top_m", "confidence", "voxels"),
    ),
    Layer("poles", "POINT", "poles, where the class set has them", ("base_m", "top_m", "confidence", "voxels")),
)  # fmt: skip
"""`confidence` is the mean probability of the class; `voxels` were counted; heights are those of the delivery."""


@dataclass(frozen=True, eq=False)
class Feature:
    """A row of a layer: geometry and heights in the coordinates of the delivery.

    Lengths and areas are true metres, of the map frame: those of the projection are not, with EPSG:3857 1.5 times too
    long at 49 degrees.
    """

    layer: str
    geometry: shapely.Geometry
    values: tuple[float, ...]


def features_of(tiled_map: TiledMap, georeference: Georeference) -> Iterator[Feature]:
    """All features of a map, read tile by tile; layers of classes that it has not stay empty."""
    label_set, size = tiled_map.label_set, tiled_map.voxel_size_m
    standing = [
        _Standing(layer, label_set.having(role), gap, size, fewest)
        for layer, role, gap, fewest in (
            ("buildings", Role.BUILDING, 3.0, 30),
            ("vehicles", Role.VEHICLE, 1.5, 30),
            ("poles", Role.POLE, 1.5, 10),  # one of 2 m may be one column
        )
    ]
    ground = np.zeros(len(label_set.names) + 1, np.uint8)  # the last is of `other`, and of -1
    for i, role in enumerate(GROUND, 1):
        ground[label_set.having(role)] = i
    unread = set(tiled_map.tiles)
    for tile in tiled_map.tiles:
        piece = tiled_map.read_tile(tile)
        unread.discard(tile)
        yield from _ground(piece, tile, ground, georeference)
        for objects in standing:
            for columns in objects.finished(piece, unread):
                yield from _object(objects.layer, columns, size, georeference)


def _ground(
    piece: SemanticMap, tile: Tile, ground: NDArray[np.uint8], georeference: Georeference
) -> Iterator[Feature]:
    """Areas and kerbs of one tile."""
    size, edge = piece.voxels.voxel_size_m, 1 << TILE_BITS
    kind = ground[piece.labels]
    chosen = np.flatnonzero((kind > 0) & (piece.states != State.REMOVED))
    if not len(chosen):
        return
    corner = tile[0] * edge - 1, tile[1] * edge - 1
    x, y, z = (piece.voxels.indices[chosen] - (*corner, 0)).T
    cells = np.full((edge + 2, edge + 2), AROUND, np.uint8)
    cells[1:-1, 1:-1] = NOTHING
    heights, confidence = np.zeros(cells.shape, np.float32), np.zeros(cells.shape, np.float32)
    cells[y, x] = kind[chosen]  # in order of height: of a column the highest stays
    heights[y, x], confidence[y, x] = z + 0.5, piece.confidence[chosen]  # surfaces are amid their voxels
    seen = confidence > 0
    parts, kinds = _parts(_sieved(cells, size))
    shapes, numbers = _shapes(parts, corner, size)
    of_part = parts.ravel()
    weights = np.bincount(of_part, seen.ravel())
    mean_height, mean_confidence = (
        np.bincount(of_part, values.ravel()) / np.maximum(weights, 1) for values in (heights, confidence)
    )
    areas = {}
    for i, role in enumerate(GROUND, 1):
        rows = np.flatnonzero(kinds[numbers] == i)
        areas[role] = shapes[rows], mean_confidence[numbers[rows]]
        for row in rows:
            number = numbers[row]
            up = float(mean_height[number]) * size
            shape, [height] = _placed(shapes[row], [up], georeference)
            yield Feature(str(role), shape, (shapes[row].area, height, float(mean_confidence[number])))
    for line, sure in _kerbs(*areas[Role.ROAD], *areas[Role.SIDEWALK]):
        placed, _ = _placed(line, [float(heights[seen].mean()) * size], georeference)
        yield Feature("kerbs", placed, (line.length, sure))


def _sieved(cells: NDArray[np.uint8], size: float) -> NDArray[np.uint8]:
    """The cells of a tile, those of small areas given to what is around them; the ring around it stays."""
    from rasterio import features

    sieved = cells.copy()
    least = max(round(SMALLEST_AREA_M2 / size**2), 1)
    sieved[1:-1, 1:-1] = features.sieve(np.ascontiguousarray(cells[1:-1, 1:-1]), least, connectivity=4)
    return sieved


def _shapes(
    parts: NDArray[np.int32], corner: tuple[int, int], size: float
) -> tuple[NDArray[np.object_], NDArray[np.int64]]:
    """Simplified outlines (n,) of parts in metres of the map, and the number of the part of each.

    `corner`: index of the cell in the lowest row and column.
    """
    from rasterio import Affine, features

    to_metres = Affine(size, 0, corner[0] * size, 0, size, corner[1] * size)
    found = list(features.shapes(parts, connectivity=4, transform=to_metres))
    polygons = np.array([_polygon(shape["coordinates"]) for shape, _ in found])
    numbers = np.array([int(number) for _, number in found])
    return shapely.coverage_simplify(polygons, SIMPLIFIED_M, simplify_boundary=False), numbers


def _parts(cells: NDArray[np.uint8]) -> tuple[NDArray[np.int32], NDArray[np.uint8]]:
    """Connected parts of equal cells, numbered from 0, and the value of each."""
    parts, kinds = np.zeros(cells.shape, np.int32), [np.empty(0, np.uint8)]
    count = 0
    for kind in np.unique(cells):
        numbers, found = ndimage.label(cells == kind)
        parts += np.where(numbers > 0, numbers - 1 + count, 0).astype(np.int32)
        kinds.append(np.full(found, kind, np.uint8))
        count += found
    return parts, np.concatenate(kinds)


def _kerbs(
    roads: NDArray[np.object_], sure_roads: Array, walks: NDArray[np.object_], sure_walks: Array
) -> Iterator[tuple[shapely.Geometry, float]]:
    """The edges that a road and a sidewalk share, and the confidence of the less certain one."""
    if not len(roads) or not len(walks):
        return
    road, walk = shapely.STRtree(walks).query(roads, predicate="touches")
    shared = shapely.intersection(shapely.boundary(roads[road]), shapely.boundary(walks[walk]))
    for edge, sure in zip(shared, np.minimum(sure_roads[road], sure_walks[walk]), strict=True):
        for line in shapely.get_parts(shapely.line_merge(edge)):
            if line.length >= SHORTEST_KERB_M and line.geom_type == "LineString":
                yield line, float(sure)


@dataclass
class _Standing:
    """The objects of one role: the columns of those that a tile that is not read yet may go on with."""

    layer: str
    labels: Sequence[int]
    gap_voxels: float
    voxel_size_m: float
    fewest_voxels: int
    """Of an object."""
    open: NDArray[np.int64] = field(default_factory=lambda: np.empty((0, 5), np.int64))
    """(n, 5): index x and y, lowest and highest z, voxels."""
    confidence: Array = field(default_factory=lambda: np.empty(0))
    """(n,) sum over the voxels of each column."""

    def finished(self, piece: SemanticMap, unread: set[Tile]) -> Iterator[tuple[NDArray[np.int64], Array]]:
        """Take in a tile; yield the columns of every object that no other tile can go on with."""
        columns, confidence = _columns(piece, self.labels)
        columns, confidence = (
            np.concatenate([self.open, columns]),
            np.concatenate([self.confidence, confidence]),
        )
        order = np.lexsort(columns[:, 1::-1].T)
        columns, confidence = columns[order], confidence[order]
        clusters = dbscan(columns[:, :3] * (1, 1, 0), self.gap_voxels, 1)
        is_open = np.zeros(clusters.max(initial=-1) + 1, bool)
        is_open[clusters[_beside(columns, int(np.ceil(self.gap_voxels)), unread)]] = True
        stays = is_open[clusters]
        self.open, self.confidence = columns[stays], confidence[stays]
        order = np.argsort(clusters, kind="stable")
        for rows in np.split(order, np.flatnonzero(np.diff(clusters[order])) + 1):
            if len(rows) and not stays[rows[0]] and columns[rows, 4].sum() >= self.fewest_voxels:
                yield columns[rows], confidence[rows]


def _columns(piece: SemanticMap, labels: Sequence[int]) -> tuple[NDArray[np.int64], Array]:
    """The columns of some classes in one tile."""
    chosen = np.flatnonzero(np.isin(piece.labels, labels) & (piece.states != State.REMOVED))
    if not len(chosen):
        return np.empty((0, 5), np.int64), np.empty(0)
    indices = piece.voxels.indices[chosen].astype(np.int64)  # sorted by x, y, z
    first = np.flatnonzero(np.append(True, (np.diff(indices[:, :2], axis=0) != 0).any(axis=1)))
    last = np.append(first[1:], len(indices)) - 1
    columns = np.column_stack([indices[first], indices[last, 2], last - first + 1])
    return columns, np.add.reduceat(piece.confidence[chosen].astype(np.float64), first)


def _beside(columns: NDArray[np.int64], reach: int, unread: set[Tile]) -> NDArray[np.bool_]:
    """(n,) whether a tile that is not read yet lies within reach of a column."""
    is_beside = np.zeros(len(columns), bool)
    for dx in (-reach, reach):
        for dy in (-reach, reach):
            x, y = (columns[:, :2] + (dx, dy) >> TILE_BITS).T
            _, first, of = np.unique((x << 32) + y, return_index=True, return_inverse=True)
            tiles = zip(x[first].tolist(), y[first].tolist(), strict=True)
            is_beside |= np.array([tile in unread for tile in tiles], bool)[of]
    return is_beside


def _object(
    layer: str, found: tuple[NDArray[np.int64], Array], size: float, georeference: Georeference
) -> Iterator[Feature]:
    columns, confidence = found
    levels, shared = _about(columns, confidence, size)
    match layer:
        case "poles":
            shape, heights = _placed(
                shapely.Point((columns[:, :2].mean(axis=0) + 0.5) * size), levels, georeference
            )
            yield Feature(layer, shape, (*heights, *shared))
        case "vehicles":
            corners = [columns[:, :2] + corner for corner in ((0, 0), (1, 0), (0, 1), (1, 1))]
            rectangle = shapely.oriented_envelope(shapely.MultiPoint(np.concatenate(corners) * size))
            shape, heights = _placed(rectangle, levels, georeference)
            sides = np.linalg.norm(np.diff(shapely.get_coordinates(rectangle)[:3], axis=0), axis=1)
            yield Feature(layer, shape, (float(sides.max()), float(sides.min()), *heights, *shared))
        case _:
            for outline, its in _outlines(columns[:, :2], size):
                levels, shared = _about(columns[its], confidence[its], size)
                shape, heights = _placed(outline, levels, georeference)
                yield Feature(layer, shape, (outline.area, *heights, *shared))


def _about(
    columns: NDArray[np.int64], confidence: Array, size: float
) -> tuple[list[float], tuple[float, float]]:
    """Lowest and highest z of some columns, m; mean confidence and number of their voxels."""
    voxels = int(columns[:, 4].sum())
    levels = [columns[:, 2].min() * size, (columns[:, 3].max() + 1) * size]
    return levels, (float(confidence.sum()) / voxels, float(voxels))


def _outlines(cells: NDArray[np.int64], size: float) -> Iterator[tuple[shapely.Polygon, NDArray[np.bool_]]]:
    """Polygons around cells (n, 2), with gaps of up to four cells closed, and which cells (n,) are in each."""
    from rasterio import Affine, features

    low = cells.min(axis=0) - 3
    x, y = (cells - low).T
    mask = np.zeros((y.max() + 4, x.max() + 4), bool)
    mask[y, x] = True
    parts, _ = ndimage.label(ndimage.binary_closing(mask, np.ones((3, 3), bool), iterations=2))
    to_metres = Affine(size, 0, low[0] * size, 0, size, low[1] * size)
    for shape, number in features.shapes(parts, mask=parts > 0, connectivity=4, transform=to_metres):
        outline = shapely.simplify(_polygon(shape["coordinates"]), OUTLINE_M)
        if outline.area >= SMALLEST_AREA_M2:
            yield outline, parts[y, x] == number


def _polygon(rings: list[list[tuple[float, float]]]) -> shapely.Polygon:
    outline, *holes = map(np.array, rings)  # shapely would look at every coordinate by itself
    return shapely.Polygon(outline, holes)


def _placed(
    shape: shapely.Geometry, up: list[float], georeference: Georeference
) -> tuple[shapely.Geometry, list[float]]:
    """A shape in the map frame at the first of some heights -> in the CRS, and these heights there."""
    x, y = shapely.get_coordinates(shape)[0]
    heights = georeference.from_map(np.array([(x, y, each) for each in up]))[:, 2].tolist()
    placed = shapely.transform(
        shape, lambda xy: georeference.from_map(np.column_stack([xy, np.full(len(xy), up[0])]))[:, :2]
    )
    return placed, heights
