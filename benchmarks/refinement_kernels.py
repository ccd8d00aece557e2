"""How fast the kernels of the refinement are beside what others use, and a map tile by tile; see refinement.py."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map import config
from gnss_sem_map.labels import sensor_model
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.mapping.raw_map import open_raw
from gnss_sem_map.refinement import by_block
from gnss_sem_map.refinement.count_grid import count_grid
from gnss_sem_map.refinement.figures import Sums, figures_of
from gnss_sem_map.refinement.state import Evidence
from gnss_sem_map.voxels.blocks import blocks_of
from gnss_sem_map.voxels.dbscan import dbscan
from gnss_sem_map.voxels.kernels import AXIS_BITS, AXIS_MASK
from gnss_sem_map.voxels.voxel_map import pack

Figures = dict[str, Any]
REPEATS = 7


def cpu(work: Callable[[], Any], repeats: int = 3) -> tuple[float, Any]:
    """Least CPU time of several runs, s, and the result."""
    times = []
    for _ in range(repeats):
        start = time.process_time()
        result = work()
        times.append(time.process_time() - start)
    return min(times), result


def clocked(work: Callable[[], Any]) -> tuple[float, float]:
    """CPU time and time by the clock on the wall of one run, s."""
    start = time.process_time(), time.perf_counter()
    work()
    return time.process_time() - start[0], time.perf_counter() - start[1]


def block_by_block(run: Path) -> Figures:
    """CPU time of the refinement per voxel of the map, halo included."""
    settings = config.load(run / "config.yaml")
    label_set = open_label_set(settings.classes)
    raw = open_raw(run, label_set)
    voxels, steps = raw.fused.whole().voxels, settings.refinement
    beside = Evidence(
        raw.evidence.moved.whole().voxels,
        sensor_model.opened(settings.calibration, label_set),
        raw.evidence.keyframes_near(voxels.centres, steps.free_space.farthest_m),
    )
    halo = by_block.halo_m(steps, voxels.voxel_size_m)
    blocks = {block: raw.around(block, halo) for block in blocks_of(by_block.voxels_by_tile(voxels))}
    of_sums, sums = cpu(lambda: [by_block.sums_of(*part, beside, steps) for part in blocks.items()], REPEATS)
    figures = figures_of(sum(sums, Sums()))
    of_blocks, _ = cpu(
        lambda: [by_block.refine_block(*part, beside, steps, figures) for part in blocks.items()], REPEATS
    )
    return {
        "voxels": len(voxels),
        "tiles": len(raw.fused.tiles),
        "blocks": len(blocks),
        "halo_m": halo,
        "sums_us_per_voxel": 1e6 * of_sums / len(voxels),
        "blocks_us_per_voxel": 1e6 * of_blocks / len(voxels),
    }


def dbscan_beside_sklearn(large: bool) -> Figures:
    """The same clusters, on voxels of walls and parked cars."""
    from sklearn.cluster import DBSCAN

    rng = np.random.default_rng(0)
    dbscan(np.array([(0, 0, 0)]), 2.5, 10)
    figures = {}
    for count in (200_000, 2_000_000)[: 2 if large else 1]:  # every other block of them is left empty
        side = int((count / 3) ** 0.5)
        voxels = np.unique(rng.integers((0, 0, 0), (side, side, 12), (2 * count, 3)), axis=0)
        voxels = voxels[np.sort(rng.permutation(len(voxels))[:count])]
        voxels = voxels[(voxels[:, 0] // 30 + voxels[:, 1] // 30) % 2 == 0]
        ours, clusters = cpu(lambda v=voxels: dbscan(v, 2.5, 10))
        theirs, expected = cpu(lambda v=voxels: DBSCAN(eps=2.5, min_samples=10).fit(v).labels_, repeats=1)
        same = bool((clusters == expected).all())
        figures[str(len(voxels))] = {
            "ratio": theirs / ours,
            "ours_s": ours,
            "sklearn_s": theirs,
            "same": same,
        }
    return figures


def count_grid_beside_bincount(large: bool) -> Figures:
    """Building and vegetation voxels of every column (eq. 8): from the sorted keys of a map to counts of each voxel."""
    rng = np.random.default_rng(0)
    figures = {}
    for side in (500, 1600)[: 2 if large else 1]:
        keys = pack(np.indices((side, side, 20), np.int32).reshape(3, -1).T)
        kinds = rng.integers(-1, 5, len(keys)).astype(np.int8)

        def ours(keys=keys, kinds=kinds) -> NDArray[np.int32]:
            return count_grid(keys, kinds, (3, 4), 1)

        def bincount(keys=keys, kinds=kinds, side=side) -> list[NDArray[np.int32]]:
            column = (keys >> (2 * AXIS_BITS)) * side + ((keys >> AXIS_BITS) & AXIS_MASK)
            column -= column[0]
            return [np.bincount(column, kinds == c, side * side).astype(np.int32)[column] for c in (3, 4)]

        same = bool((ours() == np.stack(bincount(), axis=1)).all())
        times = np.array([[clocked(ours), clocked(bincount)] for _ in range(REPEATS)])
        (cpu_s, wall_s), (their_cpu_s, their_wall_s) = np.median(times, axis=0)
        figures[str(len(keys))] = {
            "ratio": their_cpu_s / cpu_s,
            "wall_ratio": their_wall_s / wall_s,
            "ns_per_voxel": 1e9 * cpu_s / len(keys),
            "wall_ns_per_voxel": 1e9 * wall_s / len(keys),
            "same": same,
        }
    return figures
