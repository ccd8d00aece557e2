"""What is known of a run, for run.json and metrics.json."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import asdict, astuple
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from factor_graphs.smoothing import Solution
from gnss_sem_map.mapping.raw_map import MAP
from gnss_sem_map.mapping.refining import REFINED
from gnss_sem_map.process.run_stats import RunStats
from gnss_sem_map.refinement.steps import RefinementReport
from gnss_sem_map.sensor_log import SensorLog, Skip
from gnss_sem_map.voxels import tiles

PACKAGES = ("gnss-sem-map", "numpy", "gtsam", "numba", "opencv-python-headless", "pyproj")


def about_run(drive: str, log: SensorLog, stats: RunStats) -> dict[str, Any]:
    """The name of the drive, skips with their reasons, times and memory, for run.json."""
    return {
        "versions": {name: _version(name) for name in PACKAGES},
        "drive": drive,
        "name": log.name,
        "epoch_ns": log.epoch_ns,
        "local_frame": None if log.frame is None else asdict(log.frame),
        "counts": dict(sorted(stats.counts.items())),
        "warnings": stats.warnings,
        "skips": about_skips(stats.skips),
        "seconds": seconds_of(stats),
        "peak_memory_mb": {name: round(value) for name, value in stats.peak_memory_mb.items()},
    }


def about_skips(skips: Iterable[Skip]) -> dict[str, Any]:
    """What was left out, in order, each once, for run.json."""
    listed = sorted(set(skips), key=astuple)
    frames: Counter[str] = Counter()
    for skip in listed:
        frames[skip.what] += skip.frames
    return {
        "count": len(listed),
        "frames": dict(sorted(frames.items())),
        "listed": [asdict(skip) for skip in listed],
    }


def seconds_of(stats: RunStats) -> dict[str, float]:
    return {name: round(value, 3) for name, value in stats.seconds.items()}


def about_map(folder: Path, report: RefinementReport) -> dict[str, Any]:
    """What is in the maps of a run folder, for run.json."""
    places = {"raw": MAP, "refined": REFINED}
    maps = {name: tiles.open_map(folder / place, with_sums=False) for name, place in places.items()}
    names = maps["raw"].label_set.legend.names
    labelled = {name: np.zeros(len(names), np.int64) for name in maps}
    voxels = points = removed = 0
    for name, tiled in maps.items():
        for piece in tiled:
            labelled[name] += np.bincount(piece.labels[piece.shown], minlength=len(names))
            if name == "raw":
                voxels, points = voxels + len(piece), points + int(piece.voxels.hits.sum(dtype=np.int64))
            else:
                removed += int(piece.removed_hits.sum(dtype=np.int64))
    return {
        "voxels": voxels,
        "points": points,
        "points_removed": removed,
        "labelled": {
            name: dict(zip(names, counts.tolist(), strict=True)) for name, counts in labelled.items()
        },
        "refinement": _about_refinement(report),
    }


def about_solution(solution: Solution | None) -> dict[str, Any] | None:
    if solution is None:
        return None
    return {
        "chi2_per_dof": solution.chi2_per_dof,
        "imu_noise_inflation": solution.inflation,
        "fix_noise_inflation": solution.fix_inflation,
        "iterations": solution.iterations,
        "fixes": len(solution.rejected),
        "fixes_rejected": int((solution.rejected & ~solution.outside_imu).sum()),
        "fixes_outside_imu": int(solution.outside_imu.sum()),
        "relative_poses": len(solution.relative_rejected),
        "relative_poses_rejected": int(solution.relative_rejected.sum()),
        "time_offset_s": solution.calibration.time_offset_s,
        "vehicle_constraint": None if solution.vehicle is None else solution.vehicle.verdict,
        "wheel_speed": None if solution.wheels is None else solution.wheels.verdict,
        "p_imu_antenna_m": np.asarray(solution.calibration.p_imu_antenna).tolist(),
        **({"other_measurements": list(solution.beside)} if solution.beside else {}),
        **(
            {"surveyed_points": [_with_nulls(asdict(one)) for one in solution.points]}
            if solution.points
            else {}
        ),
    }


def _with_nulls(values: dict[str, Any]) -> dict[str, Any]:
    """The same for JSON, which has no NaN."""
    return {key: None if value != value else value for key, value in values.items()}


def _about_refinement(report: RefinementReport) -> dict[str, Any]:
    """Steps and objects, for run.json; objects of a few points are only counted."""
    return {
        "steps": [
            {
                "name": step.name,
                "voxels_changed": step.changed,
                "changes": {f"{before} to {after}": n for (before, after), n in sorted(step.changes.items())},
                "skipped": step.skipped,
            }
            for step in report.steps
        ],
        "systematic_errors": round(report.systematic_errors, 4),
        "objects": [asdict(thing) | {"centre": thing.centre.round(3).tolist()} for thing in report.objects],
        "tracked": [
            {
                "motion": thing.motion,
                "probability": round(thing.probability, 4),
                "reason": thing.reason,
                "points": thing.points,
                "first_stamp": thing.first_stamp,
                "last_stamp": thing.last_stamp,
                # a path of all scans would be half of the file; those of what moved are in objects.parquet
                "first_place": thing.path[0].round(2).tolist(),
                "last_place": thing.path[-1].round(2).tolist(),
            }
            for thing in report.tracked
        ],
        "untracked_segments": report.untracked,
    }


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None
