"""Fit of the segmentation confusion model: calibration files from run folders with known truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from factor_graphs.trajectory import Trajectory
from gnss_sem_map import config
from gnss_sem_map.datasets import open_drive
from gnss_sem_map.datasets.label_files import label_files, read_labels, truth_folder
from gnss_sem_map.errors import DataError
from gnss_sem_map.evaluation.metrics import Tables
from gnss_sem_map.files.run_json import inputs_of
from gnss_sem_map.files.untrusted import shown
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.labels.sensor_model import CELLS, CalibrationDrive, LabelCalibration, cells_of
from gnss_sem_map.mapping.labelled_scans import Drive, LabelledScan, labelled_scans
from gnss_sem_map.refinement.by_tile import run_steps
from gnss_sem_map.refinement.normals import flatness
from gnss_sem_map.refinement.potts_mrf import LEAST_PROBABILITY
from gnss_sem_map.refinement.systematic_error import doubted
from gnss_sem_map.run_stats import Progress, RunStats, silent
from gnss_sem_map.segmentation import open_segmenter
from gnss_sem_map.voxels import tiles
from gnss_sem_map.voxels.voxel_map import VoxelMap, keys_of, softmax

LOWEST_TEMPERATURE, HIGHEST_TEMPERATURE = 0.5, 20.0
Counted = tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.float32]]
"""For the n counted points: true class (n,), scores of the voxel (n, c), systematic error rate of the map (n,)."""


def calibrate(
    runs: Sequence[tuple[Path, Path]],
    drive: Path | None = None,
    segmenter: str | None = None,
    progress: Progress = silent,
) -> LabelCalibration:
    """Fit the segmentation confusion model on run folders, each with its folder of true `.label` files.

    Drive and segmenter are those of the run unless given. Points with a pixel and a true class of the map are counted.
    The temperature is the maximum-likelihood one for the confidence of the map without calibration, its systematic
    error rate included (Guo et al., "On calibration of modern neural networks", 2017). Raises DataError where something
    is missing, or runs have different classes.
    """
    calibration_drives, counted, label_set = [], [], None
    for out, truth in runs:
        opened, voxels = _open(out, drive, segmenter)
        of_run = open_label_set(opened.settings.classes)
        if label_set is not None and of_run.names != label_set.names:
            raise DataError(
                f"{out}: has classes {list(of_run.names)}, the run before {list(label_set.names)};"
                " one file holds one class set"
            )
        label_set = of_run
        calibration_drive, points = measure(opened, voxels, _truths(truth), progress)
        calibration_drives.append(calibration_drive)
        counted.append(points)
    if label_set is None:
        raise DataError("calibrate: found no run folder, expected at least one")
    temperature = fit_temperature(*(np.concatenate(parts) for parts in zip(*counted, strict=True)))
    return LabelCalibration(label_set.name, label_set.names, tuple(calibration_drives), temperature)


def measure(
    drive: Drive, voxels: VoxelMap, truths: Mapping[str, Path], progress: Progress = silent
) -> tuple[CalibrationDrive, Counted]:
    """Counts of one drive, and the scores of its map (made without calibration) for the counted points.

    `voxels` is the map of the drive; `truths` are its `.label` files by scan name.
    """
    tables, c = Tables.of(voxels.label_set), len(voxels.label_set.names)
    state, _ = run_steps(voxels, drive.settings.refinement)
    cells = cells_of(state.heights, flatness(voxels.keys))
    answers, found = np.zeros((c, c + 1), np.int64), np.zeros((c, CELLS[0] * CELLS[1]), np.int64)
    true_classes, rows = [], []
    for done, seen in enumerate(labelled_scans(drive, RunStats())):
        true, answer, row = _points(drive, seen, voxels, truths, tables)
        np.add.at(answers, (true, answer), 1)
        np.add.at(found, (true, cells[row]), 1)
        true_classes.append(true)
        rows.append(row)
        progress("calibrate", done + 1, len(drive.log.scans))
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
    drive: Drive, seen: LabelledScan, voxels: VoxelMap, truths: Mapping[str, Path], tables: Tables
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """True class, predicted class and voxel of every point of a scan that has all three."""
    if seen.scan.name not in truths:
        raise DataError(f"no truth for scan {seen.scan.name} of {drive.log.name}; is it another drive's?")
    entries = read_labels(truths[seen.scan.name])
    if len(entries) != len(seen.valid):
        raise DataError(
            f"{truths[seen.scan.name]}: found {len(entries)} labels for {len(seen.valid)} points;"
            " are they of the same scan?"
        )
    true = tables.truth[entries[seen.valid] & 0xFFFF].astype(np.int64)
    row = voxels.indices_of(keys_of(seen.p_map, drive.settings.mapping.voxel_size_m))
    use = (true >= 0) & (seen.pixels >= 0) & (row >= 0)
    use[use] = seen.classes[seen.pixels[use]].any(axis=1)  # a void pixel has no predicted class
    return true[use], seen.labels[use].astype(np.int64), row[use]


def fit_temperature(
    true: NDArray[np.int64], scores: NDArray[np.float32], doubts: NDArray[np.float32]
) -> float:
    """The temperature under which scores (n, c) with error rates (n,) best predict the true classes (n,)."""

    def cross_entropy(log_temperature: float) -> float:
        probabilities = doubted(softmax(scores / np.float32(np.exp(log_temperature))), doubts[:, None])
        of_truth = probabilities[np.arange(len(true)), true]
        return -float(np.log(np.maximum(of_truth, LEAST_PROBABILITY)).mean(dtype=np.float64))

    bounds = tuple(np.log([LOWEST_TEMPERATURE, HIGHEST_TEMPERATURE]))
    return float(np.exp(minimize_scalar(cross_entropy, bounds=bounds, method="bounded").x))


def _open(out: Path, drive: Path | None, segmenter: str | None) -> tuple[Drive, VoxelMap]:
    """The drive of a run folder, with the run's settings and trajectory, and the map before refinement."""
    settings = config.load(out / "config.yaml")
    if settings.calibration is not None:
        raise DataError(f"{out}: was made with a calibration file; calibrate with a run made without one")
    inputs = inputs_of(out)
    if segmenter is None and inputs.get("segmenter", "").startswith("python:"):
        raise DataError(
            f"{shown(out)}: its run.json names {inputs['segmenter']!r}, which is code to run; say --segmenter"
            f" {inputs['segmenter']} if you mean it"
        )
    drive = drive or (Path(inputs["drive"]) if "drive" in inputs else None)
    segmenter = segmenter or inputs.get("segmenter")
    if drive is None or segmenter is None or segmenter == "none":
        raise DataError(
            f"{shown(out)}: its run.json names no drive and segmenter; give --drive and --segmenter"
        )
    log, label_set = open_drive(drive), open_label_set(settings.classes)
    network = open_segmenter(segmenter, label_set, sizes=log.calibration.image_sizes)
    trajectory = Trajectory.load(out / "trajectory.parquet")
    return Drive(log, trajectory, network, settings), tiles.read(out / "map", label_set).voxels


def _truths(truth: Path) -> dict[str, Path]:
    return label_files(truth_folder(truth))
