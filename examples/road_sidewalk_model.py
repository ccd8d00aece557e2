"""Train the model of road against sidewalk that the geometric classifier has from simulated towns.

    python examples/road_sidewalk_model.py 301 330 -o road_sidewalk.npz

drives through the towns of these seeds, maps ten scans at a time, and learns from the exact truth how the shape of a
sidewalk differs from that of a road. Ranges, heights and attitudes get noise of a size that is drawn anew for every ten
scans: a model of streets without noise takes any roughness for a kerb. Intensities are not used. With `--test N` it is
scored on the last N towns, which it has not seen.
"""

import argparse
from dataclasses import fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.geometric_classifier.features import features_of
from gnss_sem_map.geometric_classifier.road_sidewalk import COLUMNS
from gnss_sem_map.geometric_classifier.trees import BoostedTrees
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.simulation import Simulation, prepare
from gnss_sem_map.simulation.kitti_rig import T_IMU_LIDAR
from gnss_sem_map.voxels.voxel_map import VoxelTable, keys_of

VOXEL_M, SCANS, PLACES, ROWS = 0.2, 10, (40, 160, 280), 2000
"""Per place, of each of the two classes, so many rows at most."""
ROAD, SIDEWALK, MOVING = (40, 60), 48, 252
NOISE_M, HEIGHT_M, TILT_RAD = 0.03, 0.02, 0.003
"""Most of the standard deviations of ranges, of the heights of scans and of their tilt."""
LEAST_SHARE = 0.6
"""Of the points of a voxel that are of its class."""
ROUNDS = 40
"""Exact truth needs no smaller steps."""


def main() -> None:
    """Simulate, learn, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("first", type=int, help="first seed")
    parser.add_argument("last", type=int, help="last seed")
    parser.add_argument("-o", type=Path, required=True, help="file to write")
    parser.add_argument("--test", type=int, default=0, help="towns that are only for the score")
    chosen = parser.parse_args()
    rows, classes, towns = [], [], []
    for seed in range(chosen.first, chosen.last + 1):
        town, rng = prepare(30.0, seed), np.random.default_rng(seed)
        for first in PLACES:
            features, labels = excerpt(town, first, rng)
            rows.append(features)
            classes.append(labels)
            towns.append(np.full(len(labels), seed))
        print(f"town {seed} of {chosen.last}", flush=True)
    X, y, of_town = np.concatenate(rows), np.concatenate(classes), np.concatenate(towns)
    known = of_town <= chosen.last - chosen.test
    trees = BoostedTrees.fit(X[known], y[known], np.ones(np.count_nonzero(known)), ROUNDS)
    for name, part in (("learned from", known), ("not seen", ~known)):
        if part.any():
            right = (trees.scores(X[part])[:, 0] > 0) == y[part]
            print(f"{name}: {np.count_nonzero(part)} voxels, {100 * right.mean():.1f} % right")
    np.savez_compressed(chosen.o, **{field.name: getattr(trees, field.name) for field in fields(trees)})


def excerpt(
    town: Simulation, first: int, rng: np.random.Generator
) -> tuple[NDArray[np.float32], NDArray[np.int8]]:
    """Features and classes, 0 road and 1 sidewalk, of voxels of ten scans."""
    noise, height, tilt = rng.uniform(0, (NOISE_M, HEIGHT_M, TILT_RAD))
    table, keys, labels = VoxelTable(VOXEL_M, open_label_set()), [], []
    for number in range(first, first + SCANS):
        scan, (start, end) = town.scan(number), town.sweeps[number]
        columns, column = np.unique(scan.fractions, return_inverse=True)
        T = (town.world.ego.poses(start + columns * (end - start)) @ T_IMU_LIDAR)[column]
        p = scan.points[:, :3].astype(np.float64)
        ranges = np.linalg.norm(p, axis=1)
        p *= (1 + rng.normal(0, noise, len(p)) / np.maximum(ranges, 0.1))[:, None]
        p_map = np.einsum("nij,nj->ni", T[:, :3, :3], p) + T[:, :3, 3]
        p_map[:, 2] += rng.normal(0, height) + (p_map[:, :2] - T[0, :2, 3]) @ rng.normal(0, tilt, 2)
        ids = scan.labels & 0xFFFF
        used = (ranges > 2.5) & (ids > 0) & (ids < MOVING)
        keys.append(keys_of(p_map[used], VOXEL_M))
        labels.append(ids[used])
        inside = p_map[used, 2] / VOXEL_M
        table.add(keys[-1], heights=(256 * (inside - np.floor(inside))).clip(0, 255).astype(np.uint8))
    voxels = table.to_map()
    counts = np.zeros((len(voxels), 3))
    ids = np.concatenate(labels)
    of_class = np.select([np.isin(ids, ROAD), ids == SIDEWALK], [0, 1], 2)
    np.add.at(counts, (voxels.indices_of(np.concatenate(keys)), of_class), 1)
    best, sure = counts.argmax(axis=1), counts.max(axis=1) >= LEAST_SHARE * counts.sum(axis=1)
    places = np.sort(
        np.concatenate([rng.permutation(np.flatnonzero((best == one) & sure))[:ROWS] for one in (0, 1)])
    )
    features = features_of(voxels, np.zeros(len(voxels), np.uint8), places)[:, COLUMNS]
    return np.ascontiguousarray(features), best[places].astype(np.int8)


if __name__ == "__main__":
    main()
