"""Scores of a run folder against truth: point labels, removed points, trajectory."""

from __future__ import annotations

import json
from functools import reduce
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from factor_graphs.accuracy import SHARES, coverage, errors, pose_nees, relative_error
from factor_graphs.geodesy import LocalFrame
from factor_graphs.trajectory import Trajectory
from gnss_sem_map import config
from gnss_sem_map.datasets.given_trajectory import read_tum
from gnss_sem_map.datasets.label_files import (
    label_files,
    read_confidence,
    read_labels,
    read_looks,
    truth_folder,
)
from gnss_sem_map.errors import DataError
from gnss_sem_map.evaluation import metrics
from gnss_sem_map.files.ownership import amend
from gnss_sem_map.files.run_json import read_run
from gnss_sem_map.files.structured import read_json
from gnss_sem_map.files.untrusted import is_file, is_folder, shown
from gnss_sem_map.files.work_folder import DRIVES
from gnss_sem_map.labels.label_set import LabelSet, open_label_set
from gnss_sem_map.process.machine import threads
from gnss_sem_map.process.prefetch import prefetch

FARTHEST_M = 1e4
"""What is so far from its truth on average is another drive, or has another origin."""

AXES = ("lat_deg", "lon_deg", "alt_m")

ONE_SECOND = 10
"""Stamps between the poses that the relative error compares, when the truth is at the LiDAR's 10 Hz."""


def score_run(
    out: Path | str,
    truth: Path | str,
    label_set: LabelSet | None = None,
    restrict_to: Path | None = None,
) -> dict[str, Any]:
    """Scores of a run folder, in the layout of `metrics.json`; also written to it.

    `truth`: a folder of `.label` files, or one with `labels/` and, where there is one, `trajectory_lidar.tum`: poses of
    the imu at the scans' stamps, in the map frame, or in that of `world.json` beside it (`lat_deg`, `lon_deg`, `alt_m`;
    `--origin` and maps of several drives have another). `label_set` is that of the run's settings unless given.
    `restrict_to`: only points labelled there. Raises DataError.
    """
    out, truth = Path(out), Path(truth)
    _check_scorable(out)
    label_set = label_set or open_label_set(config.of_run(out / "config.yaml").classes)
    metrics = read_json(out / "metrics.json")
    metrics |= count_points(out, truth, label_set, restrict_to).figures(label_set)
    path = truth / "trajectory_lidar.tum"
    if is_file(path):
        reference = _in_frame_of(out, read_tum(path), truth / "world.json")
        metrics["trajectory"] = score_trajectory(Trajectory.load(out / "trajectory.parquet"), reference)
        _refuse_elsewhere(path, metrics["trajectory"]["ate_m"])
    amend(out, "metrics.json", (json.dumps(metrics, indent=1) + "\n").encode())
    return metrics


def _check_scorable(out: Path) -> None:
    """Raise DataError for a folder without labels of single points, which are needed for scoring."""
    read_run(out)
    if is_folder(out / DRIVES):
        names = " and ".join(sorted(path.name for path in (out / DRIVES).iterdir()))
        raise DataError(
            f"{shown(out)}: a map of several drives has no labels of single points; evaluate"
            f" {shown(out / DRIVES)}/NAME, made with --write-labels; NAME is one of {names}"
        )
    if not is_folder(out / "map"):
        raise DataError(
            f"{shown(out)}: found a trajectory without a map; make the map with `gnss-sem-map run ... --write-labels`"
        )
    if not is_folder(out / "labels"):
        raise DataError(
            f"{shown(out / 'labels')}: no point labels in this run; make it again with --write-labels"
        )
    if not is_folder(out / "looks"):
        raise DataError(
            f"{shown(out / 'looks')}: not in this run of an earlier version; make it again with --write-labels"
        )


def count_points(out: Path, truth: Path, label_set: LabelSet, restrict_to: Path | None = None) -> Counts:
    """What is counted of the points of a run folder; counts of several runs add up. Raises DataError."""
    tables = metrics.Tables.of(label_set)

    def count(scan: tuple[str, Path]) -> Counts:
        name, known = scan
        return _count_scan(out, name, _true_ids(known, name, restrict_to), tables)

    counted = prefetch(count, _scans(out / "labels", truth_folder(truth)), threads())
    return reduce(Counts.plus, (counts for _, counts in counted))


class Counts(NamedTuple):
    """Of one scan, or of several; see `metrics`."""

    raw: NDArray[np.int64]
    refined: NDArray[np.int64]
    seen: NDArray[np.int64]
    """The part of `refined` in voxels that the images labelled."""
    moved: NDArray[np.int64]
    sure: NDArray[np.float64]

    def plus(self, other: Counts) -> Counts:
        """The sum."""
        return Counts(
            self.raw + other.raw,
            self.refined + other.refined,
            self.seen + other.seen,
            self.moved + other.moved,
            self.sure + other.sure,
        )

    def figures(self, label_set: LabelSet) -> dict[str, Any]:
        """As in `metrics.json`, without the trajectory."""
        refined, seen, unseen = (
            metrics.semantics(counts, label_set)
            for counts in (self.refined, self.seen, self.refined - self.seen)
        )
        return {
            "semantics": {
                "raw": metrics.semantics(self.raw, label_set),
                "refined": refined | {"seen": seen, "unseen": unseen},
            },
            "dynamic": metrics.dynamic(self.moved),
            "calibration": metrics.calibration(self.sure),
        }


def _count_scan(out: Path, name: str, true: NDArray[np.uint32], tables: metrics.Tables) -> Counts:
    where = f"{out / 'labels' / name}.label"
    predicted = read_labels(out / "labels" / f"{name}.label")
    before = read_labels(out / "labels_raw" / f"{name}.label")
    moved = metrics.dynamic_counts(read_labels(out / "removed" / f"{name}.label"), true, tables, where)
    refined = metrics.confusion(predicted, true, tables, where)
    raw = metrics.confusion(before, true, tables, where)
    confidence = read_confidence(out / "confidence" / f"{name}.bin")
    if len(confidence) != len(predicted):
        raise DataError(f"{where}: found {len(confidence)} probabilities for {len(predicted)} labels")
    looks = read_looks(out / "looks" / f"{name}.bin")
    if len(looks) != len(predicted):
        raise DataError(f"{where}: found {len(looks)} counts of looks for {len(predicted)} labels")
    is_seen = tables.has_class(before)
    seen = metrics.confusion(predicted[is_seen], true[is_seen], tables, where)
    sure = metrics.calibration_counts(confidence, predicted, true, tables, looks, is_seen)
    return Counts(raw, refined, seen, moved, sure)


def _true_ids(known: Path, name: str, restrict_to: Path | None) -> NDArray[np.uint32]:
    """The true ids of a scan, 0 for points that are not labelled in `restrict_to`."""
    true = read_labels(known)
    if restrict_to is None:
        return true
    chosen = read_labels(restrict_to / f"{name}.label")
    if len(chosen) != len(true):
        raise DataError(
            f"{shown(restrict_to / name)}.label: found {len(chosen)} labels for {len(true)} points"
        )
    return np.where(chosen & 0xFFFF != 0, true, 0).astype(np.uint32)


def _scans(predictions: Path, truth: Path) -> list[tuple[str, Path]]:
    """Every scan with labels, and the file of its true ids; each must have one, and there must be at least one."""
    wanted, known = label_files(predictions), label_files(truth)
    missing = sorted(set(wanted) - set(known))
    if missing:
        raise DataError(
            f"{truth}: no truth for {len(missing)} of {len(wanted)} scans, first {missing[0]}; is it another drive?"
        )
    return [(name, known[name]) for name in wanted]


def _in_frame_of(out: Path, poses: Trajectory, world: Path) -> Trajectory:
    """True poses in the map frame of a run; without `world`, or a georeference of the run, they are in it."""
    own = read_run(out).get("local_frame")
    if own is None or not is_file(world):
        return poses
    about = read_json(world)
    try:
        frames = [LocalFrame(*(float(each[axis]) for axis in AXES)) for each in (own, about)]
    except (KeyError, TypeError, ValueError):
        raise DataError(
            f"{shown(world)}: expected the origin of the true poses, as {', '.join(AXES)}"
        ) from None
    return poses.moved(frames[0].pose_of(frames[1]))


def _refuse_elsewhere(truth: Path, error_m: float) -> None:
    if error_m > FARTHEST_M:
        raise DataError(
            f"{shown(truth)}: found poses {error_m / 1000:.0f} km from those of the run; expected the same drive,"
            f" in the frame of its map or with the origin in {shown(truth.parent)}/world.json"
        )


def score_trajectory(estimate: Trajectory, truth: Trajectory) -> dict[str, float]:
    """Absolute trajectory error without alignment and after the best rigid alignment; relative error over a second.

    With one pose in common, as of a drive of one scan, there is no relative error.
    Where the estimate has covariances, also its mean NEES (normalised estimation error squared) per degree of freedom,
    and the `coverage` of the position and of its horizontal part.
    """
    error = errors(estimate, truth)
    stamps = error.stamps
    scores = {
        "ate_m": error.ate_m,
        "horizontal_rms_m": error.horizontal_rms_m,
        "vertical_rms_m": error.vertical_rms_m,
        "heading_rms_deg": error.heading_rms_deg,
        "tilt_rms_deg": error.tilt_rms_deg,
        "ate_aligned_m": _aligned_rms(estimate.at(stamps)[:, :3, 3], truth.at(stamps)[:, :3, 3]),
    }
    if len(stamps) > 1:
        relative = relative_error(estimate, truth, min(ONE_SECOND, len(stamps) - 1))
        scores["rpe_translation_m"] = relative.translation_m
        scores["rpe_translation_share"] = relative.translation_share
        scores["rpe_rotation_deg"] = relative.rotation_deg
    if estimate.covariances is None:
        return scores
    found = pose_nees(estimate, truth)
    scores["position_nees_per_dof"] = float(found.position.mean()) / 3
    scores["orientation_nees_per_dof"] = float(found.orientation.mean()) / 3
    for name, squares, dof in (("position", found.position, 3), ("horizontal", found.horizontal, 2)):
        honest = coverage(squares, dof)
        for share, inside in zip(SHARES, honest.inside, strict=True):
            scores[f"{name}_inside_{100 * share:.0f}"] = inside
        scores[f"{name}_scale_gap"] = honest.scale_gap
    return scores


def _aligned_rms(points: NDArray[np.float64], reference: NDArray[np.float64]) -> float:
    """Root mean square distance after the best rotation and translation (Kabsch)."""
    moved, fixed = points - points.mean(axis=0), reference - reference.mean(axis=0)
    u, _, vt = np.linalg.svd(fixed.T @ moved)
    proper = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rest = fixed - moved @ (u @ proper @ vt).T
    return float(np.sqrt((rest**2).sum(axis=1).mean()))
