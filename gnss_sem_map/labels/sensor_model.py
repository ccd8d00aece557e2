"""Segmentation confusion model, measured on drives with known truth: the calibration file.

For every calibration drive it holds counts only: the confusion matrix of true and predicted classes, and a histogram
of height over ground and flatness per true class. Likelihoods are computed from the counts, so that files of several
drives can be combined.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from gnss_sem_map.errors import ConfigError, one_line
from gnss_sem_map.files.structured import read_yaml
from gnss_sem_map.files.untrusted import refused, shown
from gnss_sem_map.labels.label_set import LabelSet

HEIGHT_EDGES_M = (-0.3, -0.15, -0.05, 0.05, 0.15, 0.3, 0.5, 0.8, 1.2, 1.6, 2.0, 3.0, 4.0, 6.0)
FLATNESS_EDGES = (0.3, 0.6, 0.8, 0.9, 0.96)
CELLS = (len(HEIGHT_EDGES_M) + 1, len(FLATNESS_EDGES) + 2)
"""Bins of height, and of flatness with one more for unknown flatness."""
ANSWER_PSEUDO_COUNTS, CELL_PSEUDO_COUNTS = 300, 200
"""Additive smoothing: so many points, distributed as the average over classes, are added to each class."""
FORMAT = 1
LARGEST_COUNT = 10**15


@dataclass(frozen=True, eq=False)
class CalibrationDrive:
    """Counts of one drive with known truth, c true classes."""

    name: str
    answers: NDArray[np.int64]
    """(c, c + 1) confusion matrix: points by true class and predicted class, `other` last."""
    cells: NDArray[np.int64]
    """(c, 15, 7) points by true class, height over ground and flatness."""


@dataclass(frozen=True, eq=False)
class LabelCalibration:
    """Segmentation confusion model: the counts of one or more drives, and the temperature of the confidence."""

    class_set: str
    names: tuple[str, ...]
    drives: tuple[CalibrationDrive, ...]
    temperature: float

    def __post_init__(self) -> None:
        c = len(self.names)
        if not self.drives or not np.isfinite(self.temperature) or self.temperature <= 0:
            raise ConfigError(
                f"label calibration: found {len(self.drives)} drives, temperature {self.temperature}; expected above 0"
            )
        for drive in self.drives:
            for what, counts, shape in (
                ("answers", drive.answers, (c, c + 1)),
                ("cells", drive.cells, (c, *CELLS)),
            ):
                if counts.shape != shape or (counts < 0).any():
                    raise ConfigError(
                        f"label calibration: drive {drive.name!r}: found {what} {counts.shape},"
                        f" expected {shape} counts that are not negative"
                    )

    @cached_property
    def log_likelihoods(self) -> NDArray[np.float64]:
        """(c + 1, c) nat: log likelihood of each true class for each predicted class.

        ln P(predicted class | true class), averaged over drives before the logarithm, so that every drive has the same
        weight; shifted so that the probabilities of a row sum to one, which changes no decision. It takes the place of
        the network's own probabilities in the Bayes update of eq. 6.
        """
        answers = np.stack([drive.answers for drive in self.drives])
        logs = np.log(_mean_share(answers, ANSWER_PSEUDO_COUNTS)).T
        return np.asarray(logs - np.log(np.exp(logs).sum(axis=1, keepdims=True)))

    def of_geometry(
        self, heights: NDArray[np.floating], flatness: NDArray[np.floating]
    ) -> NDArray[np.float32]:
        """ln P(height, flatness | class) (v, c) nat, for heights (v,) m over ground and flatness (v,), NaN unknown.

        Replaces the rules of `refinement.geometric_prior` where a calibration file is given.
        """
        counts = np.stack([drive.cells.reshape(len(self.names), -1) for drive in self.drives])
        logs = np.log(_mean_share(counts, CELL_PSEUDO_COUNTS)).T.astype(np.float32)
        return logs.take(cells_of(heights, flatness), axis=0)

    def to_yaml(self) -> str:
        """The file that `read` reads back."""
        drives = [
            {"name": s.name, "answers": s.answers.tolist(), "cells": s.cells.tolist()} for s in self.drives
        ]
        content = {
            "format": FORMAT, "class_set": self.class_set, "classes": list(self.names),
            "temperature": round(self.temperature, 4), "streets": drives,
        }  # fmt: skip
        return yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=120)


def _mean_share(counts: NDArray[np.int64], pseudo_counts: int) -> NDArray[np.float64]:
    """Relative frequencies (c, k) from counts (drives, c, k), smoothed for each drive, then averaged over drives."""
    average = counts.sum(axis=1, keepdims=True) + 1.0
    average /= average.sum(axis=2, keepdims=True)
    shares = (counts + pseudo_counts * average) / (counts.sum(axis=2, keepdims=True) + pseudo_counts)
    return np.asarray(shares.mean(axis=0))


def cells_of(heights: NDArray[np.floating], flatness: NDArray[np.floating]) -> NDArray[np.int64]:
    """Index (v,) in the flattened histogram for heights (v,) m and flatness (v,), NaN for unknown."""
    row = np.searchsorted(HEIGHT_EDGES_M, heights, side="right")
    column = np.searchsorted(FLATNESS_EDGES, np.nan_to_num(flatness), side="right")
    return np.asarray(row * CELLS[1] + np.where(np.isnan(flatness), CELLS[1] - 1, column), np.int64)


def read(file: Path, label_set: LabelSet) -> LabelCalibration:
    """Read a calibration file; raises ConfigError for a damaged one, or one of another class set."""
    content = read_yaml(file, ConfigError)
    try:
        if not isinstance(content, dict) or content.get("format") != FORMAT:
            raise ValueError(f"no label calibration of format {FORMAT}")
        found = LabelCalibration(
            class_set=str(content["class_set"])[:100],
            names=tuple(str(name)[:100] for name in content["classes"]),
            drives=tuple(
                CalibrationDrive(str(s["name"])[:100], _counts(s["answers"]), _counts(s["cells"]))
                for s in content["streets"]
            ),
            temperature=float(content["temperature"]),
        )
    except (KeyError, TypeError, ValueError, OverflowError, AttributeError) as error:
        reason = one_line(error, 300)
        raise ConfigError(f"{shown(file)}: {reason}; expected a file of `gnss-sem-map calibrate`") from None
    if found.names != label_set.names:
        raise ConfigError(
            f"{shown(file)}: is of the class set {found.class_set!r} with {list(found.names)}, the map's is"
            f" {label_set.name!r} with {list(label_set.names)}; calibrate with the same class set"
        )
    return found


def _counts(rows: Any) -> NDArray[np.int64]:
    """Whole numbers in nested lists; raises ValueError, or TypeError, for anything else."""
    counts = np.array(rows)
    if counts.dtype.kind != "i" or np.abs(counts).max(initial=0) > LARGEST_COUNT:
        raise ValueError(f"found counts of {counts.dtype}, expected whole numbers up to {LARGEST_COUNT:.0e}")
    return counts.astype(np.int64)


def check_replaceable(file: Path) -> None:
    """Raise DataError when the file exists and is not a label calibration: it would be overwritten."""
    try:
        if not os.path.lexists(file) or file.read_text("utf-8").startswith(f"format: {FORMAT}\nclass_set: "):
            return
        reason = "is no label calibration"
    except UnicodeDecodeError:
        reason = "is no label calibration"
    except OSError as error:
        reason = f"cannot be read ({error.strerror})"
    raise refused(file, f"is there already, and {reason}; choose another -o")


def opened(file: Path | None, label_set: LabelSet) -> LabelCalibration | None:
    """The calibration that the settings name, if they name one; see `read`."""
    return None if file is None else read(file, label_set)
