"""The geometric classifier: two models, each trained on every second block of a checkerboard, and a temperature.

A voxel that images show is judged by the model that did not see its block, so that it can correct them; all others by
the mean of both. Class c is `other`: none of the map's classes.
"""

from __future__ import annotations

import io
from dataclasses import dataclass, fields
from pathlib import Path
from reprlib import repr as brief
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.errors import DataError, one_line
from gnss_sem_map.files.archives import Archive, open_archive
from gnss_sem_map.files.untrusted import shown
from gnss_sem_map.geometric_classifier import features
from gnss_sem_map.geometric_classifier.trees import BoostedTrees
from gnss_sem_map.labels.label_set import LabelSet
from gnss_sem_map.voxels.kernels import AXIS_BITS, AXIS_MASK
from gnss_sem_map.voxels.voxel_map import softmax

FORMAT = 1
FOLDS = 2
BLOCK_M = 8.0
"""Edge of the blocks of the checkerboard."""
LEAST_LOG = -9.0
"""ln of the least probability of an answer, about one in ten thousand."""
LEVELS = 256
"""Of intensity."""


def folds_of(keys: NDArray[np.int64], voxel_size_m: float) -> NDArray[np.int64]:
    """The colour (v,), 0 or 1, of the block of the checkerboard in which each voxel lies."""
    side = max(round(BLOCK_M / voxel_size_m), 1)
    return np.asarray(((keys >> 2 * AXIS_BITS) // side + (keys >> AXIS_BITS & AXIS_MASK) // side) & 1)


@dataclass(frozen=True, eq=False)
class Classifier:
    """A trained classifier; it depends on no place, so it serves other drives of the same rig as well."""

    names: tuple[str, ...]
    """The classes of the map; `other` follows them."""
    voxel_size_m: float
    folds: tuple[BoostedTrees, ...]
    """Model k was trained on blocks of colour k."""
    temperature: float
    uses_intensity: bool
    """Whether the drives that it was trained on had intensities."""

    def log_probabilities(
        self,
        rows: NDArray[np.float32],
        keys: NDArray[np.int64],
        observed: NDArray[np.bool_],
    ) -> NDArray[np.float32]:
        """ln P(class | shape, intensity) (v, c + 1) of voxels with these features (v, f).

        `observed` (v,): what images show, which the model of the other colour judges.
        """
        answers, folds = len(self.names) + 1, folds_of(keys, self.voxel_size_m)
        total, judges = np.zeros((len(keys), answers), np.float32), np.where(observed, 1, FOLDS)
        for fold, trees in enumerate(self.folds):
            judged = np.flatnonzero(~observed | (folds != fold))
            scores = log_scores_of(trees, rows[judged], answers)
            total[judged] += softmax(scores / np.float32(self.temperature))
        mean = total / judges[:, None].astype(np.float32)
        return np.asarray(np.log(np.maximum(mean, np.float32(np.exp(LEAST_LOG)))), np.float32)

    def to_bytes(self, **beside: NDArray[Any]) -> bytes:
        """The file that `read` reads back."""
        file = io.BytesIO()
        arrays: dict[str, NDArray[Any]] = {
            "format": np.array([FORMAT]),
            "classes": np.array(self.names),
            "features": np.array(features.NAMES),
            "numbers": np.array([self.voxel_size_m, self.temperature, float(self.uses_intensity)]),
        }
        for k, trees in enumerate(self.folds):
            arrays |= {f"{field.name}_{k}": getattr(trees, field.name) for field in fields(trees)}
        np.savez_compressed(file, allow_pickle=False, **arrays, **beside)
        return file.getvalue()


def log_scores_of(trees: BoostedTrees, rows: NDArray[np.float32], answers: int) -> NDArray[np.float32]:
    """Log scores (v, answers) of rows of features (v, f); -infinite for classes that the trees were not trained on."""
    scores = trees.scores(rows)
    if len(trees.classes) == 2:
        scores = np.column_stack([np.zeros_like(scores), scores])
    found = np.full((len(rows), answers), -np.inf, np.float32)
    found[:, trees.classes] = scores
    return found


def read(path: Path, label_set: LabelSet, voxel_size_m: float) -> Classifier:
    """Read a classifier; raises DataError for a damaged file, or one of other classes, features or voxels."""
    try:
        with open_archive(path) as archive:
            if "format" not in archive or archive.array("format").read().tolist() != [FORMAT]:
                raise DataError(f"it is no classifier of format {FORMAT}")
            found = _of(archive)
    except (DataError, ValueError) as error:
        raise DataError(
            f"{shown(path)}: cannot be used as geometric classifier ({one_line(error, 200)}); expected a file of"
            " `gnss-sem-map fit-classifier`"
        ) from None
    if found.names != label_set.names:
        raise DataError(
            f"{shown(path)}: is of the classes {brief(list(found.names))}, the map's are"
            f" {brief(list(label_set.names))}; fit a classifier on runs with the same class set"
        )
    if found.voxel_size_m != voxel_size_m:
        raise DataError(
            f"{shown(path)}: is of voxels of {found.voxel_size_m:g} m, the map's are {voxel_size_m:g} m; fit a"
            " classifier on runs with the same voxels"
        )
    return found


def is_classifier(path: Path) -> bool:
    """Whether a file is a classifier, of whatever classes and version."""
    try:
        with open_archive(path) as archive:
            return all(name in archive for name in ("format", "classes", "features", "numbers"))
    except DataError:
        return False


def _of(archive: Archive) -> Classifier:
    names = tuple(map(str, archive.array("classes").read().ravel()))
    if tuple(map(str, archive.array("features").read().ravel())) != features.NAMES:
        raise DataError("it is of other features, of another version")
    numbers = archive.array("numbers").read()
    if (
        numbers.shape != (3,)
        or numbers.dtype.kind != "f"
        or not (np.isfinite(numbers).all() and 1 <= 100 * numbers[1] <= 10_000)
    ):
        raise DataError("its voxel size is no number, or its temperature is not within 0.01 and 100")
    folds = tuple(
        BoostedTrees(*(archive.array(f"{field.name}_{k}").read() for field in fields(BoostedTrees)))
        for k in range(FOLDS)
    )
    for trees in folds:
        trees.check(len(features.NAMES), len(names) + 1)
    return Classifier(names, float(numbers[0]), folds, float(numbers[1]), bool(numbers[2]))
