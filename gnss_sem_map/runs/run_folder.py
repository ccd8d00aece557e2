"""Writing of the run folder: all results of one drive."""

from __future__ import annotations

import json
import re
import shutil
from collections import Counter
from collections.abc import Iterable
from contextlib import AbstractContextManager
from dataclasses import asdict, astuple
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from factor_graphs.geodesy import LocalFrame
from factor_graphs.smoothing import Solution
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.config import Settings
from gnss_sem_map.dynamics.motion_state import LEAST_TRACKED_POINTS
from gnss_sem_map.evaluation.preflight.findings import Preflight
from gnss_sem_map.export.formats import Exported, write_exports
from gnss_sem_map.export.report import FILES, write_report
from gnss_sem_map.export.trajectories import write_geojson, write_kitti, write_tum
from gnss_sem_map.export.trajectory_plot import write_trajectory_plot
from gnss_sem_map.files.output_folder import Claim, claimed, new_folder
from gnss_sem_map.files.run_json import read_run
from gnss_sem_map.files.structured import read_json
from gnss_sem_map.mapping import evidence
from gnss_sem_map.mapping.point_labels import label_points
from gnss_sem_map.mapping.trajectory import DriveTrajectory
from gnss_sem_map.pipeline import Result
from gnss_sem_map.refinement.steps import RefinementReport
from gnss_sem_map.run_stats import RunStats
from gnss_sem_map.sensor_log import SensorLog
from gnss_sem_map.voxels import tiles

RAW_LABELS = "labels_raw"
PACKAGES = ("gnss-sem-map", "numpy", "gtsam", "numba", "opencv-python-headless", "pyproj")


RUN_FILES = re.compile(
    "|".join(map(re.escape, (*(name for name in FILES if "." in name), "report.html")))
    + r"|(map|refined)/(map\.json|-?\d+_-?\d+\.parquet)?"
    r"|(labels|labels_raw|removed)/(\d+\.label)?|confidence/(\d+\.bin)?"
)
"""Pattern of all paths in run folders of older versions, which have no list of their files."""


def is_run_file(name: str) -> bool:
    """Whether a run writes a file, or a folder (ending in '/'), of this path."""
    return RUN_FILES.fullmatch(name) is not None


def claimed_run(out: Path, inputs: Iterable[Path | str | None] = ()) -> AbstractContextManager[Claim]:
    """Hold the output folder of a run exclusively; see `files.output_folder.claimed`."""
    return claimed(out, inputs, is_run_file)


def places_read(
    drive: Path, settings: Settings, segmenter: str | None = None, config: Path | None = None
) -> list[Path | str | None]:
    """All inputs of a run that are known before the drive is opened."""
    place = (segmenter or "").partition(":")[2].partition("?")[0]
    classes = settings.classes if Path(settings.classes).suffix else None
    return [drive, config, place or None, settings.calibration, classes]


def write_run(
    out: Path,
    drive: Path,
    log: SensorLog,
    result: Result,
    settings: Settings,
    write_labels: bool,
    segmenter: str | None = None,
    frames: str | None = None,
) -> dict[str, Any]:
    """Write everything that a run made; returns the content of run.json."""
    inputs = {"drive": str(drive.resolve()), "segmenter": absolute(segmenter), "frames": frames}
    with claimed_run(out, [drive]), new_folder(out) as folder:
        with result.stats.stage("export"):
            _write_trajectory(folder, log, result.trajectory, result.solution)
            driven = _while_mapping(result.trajectory, log)
            write_raw(folder, result, log.frame)
            write_refined(folder, result, log.frame, driven, log.name)
            if write_labels:
                write_point_labels(folder, log, result, settings)
        about = about_run(drive, log, result.stats) | {
            "inputs": inputs,
            "scans_s": [log.scans[0].stamp, log.scans[-1].stamp],
            "preflight": result.preflight.as_dict(),
            "trajectory": _about_solution(result.solution),
            "from_lidar_odometry": result.from_lidar_odometry,
            "map": about_map(result),
        }
        metrics = {"sharpness": {name: figures.as_dict() for name, figures in result.sharpness.items()}}
        write_about(folder, settings, about, metrics)
    return about


def write_again(
    out: Path,
    source: Path,
    result: Result,
    settings: Settings,
    log: SensorLog | None,
    changed: dict[str, Any],
    tracked: dict[str, Any] | None = None,
    same_map: bool = False,
) -> dict[str, Any]:
    """Write a finished run once more, with another map of the same drive; returns the content of run.json.

    What stays is copied from `source`, which may be `out`; scores of the map before do not. Point labels are written
    where there is a `log`. `changed` is what run.json says anew, `tracked` what it said of moving objects, where they
    were not sought again. `same_map`: only the refinement differs.
    """
    about, metrics = read_run(source), read_json(source / "metrics.json")
    first, last = about["scans_s"]
    with claimed_run(out, [source] if source.resolve() != out.resolve() else []), new_folder(out) as folder:
        for file in source.glob("trajectory*"):
            shutil.copyfile(file, folder / file.name)
        frame = tiles.read_frame(source / "map")
        driven = between(result.trajectory, first, last)
        with result.stats.stage("export"):
            if same_map:
                for part in ("map", evidence.FOLDER):
                    shutil.copytree(source / part, folder / part)
            else:
                write_raw(folder, result, frame)
            write_refined(folder, result, frame, driven, str(about["name"]))
            if log is not None:
                write_point_labels(folder, log, result, settings, source / RAW_LABELS if same_map else None)
        about |= changed | {
            "seconds": about["seconds"] | _seconds(result.stats),
            "counts": about["counts"] | dict(sorted(result.stats.counts.items())),
            "warnings": list(dict.fromkeys([*about["warnings"], *result.stats.warnings])),
            "map": about_map(result),
        }
        if tracked is not None:
            about["map"]["refinement"] |= {name: tracked[name] for name in ("tracked", "untracked_segments")}
        write_about(folder, settings, about, {"sharpness": metrics.get("sharpness", {})})
    return about


def write_raw(folder: Path, result: Result, frame: LocalFrame | None) -> None:
    """Write the map before refinement, and its evidence."""
    tiles.write(result.raw, folder / "map", frame)
    evidence.write(result.evidence, folder, frame)


def write_refined(
    folder: Path, result: Result, frame: LocalFrame | None, driven: Trajectory, title: str
) -> None:
    """Write the refined map, as tiles and in all formats."""
    tiles.write(result.refined, folder / "refined", frame)
    write_exports(Exported(result.refined, frame, driven, title), folder)


def write_about(folder: Path, settings: Settings, about: dict[str, Any], metrics: dict[str, Any]) -> None:
    """Write settings, run.json, metrics.json and the report."""
    (folder / "config.yaml").write_text(settings.to_yaml(), "utf-8")
    _write_json(folder / "run.json", about)
    _write_json(folder / "metrics.json", metrics)
    write_report(folder, about, metrics)


def _while_mapping(trajectory: Trajectory, log: SensorLog) -> Trajectory:
    """The part of the trajectory with scans, for pictures of the map."""
    return between(trajectory, log.scans[0].stamp, log.scans[-1].stamp)


def between(trajectory: Trajectory, first: float, last: float) -> Trajectory:
    inside = (trajectory.stamps >= first - 0.1) & (trajectory.stamps <= last + 0.1)
    return Trajectory(trajectory.stamps[inside], trajectory.T_map_imu[inside]) if inside.any() else trajectory


def write_trajectory_run(
    out: Path,
    drive: Path,
    log: SensorLog,
    found: DriveTrajectory,
    stats: RunStats,
    settings: Settings,
    page: Preflight,
) -> dict[str, Any]:
    """Write a run that stopped after its trajectory; returns the content of run.json."""
    with claimed_run(out, [drive]), new_folder(out) as folder:
        _write_trajectory(folder, log, found.trajectory, found.solution)
        (folder / "config.yaml").write_text(settings.to_yaml(), "utf-8")
        about = about_run(drive, log, stats) | {
            "preflight": page.as_dict(),
            "trajectory": _about_solution(found.solution),
        }
        _write_json(folder / "run.json", about)
    return about


def _write_trajectory(
    folder: Path, log: SensorLog, trajectory: Trajectory, solution: Solution | None
) -> None:
    trajectory.save(folder / "trajectory.parquet")
    write_tum(trajectory, folder / "trajectory.tum")
    write_kitti(trajectory, folder / "trajectory_kitti.txt")
    if log.frame is not None:
        write_geojson(trajectory, log.frame, folder / "trajectory.geojson")
    if solution is not None and log.gnss is not None:
        write_trajectory_plot(solution, log.gnss, folder / "trajectory.png")


def _about_solution(solution: Solution | None) -> dict[str, Any] | None:
    if solution is None:
        return None
    return {
        "chi2_per_dof": solution.chi2_per_dof,
        "imu_noise_inflation": solution.inflation,
        "iterations": solution.iterations,
        "fixes": len(solution.rejected),
        "fixes_rejected": int(solution.rejected.sum()),
        "relative_poses": len(solution.relative_rejected),
        "relative_poses_rejected": int(solution.relative_rejected.sum()),
        "time_offset_s": solution.calibration.time_offset_s,
        "p_imu_antenna_m": np.asarray(solution.calibration.p_imu_antenna).tolist(),
    }


def write_point_labels(
    folder: Path, log: SensorLog, result: Result, settings: Settings, known_raw: Path | None = None
) -> None:
    """Write for every original point: class before and after refinement, confidence, and whether it was removed.

    `.label` files hold uint32, SemanticKITTI raw ids or, in removed/, 1 for moving vehicles; confidence/ holds float16.
    `known_raw`: a folder with the labels before refinement, which are copied.
    """
    for name in ("labels", "confidence", "removed"):
        (folder / name).mkdir()
    if known_raw is None:
        (folder / RAW_LABELS).mkdir()
    else:
        shutil.copytree(known_raw, folder / RAW_LABELS)
    known_ids = result.raw.voxels.label_set.semantic_kitti_ids
    ids = np.append(known_ids, 0).astype("<u4")  # the label -1 finds the last
    maps = [result.raw] * (known_raw is None) + [result.refined]
    for scan, (*raw, refined) in label_points(
        log, result.trajectory, maps, settings, result.evidence.moving, result.kerbs
    ):
        if raw:
            ids[raw[0].labels].tofile(folder / RAW_LABELS / f"{scan.name}.label")
        ids[refined.labels].tofile(folder / "labels" / f"{scan.name}.label")
        refined.confidence.astype("<f2").tofile(folder / "confidence" / f"{scan.name}.bin")
        refined.removed.astype("<u4").tofile(folder / "removed" / f"{scan.name}.label")


def about_run(drive: Path, log: SensorLog, stats: RunStats) -> dict[str, Any]:
    """Inputs, skips with their reasons, times and memory, for run.json."""
    skips = sorted(set(stats.skips), key=astuple)
    frames: Counter[str] = Counter()
    for skip in skips:
        frames[skip.what] += skip.frames
    return {
        "versions": {name: _version(name) for name in PACKAGES},
        "drive": drive.name,
        "name": log.name,
        "epoch_ns": log.epoch_ns,
        "local_frame": None if log.frame is None else asdict(log.frame),
        "counts": dict(sorted(stats.counts.items())),
        "warnings": stats.warnings,
        "skips": {
            "count": len(skips),
            "frames": dict(sorted(frames.items())),
            "listed": [asdict(skip) for skip in skips],
        },
        "seconds": _seconds(stats),
        "peak_memory_mb": {name: round(value) for name, value in stats.peak_memory_mb.items()},
    }


def _seconds(stats: RunStats) -> dict[str, float]:
    return {name: round(value, 3) for name, value in stats.seconds.items()}


def about_map(result: Result) -> dict[str, Any]:
    names = result.raw.voxels.label_set.names
    return {
        "voxels": len(result.raw),
        "points": int(result.raw.voxels.hits.sum()),
        "points_removed": int(result.refined.removed_hits.sum()),
        "labelled": {
            stage: {name: int(np.count_nonzero(m.labels[m.shown] == i)) for i, name in enumerate(names)}
            for stage, m in (("raw", result.raw), ("refined", result.refined))
        },
        "refinement": _about_refinement(result.refinement),
    }


def _about_refinement(report: RefinementReport) -> dict[str, Any]:
    """Steps and objects, for run.json; objects of a few points are only counted."""
    followed = [thing for thing in report.tracked if thing.points >= LEAST_TRACKED_POINTS]
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
                "path": thing.path.round(2).tolist(),
            }
            for thing in followed
        ],
        "untracked_segments": len(report.tracked) - len(followed),
    }


def absolute(segmenter: str | None) -> str | None:
    """The segmenter's SPEC with an absolute path."""
    kind, colon, rest = (segmenter or "").partition(":")
    place, mark, options = rest.partition("?")
    if not place or not Path(place).exists():
        return segmenter
    return f"{kind}{colon}{Path(place).resolve()}{mark}{options}"


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _write_json(path: Path, content: dict[str, Any]) -> None:
    path.write_text(json.dumps(content, indent=1) + "\n", "utf-8")
