"""Metrics of a map by points: accuracy and IoU (eq. 14, 15), coverage, calibration, removal of moving objects.

Points are counted first and divided last, so that counts of scans, drives and machines add up exactly.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.errors import DataError
from gnss_sem_map.labels.label_set import OTHER, LabelSet, taxonomy
from gnss_sem_map.labels.roles import Role

MOVING_IDS = range(252, 260)
"""SemanticKITTI raw ids of moving objects; the vehicles among them map to the class `vehicle`."""
CALIBRATION_BINS = 15
LOOKS = (1, 2, 5, 20, 100)
"""Lower ends of the groups of voxels by LiDAR points."""
RAW_IDS = 1 << 16


@dataclass(frozen=True, eq=False)
class Tables:
    """Tables from raw SemanticKITTI ids to classes."""

    truth: NDArray[np.int16]
    """(65536,) class index; c: `other`; -1: not known, a point with this truth is not counted at all."""
    prediction: NDArray[np.int16]
    """(65536,) class index; c: `other`; c + 1: unlabelled; -1: not an id that a prediction may hold."""
    label_set: LabelSet

    @classmethod
    def of(cls, label_set: LabelSet) -> Tables:
        """The tables of a class set (strict mapping: fence, parking, terrain and the like are `other`)."""
        truth = np.maximum(taxonomy("semantic_kitti").lookup(label_set, "id", RAW_IDS), -1)
        prediction, answers = np.full(RAW_IDS, -1, np.int16), label_set.legend.semantic_kitti_ids
        prediction[answers] = np.arange(len(answers))
        prediction[0] = len(answers)
        return cls(truth, prediction, label_set)

    def has_class(self, prediction: NDArray[np.uint32]) -> NDArray[np.bool_]:
        """Which `.label` entries (n,) are one of the classes, neither `other` nor unlabelled."""
        predicted = self.prediction[prediction & 0xFFFF]
        return np.asarray((predicted >= 0) & (predicted < len(self.label_set.names)))


def confusion(
    prediction: NDArray[np.uint32], truth: NDArray[np.uint32], tables: Tables, where: str
) -> NDArray[np.int64]:
    """Counts (c + 1, c + 2) of one scan: rows true class, then `other`; columns predicted, then `other`, unlabelled.

    Both are `.label` entries (low 16 bits: raw id). Raises DataError for different lengths or an unknown prediction.
    """
    if prediction.shape != truth.shape:
        raise DataError(
            f"{where}: found {len(prediction)} labels for {len(truth)} points; are they of the same scan?"
        )
    predicted = tables.prediction[prediction & 0xFFFF]
    if (predicted < 0).any():
        bad = np.unique(prediction[predicted < 0] & 0xFFFF)[:5].tolist()
        raise DataError(
            f"{where}: found ids {bad},"
            f" expected 0 or one of {tables.label_set.legend.semantic_kitti_ids.tolist()}"
        )
    true = tables.truth[truth & 0xFFFF]
    columns = len(tables.label_set.names) + 2
    cells = true[true >= 0].astype(np.int64) * columns + predicted[true >= 0]
    return np.bincount(cells, minlength=(columns - 1) * columns).reshape(columns - 1, columns)


def semantics(counts: NDArray[np.int64], label_set: LabelSet) -> dict[str, Any]:
    """Accuracy TP / (TP + FP) and IoU TP / (TP + FP + FN) per class and on average, and coverage, all in 0..1.

    The figures are over labelled points, with the coverage beside them: the labelled share of the points whose true
    class the set has; `other` is no label here. Under `strict` an unlabelled point counts as a false negative of its
    class. A class without truth is left out of the mean; one that is never predicted counts as 0. Accuracy (elsewhere
    called precision) uses labelled points only, so its strict mean differs in one case: a class without any labelled
    point is left out of the mean, but counts as 0 in the strict one.

    Four figures count true `other` as well. `open`: mean IoU as under `strict`, where a point of true `other` that is
    called a class is a false positive. `wrong`: of the points called a class, the share with another truth. `answered`:
    the share of all points that are called a class or `other`. `other`: accuracy and IoU of `other`.
    """
    c, true_points, hits = len(label_set.names), counts.sum(axis=1), np.diag(counts)
    labelled = counts[:c, :c]
    called, called_anywhere = labelled.sum(axis=0), counts[:, :-1].sum(axis=0)
    observed = _figures(hits[:c], called, labelled.sum(axis=1), label_set.names)
    strict = _figures(hits[:c], called, true_points[:c], label_set.names)
    of_all = _figures(hits[:c], called_anywhere[:c], true_points[:c], label_set.names)
    of_other = _figures(hits[c:], called_anywhere[c:], true_points[c:], [OTHER])
    with_class = int(called_anywhere[:c].sum())
    return observed | {
        "coverage": _share(int(labelled.sum()), int(true_points[:c].sum())),
        "points": int(true_points[:c].sum()),
        "strict": {name: strict[name] for name in ("mean_accuracy", "mean_iou")},
        "open": of_all["mean_iou"],
        "wrong": _share(with_class - int(hits[:c].sum()), with_class),
        "answered": _share(int(called_anywhere.sum()), int(counts.sum())),
        "other": of_other["classes"][OTHER],
    }


def _figures(
    hits: NDArray[np.int64],
    predicted: NDArray[np.int64],
    true_points: NDArray[np.int64],
    names: Sequence[str],
) -> dict[str, Any]:
    accuracy = np.where(predicted > 0, hits / np.maximum(predicted, 1), 0.0)
    iou = hits / np.maximum(predicted + true_points - hits, 1)
    present = true_points > 0
    return {
        "mean_accuracy": float(accuracy[present].mean()) if present.any() else None,
        "mean_iou": float(iou[present].mean()) if present.any() else None,
        "classes": {
            name: {"accuracy": float(accuracy[i]), "iou": float(iou[i])} if present[i] else None
            for i, name in enumerate(names)
        },
    }


def dynamic_counts(
    removed: NDArray[np.uint32], truth: NDArray[np.uint32], tables: Tables, where: str
) -> NDArray[np.int64]:
    """Counts (3, 2) of one scan: rows moving vehicle, static vehicle, other static; columns kept, removed.

    Points without truth, and moving objects that are no vehicles, are not counted.
    """
    if removed.shape != truth.shape:
        raise DataError(
            f"{where}: found {len(removed)} flags for {len(truth)} points; are they of the same scan?"
        )
    ids = truth & 0xFFFF
    moving = np.isin(ids, list(MOVING_IDS))
    vehicle = np.isin(tables.truth[ids], tables.label_set.having(Role.VEHICLE))
    row = np.where(moving, 0, np.where(vehicle, 1, 2))
    counted = np.where(moving, vehicle, ids > 1)  # 0 unlabelled, 1 outlier
    cells = 2 * row[counted] + (removed[counted] != 0)
    return np.bincount(cells, minlength=6).reshape(3, 2)


def dynamic(counts: NDArray[np.int64]) -> dict[str, float | None]:
    """Static kept (SA), moving vehicles removed (DA), AA = sqrt(SA DA), and the share of static vehicles kept."""
    moving, static_vehicle, static = counts[0], counts[1], counts[1] + counts[2]
    static_accuracy = _share(int(static[0]), int(static.sum()))
    dynamic_accuracy = _share(int(moving[1]), int(moving.sum()))
    both = None if static_accuracy is None or dynamic_accuracy is None else static_accuracy * dynamic_accuracy
    return {
        "SA": static_accuracy,
        "DA": dynamic_accuracy,
        "AA": None if both is None else both**0.5,
        "SA_vehicle": _share(int(static_vehicle[0]), int(static_vehicle.sum())),
        "moving_points": int(moving.sum()),
    }


def calibration_counts(
    confidence: NDArray[np.floating],
    prediction: NDArray[np.uint32],
    truth: NDArray[np.uint32],
    tables: Tables,
    looks: NDArray[np.uint8],
    seen: NDArray[np.bool_],
) -> NDArray[np.float64]:
    """Counts (2, 2, groups, bins, 3) of one scan, of the points called a class: points, points that are right, sum of
    confidences. Axes: not `seen` (n,) by a camera or seen; true class of the set or true `other`; group of `LOOKS` that
    `looks` (n,) at the voxel falls into; confidence.
    """
    true, predicted = tables.truth[truth & 0xFFFF], tables.prediction[prediction & 0xFFFF]
    use = (true >= 0) & tables.has_class(prediction)
    true, sure = true[use], confidence[use].astype(np.float64)
    cells = (
        seen[use].astype(np.int64),
        (true == len(tables.label_set.names)).astype(np.int64),
        np.maximum(np.searchsorted(LOOKS, looks[use], side="right") - 1, 0),
        np.minimum((sure * CALIBRATION_BINS).astype(np.int64), CALIBRATION_BINS - 1),
    )
    shape = (2, 2, len(LOOKS), CALIBRATION_BINS)
    cell, right = np.ravel_multi_index(cells, shape), (true == predicted[use]).astype(np.float64)
    columns = [np.bincount(cell, weights, math.prod(shape)) for weights in (np.ones_like(sure), right, sure)]
    return np.asarray(np.stack(columns, axis=1).reshape(*shape, 3), np.float64)


def calibration(counts: NDArray[np.float64]) -> dict[str, Any]:
    """Expected calibration error: mean of |share right - mean confidence| over bins, weighted by points.

    `ece` is over the points whose true class the set has; in `ece_open`, a point of true `other` that is called a class
    counts as not right. `ece_unseen` and `ece_open_unseen` are of the points that no camera saw. `bins`: the curve of
    reliability, of every bin with points their number, mean confidence and share that is right. `by_looks`: the same
    for the points in voxels of so many LiDAR points and more, up to the next group.
    """
    by_looks = counts[:, 0].sum(axis=0)
    groups = {
        str(low): _reliability(group) for low, group in zip(LOOKS, by_looks, strict=True) if group.any()
    }
    return _reliability(by_looks.sum(axis=0)) | {
        "ece_open": _reliability(counts.sum(axis=(0, 1, 2)))["ece"],
        "ece_unseen": _reliability(counts[0, 0].sum(axis=0))["ece"],
        "ece_open_unseen": _reliability(counts[0].sum(axis=(0, 1)))["ece"],
        "by_looks": groups,
    }


def _reliability(counts: NDArray[np.float64]) -> dict[str, Any]:
    points, right, sure = counts.T
    total = float(points.sum())
    bins = [
        {"points": int(n), "confidence": float(s / n), "right": float(r / n)} for n, r, s in counts if n > 0
    ]
    return {"ece": float(np.abs(right - sure).sum() / total) if total else None, "bins": bins}


def _share(part: int, whole: int) -> float | None:
    return part / whole if whole else None
