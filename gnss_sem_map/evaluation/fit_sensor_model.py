"""Fit of the segmentation confusion model on drives with known truth."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from gnss_sem_map.datasets.label_files import read_labels
from gnss_sem_map.errors import DataError
from gnss_sem_map.evaluation.metrics import Tables
from gnss_sem_map.labels.sensor_model import CELLS, CalibrationDrive, cells_of
from gnss_sem_map.mapping.labelled_scans import Drive, LabelledScan, labelled_scans
from gnss_sem_map.process.run_stats import Progress, RunStats, silent
from gnss_sem_map.refinement.by_block import run_steps
from gnss_sem_map.refinement.normals import flatness
from gnss_sem_map.refinement.potts_mrf import LEAST_PROBABILITY
from gnss_sem_map.refinement.systematic_error import doubted
from gnss_sem_map.voxels.voxel_map import VoxelMap, softmax

LOWEST_TEMPERATURE, HIGHEST_TEMPERATURE = 0.5, 20.0
Counted = tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.float32]]
"""For the n counted points: true class (n,), scores of the voxel (n, c), systematic error rate of the map (n,)."""


def measure(
    drive: Drive, voxels: VoxelMap, truths: Mapping[str, Path], progress: Progress = silent
) -> tuple[CalibrationDrive, Counted]:
    """Counts of one drive, and the scores of its map (made without calibration) for the counted points.

    `voxels` is the map of the drive; `truths` are its `.label` files by scan name, of several LiDARs by LIDAR/NAME.
    Points with a pixel and a true class of the map are counted. Raises DataError where there are none, and for truth of
    another drive.
    """
    tables, c = Tables.of(voxels.label_set), len(voxels.label_set.names)
    state, _ = run_steps(voxels, drive.settings.refinement)
    cells = cells_of(state.heights, flatness(voxels.keys))
    answers, found = np.zeros((c, c + 1), np.int64), np.zeros((c, CELLS[0] * CELLS[1]), np.int64)
    true_classes, rows = [], []
    scans = (seen for part in drive.by_lidar for seen in labelled_scans(part, RunStats()))
    for done, seen in enumerate(scans):
        true, answer, row = _points(seen, voxels, truths, tables)
        np.add.at(answers, (true, answer), 1)
        np.add.at(found, (true, cells[row]), 1)
        true_classes.append(true)
        rows.append(row)
        progress("calibrate", done + 1, drive.log.scan_count)
    true = np.concatenate([*true_classes, np.empty(0, np.int64)])
    if not len(true):
        raise DataError(
            f"{drive.log.name}: no point has both a pixel and a true class; is it the truth of this drive?"
        )
    row = np.concatenate(rows)
    doubts = np.full(len(true), state.systematic_error, np.float32)
    return CalibrationDrive(drive.log.name, answers, found.reshape(c, *CELLS)), (
        true,
        state.scores[row],
        doubts,
    )


def _points(
    seen: LabelledScan, voxels: VoxelMap, truths: Mapping[str, Path], tables: Tables
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """True class, predicted class and voxel of every point of a scan that has all three."""
    log = seen.drive.log
    name = f"{log.lidar}/{seen.scan.name}" if log.lidar else seen.scan.name
    if name not in truths:
        raise DataError(f"no truth for scan {name} of {log.name}; is it another drive's?")
    entries = read_labels(truths[name])
    if len(entries) != len(seen.valid):
        raise DataError(
            f"{truths[name]}: found {len(entries)} labels for {len(seen.valid)} points;"
            " are they of the same scan?"
        )
    true = tables.truth[entries[seen.valid] & 0xFFFF].astype(np.int64)
    row = voxels.indices_of(seen.keys)
    labels = seen.labels.astype(np.int64)
    use = (true >= 0) & (true < len(voxels.label_set.names)) & (labels >= 0) & (row >= 0)
    return true[use], labels[use], row[use]


def fit_temperature(
    true: NDArray[np.int64], scores: NDArray[np.float32], doubts: NDArray[np.float32]
) -> float:
    """The temperature under which scores (n, c) with error rates (n,) best predict the true classes (n,).

    The maximum-likelihood one (Guo et al., "On calibration of modern neural networks", 2017).
    """

    def cross_entropy(log_temperature: float) -> float:
        probabilities = doubted(softmax(scores / np.float32(np.exp(log_temperature))), doubts[:, None])
        of_truth = probabilities[np.arange(len(true)), true]
        return -float(np.log(np.maximum(of_truth, LEAST_PROBABILITY)).mean(dtype=np.float64))

    bounds = tuple(np.log([LOWEST_TEMPERATURE, HIGHEST_TEMPERATURE]))
    return float(np.exp(minimize_scalar(cross_entropy, bounds=bounds, method="bounded").x))
