"""The map as COPC: LAZ in an octree, of which a viewer reads the parts and the detail that it shows.

In a tile, voxels are put in Morton order: the first of every cube of 2, 4, 8, ... voxels stands for that cube in the
level as coarse as this, and each voxel lies in the coarsest level in which it stands for one. So every tile is read
once, and a node is written as soon as no tile is left that could add to it. Source: COPC 1.0.
"""

from __future__ import annotations

import errno
import io
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.errors import ConfigError, DataError, how_to_install
from gnss_sem_map.export.exported import NO_VOXELS, Exported
from gnss_sem_map.export.georeference import Georeference
from gnss_sem_map.export.point_cloud import LAZ_SCALE_M, las_header, las_points
from gnss_sem_map.files.atomic import replacing
from gnss_sem_map.voxels.attributes import Attributes
from gnss_sem_map.voxels.semantic_map import SemanticMap, State
from gnss_sem_map.voxels.tile_files import TILE_BITS, Z_OFFSET, Tile, morton_codes

if TYPE_CHECKING:
    import copclib
    import laspy
    import lazrs

NODE_CELLS = 512
"""A node is as wide as so many cells of its level; in a street it has 10,000 voxels on average, 100,000 at most. With
half as many there are three times the nodes, each is packed anew, and the file is 3 % larger."""
OFFSET_BYTES = 8
"""Before the first chunk of a LAZ: where its table of chunks is, which COPC has none of."""
PLACE_BYTES = 12
"""Of a point: its X, Y and Z."""
Node = tuple[int, int, int, int]
"""Level, and place along each axis."""


def write_copc(exported: Exported, path: Path | str) -> None:
    """Write every voxel that was not removed as COPC, with the content of `write_laz`.

    Raises ConfigError without the package `copclib`, DataError for a map without a georeference or without voxels, and
    when the file cannot be written.
    """
    try:
        import copclib
        import lazrs
    except ImportError:
        raise ConfigError(f"COPC needs copclib; {how_to_install('copc')}") from None
    georeference = exported.georeference_for("COPC")
    octree = _Octree.over(exported, georeference)
    header = las_header(exported.map.label_set, georeference, has_times=exported.attributes is not None)
    packing = lazrs.LazVlr.new_for_compression(
        header.point_format.id, header.point_format.num_extra_bytes, True
    )
    with replacing(path) as file:
        writer = copclib.FileWriter(file.name, _config(octree, georeference, header))
        spans = []
        for node, records in _nodes(exported, georeference, octree, header):
            packed = copclib.VectorChar(np.frombuffer(_packed(records, packing), np.int8))
            writer.AddNodeCompressed(copclib.VoxelKey(*node), packed, len(records))
            places = records[:, :PLACE_BYTES].copy().view(np.int32)
            spans.append((len(records), places.min(axis=0), places.max(axis=0)))
        if spans:
            _describe(writer.copc_config.las_header, spans, header)
        writer.Close()
        _refuse_cut(file.name)


def _describe(
    written: copclib.LasHeader,
    spans: Sequence[tuple[int, NDArray[np.int32], NDArray[np.int32]]],
    header: laspy.LasHeader,
) -> None:
    """Bounds and numbers of points, of the points, lowest and highest places of each node; copclib leaves them at 0."""
    import copclib

    counts, lows, highs = zip(*spans, strict=True)
    ends = np.min(lows, axis=0), np.max(highs, axis=0)
    written.min, written.max = (copclib.Vector3(*(header.offsets + LAZ_SCALE_M * end)) for end in ends)
    written.points_by_return = [sum(counts)] + [0] * (len(written.points_by_return) - 1)


def _packed(records: NDArray[np.uint8], packing: lazrs.LazVlr) -> bytes:
    """The points of a node as a chunk of LAZ; copclib packs the same bytes in nearly twice the time."""
    import lazrs

    file = io.BytesIO()
    compressor = lazrs.LasZipCompressor(file, packing)
    compressor.compress_many(records.ravel())
    compressor.finish_current_chunk()
    return file.getvalue()[OFFSET_BYTES:]


def _refuse_cut(name: str) -> None:
    """Raise OSError for a file of which the end is missing: copclib does not say when the disk is full."""
    import laspy

    try:
        with laspy.open(name) as reader:
            complete = bool(reader.header.evlrs)  # the last that is written
    except (laspy.errors.LaspyException, OSError, ValueError, EOFError):
        complete = False
    if not complete:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@dataclass(frozen=True, eq=False)
class _Octree:
    """A cube over the map: its lower corner in the CRS, its edge, and the level of single voxels."""

    low: NDArray[np.float64]
    edge_m: float
    depth: int

    @classmethod
    def over(cls, exported: Exported, georeference: Georeference) -> _Octree:
        extent, size = exported.extent, exported.map.voxel_size_m
        if not extent.count:
            raise DataError(NO_VOXELS)
        # voxels without a label may lie farther than those that the extent is of
        tiles = np.array(exported.map.tiles) * (1 << TILE_BITS)
        low, high = tiles.min(axis=0), tiles.max(axis=0) + (1 << TILE_BITS)
        corners = [
            (x, y, z) for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (-Z_OFFSET, Z_OFFSET)
        ]
        placed = georeference.from_map(np.array(corners) * size)
        widest = float((placed.max(axis=0) - placed.min(axis=0))[:2].max())
        depth = max(0, int(np.ceil(np.log2(widest / (NODE_CELLS * size)))))
        edge = NODE_CELLS * size * 2.0**depth
        middle = georeference.from_map(np.array([(*(low + high) / 2, extent.mean[2])]) * size)[0]
        return cls(middle - edge / 2, edge, depth)

    def nodes(self, points: NDArray[np.float64], levels: NDArray[np.int64]) -> NDArray[np.int64]:
        """Node (n, 4) of points (n, 3) of the CRS."""
        edges = self.edge_m / 2.0**levels
        places = np.floor((points - self.low) / edges[:, None]).astype(np.int64)
        return np.column_stack([levels, np.clip(places, 0, (1 << levels)[:, None] - 1)])

    def tiles(
        self, nodes: Sequence[Node], exported: Exported, georeference: Georeference
    ) -> Iterator[set[Tile]]:
        """Tiles of the map that may have points in each of some nodes."""
        if not nodes:
            return
        levels, *places = np.array(nodes).T
        edges = (self.edge_m / 2.0**levels)[:, None, None]
        around = np.array([(0, 0), (0, 1), (1, 0), (1, 1)])
        corners = self.low[:2] + edges * (np.stack(places[:2], axis=1)[:, None] + around)
        heights = np.full((len(nodes), 4, 1), self.low[2] + self.edge_m / 2)
        p_map = georeference.to_map(np.concatenate([corners, heights], axis=-1).reshape(-1, 3))
        flat = p_map[:, :2].reshape(-1, 4, 2) / exported.map.voxel_size_m
        lows, highs = (np.floor(flat.min(axis=1) - 1), np.ceil(flat.max(axis=1) + 1))
        known = np.array(exported.map.tiles)
        for low, high in zip(lows.astype(int) >> TILE_BITS, highs.astype(int) >> TILE_BITS, strict=True):
            near = ((known >= low) & (known <= high)).all(axis=1)
            yield set(map(tuple, known[near].tolist()))


def _nodes(
    exported: Exported, georeference: Georeference, octree: _Octree, header: laspy.LasHeader
) -> Iterator[tuple[Node, NDArray[np.uint8]]]:
    """Every node and its points as rows of bytes, as soon as it is complete."""
    unread = set(exported.map.tiles)
    parts: dict[Node, list[NDArray[np.uint8]]] = {}
    missing: dict[Node, set[Tile]] = {}
    written: set[Node] = set()

    def add(points: Sequence[tuple[Node, NDArray[np.uint8]]]) -> None:
        fresh = [node for node, _ in points if node not in parts]
        for node, tiles in zip(fresh, octree.tiles(fresh, exported, georeference), strict=True):
            parts[node], missing[node] = [], tiles & unread
        for node, records in points:
            parts[node].append(records)

    for tile in exported.map.tiles:
        add(list(_points_of(*exported.tile(tile), georeference, octree, header)))
        unread.discard(tile)
        for tiles in missing.values():
            tiles.discard(tile)
        # from the finest on, so that a node gets what those below it give before it is written
        while complete := [node for node in parts if not missing[node]]:
            node = max(complete)
            records = np.concatenate(parts.pop(node))
            # readers go down from the root and stop at a level without points: it gets one from below
            for above in _ancestors(node):
                if len(records) and above not in parts and above not in written:
                    add([(above, records[:1])])
                    records = records[1:]
            del missing[node]
            if len(records):
                written.add(node)
                yield node, records


def _points_of(
    piece: SemanticMap,
    attributes: Attributes | None,
    georeference: Georeference,
    octree: _Octree,
    header: laspy.LasHeader,
) -> Iterator[tuple[Node, NDArray[np.uint8]]]:
    """The points of a tile, node by node."""
    stays = np.flatnonzero(piece.states != State.REMOVED)
    if not len(stays):
        return
    piece, attributes = piece[stays], None if attributes is None else attributes[stays]
    points = las_points(piece, attributes, georeference, header)
    levels = np.maximum(octree.depth - _largest_cubes(piece), 0)
    nodes = octree.nodes(np.column_stack([points.x, points.y, points.z]), levels)
    packed = np.zeros(len(nodes), np.int64)  # one number sorts ten times as fast as a row
    for column in nodes.T:
        packed = packed << octree.depth | column
    order = np.argsort(packed, kind="stable")
    starts = np.flatnonzero(np.diff(packed[order], prepend=-1))
    records = np.ascontiguousarray(points.array).view(np.uint8).reshape(len(piece), -1)[order]
    first = map(tuple, nodes[order[starts]].tolist())
    yield from zip(first, np.split(records, starts[1:]), strict=True)


def _ancestors(node: Node) -> Iterator[Node]:
    """The nodes above one, from the root down."""
    level, x, y, z = node
    yield from ((level - up, x >> up, y >> up, z >> up) for up in range(level, 0, -1))


def _largest_cubes(piece: SemanticMap) -> NDArray[np.int64]:
    """(v,) log2 of the edge, in voxels, of the largest cube of the Morton order in which a voxel comes first."""
    x, y, z = np.add(piece.voxels.indices.astype(np.int64), [0, 0, Z_OFFSET]).T
    mask = (1 << TILE_BITS) - 1
    codes = morton_codes(x & mask, y & mask, z)
    order = np.argsort(codes, kind="stable")
    differ = codes[order[1:]] ^ codes[order[:-1]]
    cubes = np.full(len(codes), TILE_BITS, np.int64)
    cubes[order[1:]] = np.minimum((np.frexp(differ.astype(np.float64))[1] - 1) // 3, TILE_BITS)
    return cubes


def _config(octree: _Octree, georeference: Georeference, header: laspy.LasHeader) -> copclib.CopcConfigWriter:
    """Header of the file; copclib takes the names of extra bytes from another LAZ alone."""
    import copclib
    import laspy

    with TemporaryDirectory(prefix="gnss-sem-map-") as folder:
        path = Path(folder) / "header.laz"
        one_point = laspy.ScaleAwarePointRecord.zeros(1, header=header)
        laspy.LasData(header, one_point).write(str(path))
        extra = copclib.LazReader(str(path)).laz_config.extra_bytes_vlr
    config = copclib.CopcConfigWriter(
        7, copclib.Vector3(*[LAZ_SCALE_M] * 3), copclib.Vector3(*header.offsets),
        georeference.crs.to_wkt("WKT1_GDAL"), extra,
    )  # fmt: skip
    middle = octree.low + octree.edge_m / 2
    config.copc_info.center_x, config.copc_info.center_y, config.copc_info.center_z = middle.tolist()
    config.copc_info.halfsize = octree.edge_m / 2
    config.copc_info.spacing = octree.edge_m / NODE_CELLS
    config.las_header.global_encoding |= int(header.global_encoding.gps_time_type)
    config.las_header.generating_software = header.generating_software
    return config
