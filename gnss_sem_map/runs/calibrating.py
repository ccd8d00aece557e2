"""Calibration files from finished runs with known truth: the confusion model of their segmentation network."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gnss_sem_map.datasets.label_files import label_files, truth_folder
from gnss_sem_map.errors import DataError
from gnss_sem_map.evaluation.fit_sensor_model import fit_temperature, measure
from gnss_sem_map.files.output_folder import read_whole
from gnss_sem_map.files.run_json import inputs_of
from gnss_sem_map.files.untrusted import shown
from gnss_sem_map.labels.sensor_model import CalibrationDrive, LabelCalibration
from gnss_sem_map.mapping.labelled_scans import Drive
from gnss_sem_map.process.run_stats import Progress, silent
from gnss_sem_map.runs.finished_run import Run
from gnss_sem_map.segmentation import open_segmenter
from gnss_sem_map.voxels.voxel_map import VoxelMap


def calibrate(
    runs: Sequence[tuple[Path, Path]],
    drive: Path | None = None,
    segmenter: str | None = None,
    progress: Progress = silent,
) -> LabelCalibration:
    """Fit the segmentation confusion model on run folders, each with its folder of true `.label` files.

    Drive and segmenter are those of the run unless given; scans and their stamps are those that the run used. The
    temperature is fitted for the confidence of the map without calibration, its systematic error rate included. Raises
    DataError where something is missing, or runs have different classes.
    """
    calibration_drives: list[CalibrationDrive] = []
    counted, label_set = [], None
    for out, truth in runs:
        with read_whole(out):
            opened, voxels = drive_and_map(out, drive, segmenter)
        if label_set is not None and opened.label_set.names != label_set.names:
            raise DataError(
                f"{out}: has classes {list(opened.label_set.names)}, the run before {list(label_set.names)};"
                " one file holds one class set"
            )
        label_set = opened.label_set
        calibration_drive, points = measure(opened, voxels, label_files(truth_folder(truth)), progress)
        calibration_drives.append(calibration_drive)
        counted.append(points)
    if label_set is None:
        raise DataError("calibrate: found no run folder, expected at least one")
    temperature = fit_temperature(*(np.concatenate(parts) for parts in zip(*counted, strict=True)))
    return LabelCalibration(label_set.name, label_set.names, tuple(calibration_drives), temperature)


def drive_and_map(out: Path, drive: Path | None, segmenter: str | None) -> tuple[Drive, VoxelMap]:
    """The drive of a run folder as the run mapped it, and the map before refinement; raises DataError.

    `drive` and `segmenter` are used in place of those that the run names.
    """
    run, inputs = Run(out), inputs_of(out)
    if run.settings.calibration is not None:
        raise DataError(f"{out}: was made with a calibration file; calibrate with a run made without one")
    if segmenter is None and inputs.get("segmenter", "").startswith("python:"):
        raise DataError(
            f"{shown(out)}: its run.json names {inputs['segmenter']!r}, which is code to run; say --segmenter"
            f" {inputs['segmenter']} if you mean it"
        )
    trajectory, segmenter = run.trajectory, segmenter or inputs.get("segmenter")
    if segmenter == "none":
        raise DataError(f"{shown(out)}: was made without labels; calibrate a run with --segmenter")
    if (drive is None and "drive" not in inputs) or segmenter is None:
        raise DataError(
            f"{shown(out)}: its run.json names no drive and segmenter; give --drive and --segmenter"
        )
    log = run.drive(drive)
    network = open_segmenter(segmenter, run.label_set, sizes=log.calibration.image_sizes)
    return Drive(log, trajectory, network, run.settings), run.map(refined=False).voxels
