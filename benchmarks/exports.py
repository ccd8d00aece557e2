"""What each file of a large map costs: the tiles of a finished run, repeated side by side, are exported.

python benchmarks/exports.py RUN [--million-voxels 10] [--formats laz,copc]

The figures are the time on one core and the size of the files. Tiles come from memory: to read one from its file takes
another 0.1 to 0.2 us per voxel. The memory is the highest of the process so far, with 30 MB of tiles or so.
"""

from __future__ import annotations

import argparse
import json
import math
import resource
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from results_file import keep

from gnss_sem_map.export.exported import Exported
from gnss_sem_map.export.formats import FORMATS
from gnss_sem_map.runs.finished_run import Run
from gnss_sem_map.runs.tracks import tracks_of
from gnss_sem_map.voxels import tiles
from gnss_sem_map.voxels.attributes import Attributes, TiledAttributes, open_attributes
from gnss_sem_map.voxels.kernels import AXIS_BITS
from gnss_sem_map.voxels.semantic_map import SemanticMap
from gnss_sem_map.voxels.tile_files import TILE_BITS, Tile
from gnss_sem_map.voxels.tiles import TiledMap

RESULTS = Path(__file__).parent / "results" / "exports.json"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path)
    parser.add_argument("--million-voxels", type=float, default=10.0)
    parser.add_argument("--formats", default=",".join(one.name for one in FORMATS if one.name != "flight"))
    parser.add_argument("--out", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    run = Run.open(arguments.run)
    small = tiles.open_map(run.folder / "refined", run.label_set)
    copies = math.ceil(1e6 * arguments.million_voxels / sum(map(len, small)))
    source = places(small, copies)
    attributes = open_attributes(run.folder)
    exported = Exported(
        repeated(small, source),
        tracks_of(run.folder),
        "repeated",
        attributes=None if attributes is None else RepeatedAttributes.over(attributes, small, source),
    )
    voxels = copies * sum(map(len, small))
    about = {"million_voxels": round(voxels / 1e6, 1), "tiles": len(exported.map.tiles)}
    for name, figures in costs(exported, voxels, arguments.formats.split(",")):
        keep(arguments.out, {name: about | figures}, "laspy", "rasterio")
        print(name, json.dumps(figures), flush=True)


def places(small: TiledMap, copies: int) -> dict[Tile, Tile]:
    """Tiles of a map beside its copies, in a square, and the tile of the map that each repeats."""
    width, depth = np.ptp(np.array(small.tiles), axis=0) + 1
    edge = math.ceil(math.sqrt(copies))
    return {
        (x + int(width) * (copy // edge - edge // 2), y + int(depth) * (copy % edge - edge // 2)): (x, y)
        for copy in range(copies)
        for x, y in small.tiles
    }


def shift(tile: Tile, source: Tile) -> int:
    """What keys of the tile `source` are greater by in `tile`."""
    return ((tile[0] - source[0]) << TILE_BITS + 2 * AXIS_BITS) + (
        (tile[1] - source[1]) << TILE_BITS + AXIS_BITS
    )


def repeated(small: TiledMap, source: dict[Tile, Tile]) -> TiledMap:
    """The map in all places."""
    held = {tile: small.read_tile(tile) for tile in small.tiles}

    def read_tile(tile: Tile) -> SemanticMap:
        piece = held[source[tile]]
        return replace(
            piece, voxels=replace(piece.voxels, keys=piece.voxels.keys + shift(tile, source[tile]))
        )

    return replace(
        small,
        tiles=tuple(sorted(source)),
        read_tile=read_tile,
        read_voxels=lambda tile: read_tile(tile).voxels,
    )


@dataclass(frozen=True)
class RepeatedAttributes(TiledAttributes):
    """Last moments and intensities of the map in all places."""

    held: dict[Tile, Attributes]
    source: dict[Tile, Tile]

    @classmethod
    def over(
        cls, attributes: TiledAttributes, small: TiledMap, source: dict[Tile, Tile]
    ) -> RepeatedAttributes:
        return cls((), {tile: attributes.read_tile(tile) for tile in small.tiles}, source)

    def read_tile(self, tile: Tile) -> Attributes:
        piece = self.held[self.source[tile]]
        return replace(piece, keys=piece.keys + shift(tile, self.source[tile]))


def costs(exported: Exported, voxels: int, names: list[str]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Of every format; the extent of the map, which is found once, is not in it."""
    _ = exported.extent
    for each in FORMATS:
        if each.name not in names:
            continue
        with TemporaryDirectory() as folder:
            begun = time.process_time()
            each.write(exported, Path(folder) / each.file)
            seconds = time.process_time() - begun
            size = sum(file.stat().st_size for file in Path(folder).rglob("*") if file.is_file())
        yield (
            each.name,
            {
                "cpu_us_per_voxel": round(1e6 * seconds / voxels, 2),
                "mb": round(size / 1e6, 1),
                "peak_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024),
            },
        )


if __name__ == "__main__":
    main()
