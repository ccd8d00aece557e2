"""Metrics of a map by points: accuracy and IoU (eq. 14, 15), coverage, calibration, removal of moving objects.

Points are counted first and divided last, so that counts of scans, drives and machines add up exactly.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.errors import DataError
from gnss_sem_map.labels.label_set import LabelSet, taxonomy

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
    """(65536,) class index; -1 where a point with this truth is not counted at all."""
    prediction: NDArray[np.int16]
    """(65536,) class index; c: unlabelled; -1: not an id that a prediction may hold."""
    label_set: LabelSet

    @classmethod
    def of(cls, label_set: LabelSet) -> Tables:
        """The tables of a class set (strict mapping: wall, fence, terrain and the like are not counted)."""
        count = len(label_set.names)
        truth = taxonomy("semantic_kitti").lookup(label_set, "id", RAW_IDS)
        truth[(truth < 0) | (truth == count)] = -1
        prediction = np.full(RAW_IDS, -1, np.int16)
        prediction[label_set.semantic_kitti_ids] = np.arange(count)
        prediction[0] = count
        return cls(truth, prediction, label_set)


def confusion(
    prediction: NDArray[np.uint32], truth: NDArray[np.uint32], tables: Tables, where: str
) -> NDArray[np.int64]:
    """Counts (c, c + 1) of one scan: rows true class, columns predicted class, last column unlabelled.

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
            f"{where}: found ids {bad}, expected 0 or one of {tables.label_set.semantic_kitti_ids.tolist()}"
        )
    true = tables.truth[truth & 0xFFFF]
    columns = len(tables.label_set.names) + 1
    cells = true[true >= 0].astype(np.int64) * columns + predicted[true >= 0]
    return np.bincount(cells, minlength=(columns - 1) * columns).reshape(columns - 1, columns)


def semantics(counts: NDArray[np.int64], label_set: LabelSet) -> dict[str, Any]:
    """Accuracy TP / (TP + FP) and IoU TP / (TP + FP + FN) per class and on average, and coverage, all in 0..1.

    The figures are over labelled points, with the coverage beside them: the labelled share of the points whose true
    class the set has. Under `strict` an unlabelled point counts as a false negative of its class. A class without truth
    is left out of the mean; one that is never predicted counts as 0. Accuracy (elsewhere called precision) uses
    labelled points only, so its strict mean differs in one case: a class without any labelled point is left out of the
    mean, but counts as 0 in the strict one.
    """
    labelled = counts[:, :-1]
    observed = _figures(labelled, labelled.sum(axis=1), label_set)
    strict = _figures(labelled, counts.sum(axis=1), label_set)
    return observed | {
        "coverage": _share(int(labelled.sum()), int(counts.sum())),
        "points": int(counts.sum()),
        "strict": {name: strict[name] for name in ("mean_accuracy", "mean_iou")},
    }


def _figures(
    labelled: NDArray[np.int64], true_points: NDArray[np.int64], label_set: LabelSet
) -> dict[str, Any]:
    hits = np.diag(labelled).astype(float)
    predicted = labelled.sum(axis=0)
    with np.errstate(invalid="ignore"):
        accuracy = np.where(predicted > 0, hits / np.maximum(predicted, 1), 0.0)
        iou = hits / np.maximum(predicted + true_points - hits, 1)
    present = true_points > 0
    return {
        "mean_accuracy": float(accuracy[present].mean()) if present.any() else None,
        "mean_iou": float(iou[present].mean()) if present.any() else None,
        "classes": {
            name: {"accuracy": float(accuracy[i]), "iou": float(iou[i])} if present[i] else None
            for i, name in enumerate(label_set.names)
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
    names = tables.label_set.names
    # a class set without vehicles: none is counted as one
    vehicle = tables.truth[ids] == (names.index("vehicle") if "vehicle" in names else len(names))
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
) -> NDArray[np.float64]:
    """Counts (groups, bins, 3) of one scan by the looks at their voxel and by confidence: points, points that are
    right, sum of confidences. `looks` (n,) falls into the groups of `LOOKS`.
    """
    true, predicted = tables.truth[truth & 0xFFFF], tables.prediction[prediction & 0xFFFF]
    use = (true >= 0) & (predicted >= 0) & (predicted < len(tables.label_set.names))
    sure = confidence[use].astype(np.float64)
    bins = np.minimum((sure * CALIBRATION_BINS).astype(np.int64), CALIBRATION_BINS - 1)
    right = (true == predicted)[use].astype(np.float64)
    group = np.maximum(np.searchsorted(LOOKS, looks[use], side="right") - 1, 0)
    shape = (len(LOOKS), CALIBRATION_BINS)
    cells = group * CALIBRATION_BINS + bins
    columns = [
        np.bincount(cells, weights, len(LOOKS) * CALIBRATION_BINS)
        for weights in (np.ones_like(sure), right, sure)
    ]
    return np.asarray(np.stack(columns, axis=1).reshape(*shape, 3), np.float64)


def calibration(counts: NDArray[np.float64]) -> dict[str, Any]:
    """Expected calibration error: mean of |share right - mean confidence| over bins, weighted by points.

    `bins`: the reliability curve, of every bin with points their number, mean confidence and share that is right.
    `by_looks`: the same for the points in voxels of so many LiDAR points and more, up to the next group.
    """
    groups = {str(low): _reliability(group) for low, group in zip(LOOKS, counts, strict=True) if group.any()}
    return _reliability(counts.sum(axis=0)) | {"by_looks": groups}


def _reliability(counts: NDArray[np.float64]) -> dict[str, Any]:
    points, right, sure = counts.T
    total = float(points.sum())
    bins = [
        {"points": int(n), "confidence": float(s / n), "right": float(r / n)} for n, r, s in counts if n > 0
    ]
    return {"ece": float(np.abs(right - sure).sum() / total) if total else None, "bins": bins}


def _share(part: int, whole: int) -> float | None:
    return part / whole if whole else None
