"""Interactive viewer: the map as a web page that works offline and without libraries.

A small map is in the page. Of a large one the page holds coarse voxels, and a folder beside it the finer ones, which
the browser loads as the camera comes near.
"""

from __future__ import annotations

import base64
import html
import json
import zlib
from collections import Counter
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
from numpy.typing import NDArray

from factor_graphs.trajectory import Trajectory
from gnss_sem_map.errors import DataError
from gnss_sem_map.export.changes import box_corners
from gnss_sem_map.export.exported import NO_VOXELS
from gnss_sem_map.export.georeference import Georeference
from gnss_sem_map.export.placing import fitted_placing
from gnss_sem_map.export.viewer_levels import Node, lowest_tile, visit_nodes
from gnss_sem_map.files.atomic import adding_folder, replacing
from gnss_sem_map.labels.label_set import LabelSet
from gnss_sem_map.voxels.semantic_map import State
from gnss_sem_map.voxels.tile_files import TILE_BITS, Z_OFFSET
from gnss_sem_map.voxels.tiles import TiledMap

AXIS_BYTES = 2
"""A zigzag difference of 14-bit heights fits 15 bits."""
PACKING = 4
"""Level of compression: 4 % larger than with zlib's usual 6, in 40 % of its time."""
MOST_POSES = 50_000
"""Of longer tracks the page holds every second pose, every third, ..."""
SCRIPTS = ("viewer_shaders.js", "viewer_levels.js", "viewer_clicks.js", "viewer_link.js", "viewer.js")
FINER_ALLOWED = " 'self' file:"
"""What a page with a folder may load beside what is in it: scripts from its own place."""


def write_viewer(
    tiled_map: TiledMap,
    tracks: Sequence[Trajectory],
    path: Path | str,
    title: str = "Semantic map",
    most_voxels: int = 3_000_000,
    changes: Sequence[Mapping[str, Any]] = (),
    georeference: Georeference | None = None,
) -> None:
    """Write the map as an HTML page that works from file://, some 2 MB per million voxels.

    Classes, the tracks, removed and unlabelled voxels are layers to switch, and so are the boxes of `changes` (rows of
    `Change.about`); colours show class (lighter where it is inferred), height, confidence or where the class comes
    from; labels less sure than a chosen confidence are shown as unlabelled; a click tells what a voxel or a box is, and
    with `georeference` where on Earth. The address of the page follows the view. Up to `most_voxels` the page holds the
    map. Above, voxels are joined by 2 x 2 x 2 until they fit, and the finer levels lie in a folder of the page's name
    (`viewer/` beside `viewer.html`); without it the page shows the coarse voxels, and says so. The map is read tile by
    tile. Raises DataError for an empty map, when that folder exists, and when a file cannot be written.
    """
    path = Path(path)
    if not path.suffix:
        raise DataError(f"{path}: found no suffix, expected a name such as viewer.html")
    if not tiled_map.tiles:
        raise DataError(NO_VOXELS)
    with adding_folder(path.with_suffix("")) as folder:
        levels = _Levels(folder, most_voxels, len(tiled_map.label_set.legend.names))
        visit_nodes(tiled_map, levels.add, most_voxels)
        if not levels.in_page:
            raise DataError(NO_VOXELS)
        meta = _meta(levels, tiled_map, tracks, changes)
        if georeference is not None:
            meta["placing"] = fitted_placing(georeference, *_box(levels, tiled_map))
        page = _page(levels, meta, path.stem, title)
        with replacing(path) as file:
            file.write(page.encode("utf-8"))


class _Levels:
    """The nodes of a map: in memory while their level fits into the page, else in files."""

    def __init__(self, folder: Path, most_voxels: int, classes: int) -> None:
        self._folder = folder
        self._most_voxels = most_voxels
        self._kept: dict[int, list[Node] | None] = {}
        self._voxels: Counter[int] = Counter()
        self._listed: list[tuple[int, list[int]]] = []
        self.counts = np.zeros(classes + 1, np.int64)
        """Voxels of each class, of `other` and without a label, without the removed ones."""
        self.removed = self.inferred = 0

    def add(self, node: Node) -> None:
        if not len(node):
            return
        if node.level == 0:
            stands = node.states != State.REMOVED
            self.counts += np.bincount(node.labels[stands], minlength=len(self.counts))
            self.removed += int(np.count_nonzero(~stands))
            self.inferred += int(np.count_nonzero(node.states == State.INFERRED))
        height = node.cells[:, 2]
        listed = [node.level, *node.corner, int(height.min()), int(height.max()), *node.quadrants]
        self._listed.append((node.level, listed))
        kept = self._kept.setdefault(node.level, [])
        if kept is None:
            self._write(node)
            return
        kept.append(node)
        self._voxels[node.level] += len(node)
        if self._voxels[node.level] > self._most_voxels:
            for each in kept:
                self._write(each)
            self._kept[node.level] = None

    def _write(self, node: Node) -> None:
        name = f"{node.level}_{node.corner[0]}_{node.corner[1]}"
        text = f'voxels("{name}","{_encoded(node)}");\n'
        (self._folder / f"{name}.js").write_text(text, "ascii")

    @property
    def in_page(self) -> list[Node]:
        """The nodes of the finest level that fits into the page."""
        return next((kept for _, kept in sorted(self._kept.items()) if kept is not None), [])

    @property
    def listed(self) -> list[list[int]]:
        """Level, column, row, lowest, highest cell and voxels by quadrant of all nodes of the page and its folder."""
        return [about for level, about in self._listed if level <= self.in_page[0].level]


def _encoded(node: Node) -> str:
    """The voxels of a node in base64, compressed; byte planes, since similar bytes side by side compress well."""
    cells = node.cells.astype(np.int32)
    cells[:, 2] -= cells[:, 2].min()
    differences = np.diff(cells, axis=0, prepend=np.int32(0))
    zigzag = (differences << 1) ^ (differences >> 31)
    coordinates = [zigzag[:, axis] >> (8 * byte) for axis in range(3) for byte in range(AXIS_BYTES)]
    planes = [*(plane.astype(np.uint8) for plane in coordinates), node.labels, node.confidence, node.states]
    packer = zlib.compressobj(PACKING, strategy=zlib.Z_FILTERED)
    packed = packer.compress(np.stack(planes).tobytes()) + packer.flush()
    return base64.b64encode(packed).decode("ascii")


def _page(levels: _Levels, meta: dict[str, Any], folder: str, title: str) -> str:
    nodes = levels.in_page
    meta |= {"folder": folder} if nodes[0].level else {}
    assets = resources.files("gnss_sem_map.export") / "assets"
    return Template((assets / "viewer.html").read_text("utf-8")).substitute(
        title=html.escape(title),
        beside=FINER_ALLOWED if nodes[0].level else "",
        meta=json.dumps(meta, separators=(",", ":")).replace("<", "\\u003c"),  # no </script> inside
        voxels="\n".join(map(_encoded, nodes)),
        script="\n".join((assets / name).read_text("utf-8") for name in SCRIPTS),
    )


def _meta(
    levels: _Levels,
    tiled_map: TiledMap,
    tracks: Sequence[Trajectory],
    changes: Sequence[Mapping[str, Any]],
) -> dict[str, Any]:
    """Metadata for the page; lengths are in voxels of the map from `origin`, the lowest corner of its tiles."""
    west, south = lowest_tile(tiled_map.tiles)
    origin = np.array([west << TILE_BITS, south << TILE_BITS, -Z_OFFSET])
    every = 1 + sum(map(len, tracks)) // MOST_POSES
    lines = [track.positions[::every] / tiled_map.voxel_size_m - origin for track in tracks]
    level = levels.in_page[0].level
    framed = _framed(levels.in_page, tiled_map.label_set)
    low, high = np.percentile(_indices(levels.in_page, axis=2), [2, 98])
    low_corner, high_corner = np.transpose(
        [np.percentile(_indices(levels.in_page, axis)[framed], [2, 98]) for axis in range(3)]
    )
    count = int(levels.counts.sum()) + levels.removed
    about = f"{count:,} voxels of {tiled_map.voxel_size_m:g} m"
    return {
        "about": about,
        "voxel_m": tiled_map.voxel_size_m,
        "count": count,
        "unlabelled": int(levels.counts[-1]),
        "removed": levels.removed,
        "inferred": levels.inferred,
        "origin": origin.tolist(),
        "level": level,
        "nodes": levels.listed,
        "heights": [float(low), float(max(high, low + 1))],
        "view": {
            "target": ((low_corner + high_corner) / 2).tolist(),
            "distance": float(max(40.0, 0.9 * (high_corner - low_corner)[:2].max())),
        },
        "tracks": [line.round(2).tolist() for line in lines],
        "changes": [_changed_box(change, tiled_map.voxel_size_m, origin) for change in changes],
        "classes": [
            {"name": name, "colour": colour, "count": count}
            for name, colour, count in zip(
                tiled_map.label_set.legend.names,
                tiled_map.label_set.legend.colours.tolist(),
                levels.counts[:-1].tolist(),
                strict=True,
            )
        ],
    }


def _box(levels: _Levels, tiled_map: TiledMap) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lowest and highest corner (3,) m of what the map may hold, in the map frame."""
    tiles = np.array(tiled_map.tiles) << TILE_BITS
    finest = np.array([about[3:5] for about in levels.listed if about[0] == 0])
    low = [*tiles.min(axis=0), finest[:, 0].min() - Z_OFFSET]
    high = [*tiles.max(axis=0) + (1 << TILE_BITS), finest[:, 1].max() + 1 - Z_OFFSET]
    return np.array(low) * tiled_map.voxel_size_m, np.array(high) * tiled_map.voxel_size_m


def _changed_box(change: Mapping[str, Any], voxel_m: float, origin: NDArray[np.int64]) -> dict[str, Any]:
    """The box of a changed object, its lower corners first, and what a click says of it."""
    corners = box_corners(change["centre_m"], change["size_m"], np.radians(change["yaw_deg"]))
    size = " x ".join(f"{side:.1f}" for side in change["size_m"])
    return {
        "layer": change["change"],
        "corners": (corners / voxel_m - origin).round(2).tolist(),
        "text": f"{change['class']} {change['change']} ({change['kind']}), {size} m, "
        f"between {change['before']} and {change['after']}",
    }


def _indices(nodes: list[Node], axis: int) -> NDArray[np.int32]:
    """Places (v,) of the voxels of nodes along an axis, in voxels of the map from the origin."""
    corners = [([*node.corner, 0][axis] << TILE_BITS) for node in nodes]
    return np.concatenate(
        [
            (np.int32(corner) + node.cells[:, axis].astype(np.int32)) << node.level
            for corner, node in zip(corners, nodes, strict=True)
        ]
    )


def _framed(nodes: list[Node], label_set: LabelSet) -> NDArray[np.bool_]:
    """The voxels that the first view frames: those with a label, else those that stand, else all."""
    stands = np.concatenate([node.states != State.REMOVED for node in nodes])
    shown = stands & np.concatenate([node.labels < len(label_set.legend.names) for node in nodes])
    return shown if shown.any() else stands if stands.any() else ~stands
