"""What the viewer of a large map costs: a made-up town is written tile by tile, small and large.

python benchmarks/viewer.py [--tiles 4 15]

The figures are the time on one core, without that of making the tiles, the memory at its peak, beside what Python and
its libraries take, and the size of page and folder.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import resource
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from results_file import keep

from gnss_sem_map.export.viewer import write_viewer
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.voxels.semantic_map import SemanticMap, State
from gnss_sem_map.voxels.tile_files import TILE_BITS, Tile
from gnss_sem_map.voxels.tiles import TiledMap
from gnss_sem_map.voxels.voxel_map import VoxelMap, pack

RESULTS = Path(__file__).parent / "results" / "viewer.json"
LABELS = open_label_set()
COLUMNS = 1 << TILE_BITS
TREES, LEAVES = 40, 1500
ROAD, SIDEWALK, BUILDING, VEGETATION = 0, 1, 3, 4


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--tiles", type=int, nargs="+", default=[4, 15], help="along the edge of the town")
    parser.add_argument("--out", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    for edge in arguments.tiles:
        with multiprocessing.get_context("spawn").Pool(1) as fresh:  # a peak of its own
            found = fresh.apply(cost, (edge,))
        print(json.dumps(found))
        keep(arguments.out, {f"{edge} x {edge} tiles": found})


def cost(edge: int) -> dict[str, Any]:
    """Write the viewer of a town of `edge` x `edge` tiles."""
    voxels, making = 0, 0.0

    def read_tile(tile: Tile) -> SemanticMap:
        nonlocal voxels, making
        begun = time.process_time()
        piece = town(tile)
        voxels, making = voxels + len(piece), making + time.process_time() - begun
        return piece

    tiles = tuple((x, y) for x in range(-(edge // 2), edge - edge // 2) for y in range(edge))
    town(tiles[0])
    before, begun = peak_mb(), time.process_time()
    with TemporaryDirectory() as folder:
        tiled = TiledMap(0.2, LABELS, None, tiles, read_tile, lambda tile: read_tile(tile).voxels)
        write_viewer(tiled, (), Path(folder) / "viewer.html")
        seconds = time.process_time() - begun - making
        finer = [file.stat().st_size for file in Path(folder).glob("viewer/*")]
        page = (Path(folder) / "viewer.html").stat().st_size
    return {
        "tiles": len(tiles),
        "million_voxels": round(voxels / 1e6, 1),
        "cpu_s": round(seconds, 1),
        "cpu_us_per_voxel": round(1e6 * seconds / voxels, 2),
        "peak_mb": round(peak_mb() - before),
        "page_mb": round(page / 1e6, 1),
        "folder_mb": round(sum(finer) / 1e6, 1),
        "files": len(finer),
    }


def peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def town(tile: Tile) -> SemanticMap:
    """A tile of two crossing streets with pavements, walls and trees; a fifth of its voxels has no label."""
    rng = np.random.default_rng([tile[0] + 1000, tile[1] + 1000])
    corner = np.array([*tile, 0]) << TILE_BITS
    x, y = np.indices((COLUMNS, COLUMNS))
    aside = np.minimum(abs(x - COLUMNS // 2), abs(y - COLUMNS // 2))
    wall = ((aside == 41) | (aside == 42)) & ((x // 64 + y // 64) % 3 > 0)
    heights = np.where(wall, 30 + (7 * (x // 64) + 13 * (y // 64)) % 30, aside < 40).ravel()
    column = np.repeat(np.arange(heights.size), heights)
    up = np.arange(len(column)) - np.repeat(np.cumsum(heights) - heights, heights)
    ground = np.column_stack([x.ravel()[column], y.ravel()[column], up])
    classes = np.where(wall, BUILDING, np.where(aside < 25, ROAD, SIDEWALK)).ravel()[column]
    trunks = rng.integers([50, 50, 20], [COLUMNS - 50, COLUMNS - 50, 30], (TREES, 1, 3))
    leaves = (trunks + rng.normal(0, 6, (TREES, LEAVES, 3)).clip(-20, 20)).astype(np.int64).reshape(-1, 3)
    keys, first = np.unique(pack(np.concatenate([ground, leaves]) + corner), return_index=True)
    labels = np.concatenate([classes, np.full(len(leaves), VEGETATION)])[first]
    labels[rng.random(len(labels)) < 0.2] = -1
    evidence = np.zeros((len(keys), len(LABELS.names)), np.int32)
    hits = rng.integers(1, 300, len(keys)).astype(np.uint32)
    return SemanticMap(
        VoxelMap(0.2, LABELS, keys, evidence, hits),
        labels.astype(np.int8),
        np.where(labels < 0, 0, rng.uniform(0.4, 1, len(keys))).astype(np.float32),
        np.where(labels < 0, State.UNOBSERVED, State.OBSERVED).astype(np.uint8),
    )


if __name__ == "__main__":
    main()
