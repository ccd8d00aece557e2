"""Two days in one street: how well their surfaces fit, how honest the poses are, and whether changes are found.

    python benchmarks/sessions.py [--work FOLDER] [--seeds 101 102 ...] [--only unit consumer coverage real]

simulates two sessions for every seed, with the navigation unit's errors and with those of a consumer's receiver, maps
them into one map, compares with the exact truth, and writes benchmarks/results/sessions.json. FOLDER keeps the drives.
Six towns are few draws of the errors of a unit: `coverage` (benchmarks/sessions_coverage.py) makes many, without LiDAR.
The real excerpt is read from $GNSS_SEM_MAP_DATA (or ../shared/data) and left out where it is absent.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from real_data import DATA
from results_file import keep
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from sessions_changes import score_changes
from sessions_coverage import coverage

from factor_graphs.chi_square import quantile
from factor_graphs.geodesy import LocalFrame
from factor_graphs.measurements import GnssFixes
from factor_graphs.sessions import AnchorPairs, bind
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.config import Settings
from gnss_sem_map.datasets import open_drive
from gnss_sem_map.datasets.given_trajectory import read_tum
from gnss_sem_map.evaluation.map_sharpness import SharpnessSettings, of_clouds
from gnss_sem_map.files.run_json import read_run
from gnss_sem_map.mapping.passes import LocatedDrive, bind_passes
from gnss_sem_map.mapping.trajectory import in_frame, locate
from gnss_sem_map.process.run_stats import RunStats
from gnss_sem_map.runs.many_drives import HowMapped, run_drives
from gnss_sem_map.scans.deskew import points_in_map
from gnss_sem_map.scans.downsampling import thinned
from gnss_sem_map.scans.local_maps import LocalMaps, normals, sweeps_along
from gnss_sem_map.scans.revisits import RevisitSettings, pass_of, register_passes
from gnss_sem_map.sensor_log import SensorLog
from gnss_sem_map.simulation import simulate, write_corrupted_labels
from gnss_sem_map.simulation.oxts import Gnss
from gnss_sem_map.voxels.voxel_map import keys_of

Array = NDArray[np.float64]
Figures = dict[str, Any]

RESULTS = Path(__file__).parent / "results" / "sessions.json"
EXCERPT = "kitti_raw/2011_09_26/2011_09_26_drive_0005_sync"
SECONDS, SEEDS, PLANTED = 30.0, (101, 102, 103, 104, 105, 106), 17
CASES, DRAWS = ("unit", "consumer", "coverage", "real"), 40
SETTINGS, REVISITS = Settings(), RevisitSettings()
SHIFT_M = np.array([0.62, -0.62, 0.1])
"""Of the fixes of one half of the real excerpt: 0.88 m."""


@dataclass(frozen=True, eq=False)
class Day:
    """One session: what is known of it, where it was driven, and where we say so, alone and bound."""

    log: SensorLog
    true: Trajectory
    alone: LocatedDrive
    bound: Trajectory


def days_of(drives: Sequence[Path], out: Path) -> list[Day]:
    """The drives of a map, all in its frame."""
    frame = LocalFrame(**read_run(out)["local_frame"])
    days = []
    for drive in drives:
        log = open_drive(drive)
        found = locate(log, SETTINGS, RunStats(), bound=False)
        assert found.solution is not None
        assert found.solution.condensed is not None
        assert log.frame is not None
        _, alone = in_frame(log, found.trajectory, frame)
        assert found.sweeps is not None
        located = LocatedDrive(drive.name, found.sweeps, alone, found.solution.condensed.at(alone))
        bound = Trajectory.load(out / "drives" / drive.name / "trajectory.parquet")
        days.append(Day(log, truth_of(drive).moved(frame.pose_of(log.frame)), located, bound))
    return days


def truth_of(drive: Path) -> Trajectory:
    return read_tum(drive / "truth" / "trajectory.tum")


def surfaces_apart(days: Sequence[Day]) -> tuple[Array, Array]:
    """Distances between the surfaces of both days, across each, by the poses alone and bound: against the truth, m."""
    first, second = days
    places = np.arange(second.true.start + 1.0, second.true.end - 1.0, 1.0)
    maps = LocalMaps(sweeps_along(second.log, second.true), second.true, places)
    stamps = np.arange(first.true.start + 0.5, first.true.end - 0.5, 0.1)
    track, distances = first.true.at(stamps)[:, :3, 3], ([], [])
    for n, at in enumerate(places):
        way = np.linalg.norm(track - second.true.at([at])[0, :3, 3], axis=1)
        if way.min() > REVISITS.within_m:
            continue
        nearest, cloud = stamps[way.argmin()], maps.at(n)
        points, across = np.asarray(cloud.points())[:, :3], normals(cloud)
        pairs = ((first.true, second.true), (first.alone.trajectory, second.alone.trajectory))
        true, *found = (
            np.linalg.inv(a.at([nearest])[0]) @ b.at([at])[0]
            for a, b in (*pairs, (first.bound, second.bound))
        )
        for T, into in zip(found, distances, strict=True):
            off = np.linalg.inv(true) @ T
            into.append(np.abs(np.sum((points @ off[:3, :3].T + off[:3, 3] - points) * across, axis=1)))
    return np.concatenate(distances[0]), np.concatenate(distances[1])


def clouds(day: Day, trajectory: Trajectory) -> list[Array]:
    """Thinned sweeps in the map."""
    T, span = day.log.calibration.T_imu_lidar, (trajectory.start, trajectory.end)
    scans = [
        scan for scan in day.log.scans[::2] if span[0] <= scan.stamp - 0.1 and scan.stamp + 0.1 <= span[1]
    ]
    return [points_in_map(thinned(scan.read(), 0.1, 3.5, 50.0), scan.stamp, trajectory, T) for scan in scans]


def thickness(days: Sequence[Day]) -> float:
    """Of surfaces that both days saw, over that of each day alone."""
    settings = SharpnessSettings(every_nth_point=1)
    of_days = [clouds(day, day.bound) for day in days]
    # only what both saw: sweeps where the other one drove
    alone = [of_clouds(of_day, 1.0, settings).thickness_m for of_day in of_days]
    return of_clouds([*of_days[0], *of_days[1]], 1.0, settings).thickness_m / float(np.mean(alone))


def accuracy_and_completeness(days: Sequence[Day]) -> tuple[float, float]:
    """AC, m, and COM at 5 cm (as in MapEval): our points against those that exact poses give, one rigid offset off."""
    ours = np.concatenate([cloud for day in days for cloud in clouds(day, day.bound)])
    true = np.concatenate([cloud for day in days for cloud in clouds(day, day.true)])
    at = [np.arange(day.true.start + 0.5, day.true.end - 0.5, 0.5) for day in days]
    a = np.concatenate([day.bound.at(stamps)[:, :3, 3] for day, stamps in zip(days, at, strict=True)])
    b = np.concatenate([day.true.at(stamps)[:, :3, 3] for day, stamps in zip(days, at, strict=True)])
    turn, _ = Rotation.align_vectors(b - b.mean(axis=0), a - a.mean(axis=0))
    ours = turn.apply(ours - a.mean(axis=0)) + b.mean(axis=0)
    some = np.random.default_rng(0)
    near = cKDTree(true).query(some.choice(ours, 100_000, replace=False), distance_upper_bound=0.2)[0]
    found = cKDTree(ours).query(some.choice(true, 100_000, replace=False))[0]
    return float(np.sqrt(np.mean(near[np.isfinite(near)] ** 2))), float(np.mean(found <= 0.05))


def errors_and_coverage(day: Day, trajectory: Trajectory) -> tuple[float, float]:
    """Absolute trajectory error, m, and the share of positions inside their 90 % ellipsoids."""
    stamps = np.arange(day.true.start + 0.5, day.true.end - 0.5, 0.5)
    rows = np.abs(trajectory.stamps - stamps[:, None]).argmin(axis=1)
    assert trajectory.covariances is not None
    off = trajectory.positions[rows] - day.true.at(trajectory.stamps[rows])[:, :3, 3]
    R = trajectory.T_map_imu[rows, :3, :3]
    covariances = R @ trajectory.covariances[rows, 3:, 3:] @ np.swapaxes(R, 1, 2)
    squares = np.einsum("ki,ki->k", off, np.linalg.solve(covariances, off[..., None])[..., 0])
    return float(np.sqrt(np.mean(np.sum(off**2, axis=1)))), float(np.mean(squares < quantile(0.9, 3)))


def planted(days: Sequence[Day], seed: int) -> tuple[int, int]:
    """Wrong pairs among right ones: how many were planted, and how many the graph took.

    They are shifted along the street or across it by 2.5 to 12 m, as bays, facades and lanes repeat themselves.
    """
    drives, rng = [day.alone for day in days], np.random.default_rng(seed)
    passes = [pass_of(drive.sweeps, drive.trajectory, drive.condensed, REVISITS) for drive in drives]
    pairs, taken = register_passes(passes, REVISITS).pairs, 0
    for _ in range(PLANTED):
        wrong, T = int(rng.integers(len(pairs))), pairs.T.copy()
        angle, metres = rng.choice([0.0, 0.5 * np.pi]), rng.uniform(2.5, 12.0) * rng.choice([-1.0, 1.0])
        T[wrong, :2, 3] += metres * np.array([np.cos(angle), np.sin(angle)])
        both = AnchorPairs(pairs.drives, pairs.anchors, T, pairs.covariances)
        taken += bool(bind([drive.condensed for drive in drives], both).used[wrong])
    return PLANTED, taken


def search_ms(days: Sequence[Day]) -> float:
    """Milliseconds per scan of finding, registering and binding."""
    start = time.perf_counter()
    bind_passes([day.alone for day in days], REVISITS)
    return 1000 * (time.perf_counter() - start) / sum(len(day.log.scans) for day in days)


def simulated(gnss: Gnss, seeds: Sequence[int], work: Path) -> Figures:
    """Figures over all seeds."""
    rows: list[Figures] = []
    for seed in seeds:
        drives = _drives(gnss, seed, work)
        labels = work / f"labels_{gnss}_{seed}"
        for drive in drives:
            if gnss == "unit" and not (labels / drive.name).exists():
                write_corrupted_labels(drive, labels / drive.name, seed, workers=1)
        out = work / f"map_{gnss}_{seed}"
        segmenter = f"labels:{labels}/{{drive}}" if gnss == "unit" else "none"
        run_drives(drives, out, SETTINGS, HowMapped(segmenter, force=True))
        rows.append(of_seed(drives, out, seed) | {"seed": seed})
        print(gnss, json.dumps(rows[-1]), flush=True)
    return summary(rows) | {"seeds": rows}


def _drives(gnss: Gnss, seed: int, work: Path) -> list[Path]:
    folder = work / f"{gnss}_{seed}"
    for session in (0, 1):
        if not (folder / f".{session}").exists():
            simulate(folder, SECONDS, seed, session=session, gnss=gnss)
            (folder / f".{session}").touch()
    return sorted(folder.glob("*/*_sync"))


def of_seed(drives: Sequence[Path], out: Path, seed: int) -> Figures:
    days = days_of(drives, out)
    before, after = surfaces_apart(days)
    accuracy, complete = accuracy_and_completeness(days)
    alone = [errors_and_coverage(day, day.alone.trajectory) for day in days]
    bound = [errors_and_coverage(day, day.bound) for day in days]
    count, taken = planted(days, seed)
    second = days[1]
    assert second.log.frame is not None
    return {
        "before_m": float(np.median(before)),
        "after_m": float(np.median(after)),
        "thickness_ratio": thickness(days),
        "accuracy_m": accuracy,
        "completeness": complete,
        "errors_alone_m": [error for error, _ in alone],
        "errors_bound_m": [error for error, _ in bound],
        "covered_alone": [share for _, share in alone],
        "covered_bound": [share for _, share in bound],
        "planted": count,
        "planted_taken": taken,
        "search_ms_per_scan": search_ms(days),
        "changes": score_changes(out, drives, second.true, second.bound, second.log.frame),
    }


def summary(rows: Sequence[Figures]) -> Figures:
    def rms(name: str) -> float:
        return float(np.sqrt(np.mean(np.square([row[name] for row in rows]))))

    total = {name: sum(row["changes"][name] for row in rows) for name in rows[0]["changes"]}
    return {
        **{
            name: float(np.median([row[name] for row in rows]))
            for name in (
                "before_m",
                "after_m",
                "thickness_ratio",
                "accuracy_m",
                "completeness",
                "search_ms_per_scan",
            )
        },
        "largest_after_m": max(row["after_m"] for row in rows),
        "error_bound_over_alone": rms("errors_bound_m") / rms("errors_alone_m"),
        "covered_alone": float(np.mean([row["covered_alone"] for row in rows])),
        "covered_bound": float(np.mean([row["covered_bound"] for row in rows])),
        "planted": sum(row["planted"] for row in rows),
        "planted_taken": sum(row["planted_taken"] for row in rows),
        "changes_precision": total["right"] / max(total["found"], 1),
        "changes_recall": total["recalled"] / max(total["there"], 1),
        "changes_kind_right": total["kind_right"] / max(total["told"], 1),
        "changes_there": total["there"],
    }


def real() -> Figures | None:
    """Every other scan of the excerpt as one drive, the rest as another one whose fixes lie 0.88 m away."""
    if not (DATA / EXCERPT).is_dir():
        print(f"no real data at {DATA}: excerpt left out")
        return None
    log = open_drive(DATA / EXCERPT)
    assert log.gnss is not None
    moved = GnssFixes(log.gnss.stamps, log.gnss.positions + SHIFT_M, log.gnss.stddevs)
    halves = [replace(log, scans=log.scans[::2]), replace(log, scans=log.scans[1::2], gnss=moved)]
    located = []
    for name, half in zip("ab", halves, strict=True):
        found = locate(half, SETTINGS, RunStats(), bound=False)
        assert found.solution is not None
        assert found.solution.condensed is not None
        assert found.sweeps is not None
        located.append(LocatedDrive(name, found.sweeps, found.trajectory, found.solution.condensed))
    together = bind_passes(located, REVISITS)
    bound = [
        drive.trajectory if correction is None else correction.of(drive.trajectory)
        for drive, correction in zip(located, together.corrections, strict=True)
    ]
    return {
        "coincide_before": _coincide(halves, [drive.trajectory for drive in located]),
        "coincide_after": _coincide(halves, bound),
        "passes": [vars(row) for row in together.passes],
    }


def _coincide(logs: Sequence[SensorLog], trajectories: Sequence[Trajectory]) -> float:
    """Share of the voxels of the half with fewer that the other half has, too."""
    sets = []
    for log, trajectory in zip(logs, trajectories, strict=True):
        parts = [points_in_map(s.read(), s.stamp, trajectory, log.calibration.T_imu_lidar) for s in log.scans]
        sets.append(np.unique(keys_of(np.concatenate(parts), SETTINGS.mapping.voxel_size_m)))
    return len(np.intersect1d(*sets)) / min(map(len, sets))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--work", type=Path)
    parser.add_argument("--seeds", type=int, nargs="*", default=SEEDS)
    parser.add_argument("--only", nargs="*", choices=CASES, default=CASES)
    words = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        work = words.work or Path(folder)
        for case in words.only:
            found: Figures | None
            if case == "coverage":
                found = {gnss: coverage(gnss, DRAWS) for gnss in ("unit", "consumer")}
            else:
                found = real() if case == "real" else simulated(case, words.seeds, work)
            if found is not None:
                keep(RESULTS, {case: found})
                print(
                    json.dumps({name: figure for name, figure in found.items() if name != "seeds"}, indent=1)
                )


if __name__ == "__main__":
    main()
