"""How sharp the map is with LiDAR odometry and without, what it costs, and how far an outage leads astray.

    python benchmarks/sharpness.py [--seconds 100] [--only excerpt simulated outage]

prints the tables and writes benchmarks/results/sharpness.json. The real excerpt is read from $GNSS_SEM_MAP_DATA (or
../shared/data) and left out where it is absent; the simulated drive has exact truth.
"""

from __future__ import annotations

import argparse
import tempfile
import time
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from real_data import DATA
from results_file import keep
from scipy.spatial.transform import Rotation

from factor_graphs.accuracy import errors
from factor_graphs.alignment import AttitudePrior
from factor_graphs.measurements import GnssFixes, ImuNoise, ImuSamples
from factor_graphs.relative_poses import RelativePoses
from factor_graphs.settings import SmootherSettings
from factor_graphs.simulation import simulate_gnss, simulate_imu
from factor_graphs.smoothing import Solution, smooth
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.datasets import open_drive
from gnss_sem_map.datasets.kitti_oxts import ATTITUDE_STDDEVS_RAD, OXTS_NOISE
from gnss_sem_map.evaluation import map_sharpness
from gnss_sem_map.evaluation.map_sharpness import Sharpness, SharpnessSettings
from gnss_sem_map.scans.deskew import points_in_map
from gnss_sem_map.scans.lidar_odometry import ScanMatches, match_scans
from gnss_sem_map.sensor_log import Calibration, Points, Scan, SensorLog
from gnss_sem_map.simulation import Simulation, prepare
from gnss_sem_map.simulation.kitti_rig import T_IMU_LIDAR

Array = NDArray[np.float64]
DRIVE = "kitti_raw/2011_09_26/2011_09_26_drive_0005_sync"
POSE = ("tx", "ty", "tz", "rz")
MOVED_M, BOX_MARGIN_M = 2.0, 0.2
SEED, LEVER = 901, np.array([0.5, 0.3, 1.0])
OUTAGE_SEEDS = range(8)
COST_RUNS = 5


def excerpt() -> dict[str, Any] | None:
    """Frames 114 to 153 of the real drive: static points, every trajectory."""
    if not (DATA / DRIVE).is_dir():
        print(f"no real data at {DATA}: excerpt left out")
        return None
    log = open_drive(DATA / DRIVE)
    unit, alone, matches, bound, cost = estimate(log)
    assert log.reference is not None
    odometry = chained(matches.relative_poses, log.reference)
    boxes = moving_boxes(DATA / DRIVE / "tracklet_labels.xml", log)
    trajectories = {"navigation unit": unit, "GNSS + IMU": alone.trajectory, "scan matching alone": odometry}
    trajectories["GNSS + IMU + LiDAR"] = bound.trajectory
    figures = {name: static_sharpness(log, t, boxes) for name, t in trajectories.items()}
    show("drive 0005, frames 114 to 153, static points", figures)
    to_fixes = distance_to_fixes(log, bound, matches.relative_poses)
    voxels = figures["GNSS + IMU + LiDAR"].voxels
    against = {name: voxels / figures[name].voxels for name in ("GNSS + IMU", "navigation unit")}
    print("voxels against " + ", ".join(f"{name} {ratio:.3f}" for name, ratio in against.items()))
    for where, found in to_fixes.items():
        print(f"distance to the fixes, nothing aligned, {where}: {found}")
    print(cost)
    return {
        "sharpness": {name: s.as_dict() for name, s in figures.items()},
        "voxels_against_gnss_and_imu": against["GNSS + IMU"],
        "voxels_against_navigation_unit": against["navigation unit"],
        "distance_to_fixes": to_fixes, "cost": cost,
        "second_deskewing": second_deskewing(log, bound, boxes),
    }  # fmt: skip


def distance_to_fixes(log: SensorLog, bound: Solution, relative: RelativePoses) -> dict[str, Any]:
    """Of the whole log, and where there are scans: what remains, and the unit's own accuracy."""
    assert log.gnss is not None
    off, stamps = bound.fix_residuals, log.gnss.stamps
    inside = np.isfinite(off[:, 0])
    scanned = (stamps >= relative.stamps.min()) & (stamps <= relative.stamps.max())
    return {
        where: {
            "rms_per_axis_m": np.sqrt(np.mean(off[rows] ** 2, axis=0)).round(3).tolist(),
            "largest_m": round(float(np.linalg.norm(off[rows], axis=1).max()), 3),
            "fixes_say_m": round(float(np.median(log.gnss.stddevs[rows])), 3),
        }
        for where, rows in (("whole log", inside), ("where there are scans", inside & scanned))
    }


def second_deskewing(log: SensorLog, bound: Solution, boxes: list[Any]) -> dict[str, Any]:
    """What it would bring to match once more, deskewed by the better trajectory."""
    again = solve(log, match_scans(log, bound.trajectory).relative_poses)
    found = static_sharpness(log, again.trajectory, boxes)
    show("the same, matched again by the result", {"GNSS + IMU + LiDAR": found})
    return found.as_dict()


def solve(log: SensorLog, relative: RelativePoses | None = None) -> Solution:
    assert log.imu is not None
    assert log.gnss is not None
    assert log.frame is not None
    settings = SmootherSettings(imu_noise=log.imu_noise or ImuNoise())
    lever, attitude = log.calibration.p_imu_antenna, log.initial_attitude
    return smooth(log.imu, log.gnss, log.frame, settings, lever, attitude, relative)


def estimate(log: SensorLog) -> tuple[Trajectory, Solution, ScanMatches, Solution, dict[str, float]]:
    """The unit's own trajectory, GNSS + IMU, the matches, all together, and the cost of a scan in ms."""
    alone = solve(log)
    matches = match_scans(log, alone.trajectory)
    unit = log.reference or alone.trajectory
    return unit, alone, matches, solve(log, matches.relative_poses), cost_per_scan(log, alone.trajectory)


def cost_per_scan(log: SensorLog, trajectory: Trajectory) -> dict[str, float]:
    """Of matching the first sweeps, ms: the best of several runs, for other programs only ever add to it."""
    some = replace(log, scans=log.scans[:40])
    runs = []
    for _ in range(COST_RUNS):
        wall, cpu = time.perf_counter(), time.process_time()
        match_scans(some, trajectory)
        runs.append((time.perf_counter() - wall, time.process_time() - cpu))
    wall, cpu = 1e3 * np.min(runs, axis=0) / len(some.scans)
    return {"wall_ms_per_scan": round(float(wall), 1), "cpu_ms_per_scan": round(float(cpu), 1)}


def chained(relative: RelativePoses, start: Trajectory) -> Trajectory:
    """Scan matching alone: its single steps in a row, from where `start` is."""
    length = np.diff(relative.stamps, axis=1)[:, 0]
    steps = relative[length < 1.5 * length.min()]
    T = [start.at([steps.stamps[0, 0]])[0]]
    for T_imu_imu in steps.T_imu_imu:
        T.append(T[-1] @ T_imu_imu)
    return Trajectory(np.append(steps.stamps[:, 0], steps.stamps[-1, 1]), np.array(T))


def moving_boxes(tracklets: Path, log: SensorLog) -> list[tuple[Array, int, Array]]:
    """Size, first frame and poses (x, y, z, yaw; lidar frame) of every box that moves more than 2 m."""
    T_map_lidar = {}
    assert log.reference is not None
    for scan in log.scans:
        T_map_lidar[scan.number] = log.reference.at([scan.stamp], 0.15)[0] @ log.calibration.T_imu_lidar
    boxes = []
    for item in ET.parse(tracklets).getroot().iterfind("tracklets/item"):
        first = int(item.findtext("first_frame", "0"))
        poses = np.array(
            [[float(pose.findtext(name, "0")) for name in POSE] for pose in item.iterfind("poses/item")]
        )
        seen = [k for k in range(first, first + len(poses)) if k in T_map_lidar]
        places = np.array([(T_map_lidar[k] @ [*poses[k - first, :3], 1.0])[:3] for k in seen])
        if len(seen) > 1 and np.linalg.norm(places[-1] - places[0]) > MOVED_M:
            boxes.append((np.array([float(item.findtext(n, "0")) for n in "lwh"]), first, poses))
    return boxes


def static_sharpness(log: SensorLog, trajectory: Trajectory, boxes: list[Any]) -> Sharpness:
    settings = SharpnessSettings()
    stamps = np.array([scan.stamp for scan in log.scans])
    positions = trajectory.at(stamps, 0.15)[::10, :3, 3]
    length = float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())
    return map_sharpness.of_clouds(static_clouds(log, trajectory, boxes, settings), length, settings)


def static_clouds(
    log: SensorLog, trajectory: Trajectory, boxes: list[Any], settings: SharpnessSettings
) -> Iterator[Array]:
    for scan in log.scans:
        points = scan.read()
        ranges = np.linalg.norm(points.xyz, axis=1)
        use = (ranges >= settings.nearest_m) & (ranges <= settings.farthest_m)
        use[np.arange(len(use)) % settings.every_nth_point > 0] = False
        for size, first, poses in boxes:
            if first <= scan.number < first + len(poses):
                x, y, z, yaw = poses[scan.number - first]
                local = Rotation.from_euler("z", -yaw).apply(points.xyz - np.array([x, y, z]))
                half = size[:2] / 2 + BOX_MARGIN_M
                inside = (np.abs(local[:, :2]) < half).all(axis=1) & (local[:, 2] < size[2] + BOX_MARGIN_M)
                use &= ~(inside & (local[:, 2] > -BOX_MARGIN_M))
        yield points_in_map(points[use], scan.stamp, trajectory, log.calibration.T_imu_lidar)


def show(title: str, figures: dict[str, Sharpness]) -> None:
    print(f"\n{title}\n{'':26}{'plane':>8}{'ground':>8}{'wall':>8} cm{'MME':>9}{'voxels':>10}")
    for name, s in figures.items():
        cm = "".join(f"{100 * v:8.2f}" for v in (s.thickness_m, s.ground_thickness_m, s.wall_thickness_m))
        print(f"{name:26}{cm}   {s.mean_map_entropy:9.3f}{s.voxels:10d}")


@cache
def simulation(seconds: float) -> tuple[Simulation, tuple[Scan, ...], tempfile.TemporaryDirectory[str]]:
    """A simulated drive with its sweeps on disk; stamps are those of the simulation."""
    simulated = prepare(seconds, SEED)
    folder = tempfile.TemporaryDirectory(prefix="sharpness-")
    scans = []
    for k, (start, end) in enumerate(simulated.sweeps):
        scan = simulated.scan(k)
        path = Path(folder.name) / f"{k}.npz"
        stamps = start + scan.fractions * (end - start)
        np.savez(path, points=scan.points, stamps=stamps)
        scans.append(Scan(f"{k:010d}", k, float(simulated.stamps[k]), partial(_read, path)))
    return simulated, tuple(scans), folder


def _read(path: Path) -> Points:
    with np.load(path) as content:
        points = content["points"]
        return Points(points[:, :3], points[:, 3], content["stamps"])


def simulated_log(seconds: float, imu: ImuSamples, gnss: GnssFixes, lever: Array, **more: Any) -> SensorLog:
    drive, scans, _ = simulation(seconds)
    calibration = Calibration(T_IMU_LIDAR, p_imu_antenna=lever)
    return SensorLog(
        "simulated", 0, calibration, scans, (), frame=drive.frame, imu=imu, gnss=gnss, **more
    )  # fmt: skip


def truth_at(seconds: float) -> Callable[[Array], Array]:
    """T_map_imu (k, 4, 4) at any stamps (k,)."""
    drive, _, _ = simulation(seconds)

    def poses(stamps: Array) -> Array:
        T = drive.world.ego.poses(stamps)
        T[:, :3, 3] = drive.to_map(T[:, :3, 3])
        return T

    return poses


def true_trajectory(seconds: float) -> Trajectory:
    drive, _, _ = simulation(seconds)
    stamps = np.arange(drive.oxts_stamps[0], drive.oxts_stamps[-1], 0.1)
    return Trajectory(stamps, truth_at(seconds)(stamps))


def exact(relative: RelativePoses, truth: Callable[[Array], Array]) -> RelativePoses:
    """The same steps without error, and trusted to a tenth of a millimetre: what no odometry can better."""
    T = np.linalg.inv(truth(relative.stamps[:, 0])) @ truth(relative.stamps[:, 1])
    T[:, :3, :3] = Rotation.from_matrix(T[:, :3, :3]).as_matrix()
    certain = np.diag(np.repeat([1e-5**2, 1e-4**2], 3))
    return RelativePoses(relative.stamps, T, np.tile(certain, (len(relative), 1, 1)))


def step_errors(relative: RelativePoses, truth: Callable[[Array], Array], scans: int) -> dict[str, Any]:
    """Errors along the imu's axes, and NEES: 6 where covariances are honest, less where they are careful."""
    length = np.diff(relative.stamps, axis=1)[:, 0]
    closed = np.trace(relative.covariances[:, 3:, 3:], axis1=1, axis2=2) < 1.0  # no open direction
    chosen = relative[closed & (np.abs(length - 0.1 * scans) < 0.05)]
    T = np.linalg.inv(chosen.T_imu_imu) @ exact(chosen, truth).T_imu_imu
    off = np.column_stack([Rotation.from_matrix(T[:, :3, :3]).as_rotvec(), T[:, :3, 3]])
    nees = np.einsum("ki,kij,kj->k", off, np.linalg.inv(chosen.covariances), off)
    rms = 1e3 * np.sqrt(np.mean(off**2, axis=0))
    return {
        "rms_mm": rms[3:].round(2).tolist(), "rms_mrad": rms[:3].round(3).tolist(),
        "nees": round(float(nees.mean()), 2), "count": len(chosen),
    }  # fmt: skip


def simulated(seconds: float) -> dict[str, Any]:
    """The drive as its inertial unit reports it: 100 Hz IMU, positions ten times a second that drift together."""
    drive, _, _ = simulation(seconds)
    rows = drive.oxts
    positions = drive.frame.to_map(*rows[drive.sync, :3].T)
    imu = ImuSamples(drive.oxts_stamps, rows[:, 11:14], rows[:, 17:20])
    gnss = GnssFixes(drive.oxts_stamps[drive.sync], positions, np.repeat(rows[drive.sync, 23:24], 3, axis=1))
    attitude = Rotation.from_euler("ZYX", rows[0, [5, 4, 3]]).as_matrix()
    prior = AttitudePrior(attitude, ATTITUDE_STDDEVS_RAD)
    log = simulated_log(seconds, imu, gnss, np.zeros(3), initial_attitude=prior, imu_noise=OXTS_NOISE)
    _, alone, matches, bound, cost = estimate(log)
    truth = true_trajectory(seconds)
    found = {"GNSS + IMU": alone.trajectory, "GNSS + IMU + LiDAR": bound.trajectory}
    figures = dict(zip(found, map_sharpness.of_drive(log, list(found.values())), strict=True))
    show(f"simulated drive, {seconds:g} s", figures)
    accuracy = {name: per_100_m(t, truth) for name, t in found.items()}
    for name, a in accuracy.items():
        print(f"{name:26}" + "".join(f"{key} {value:.4g}   " for key, value in a.items()))
    steps = {f"over {n} scans": step_errors(matches.relative_poses, truth_at(seconds), n) for n in (1, 10)}
    for name, found_steps in steps.items():
        print(f"relative poses {name}: {found_steps}")
    print(f"{dict(matches.counts)}; {cost}")
    return {
        "seconds": seconds, "sharpness": {name: s.as_dict() for name, s in figures.items()}, "accuracy": accuracy,
        "relative_poses": steps, "counts": dict(matches.counts), "cost": cost, "chi2_per_dof": bound.chi2_per_dof,
    }  # fmt: skip


def per_100_m(found: Trajectory, truth: Trajectory) -> dict[str, float]:
    """Relative pose error over 100 m of way, mean over all starts, and the heading error."""
    inside = truth.stamps[(truth.stamps > found.start) & (truth.stamps < found.end)]
    wanted, got = truth.at(inside), found.at(inside)
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(wanted[:, :3, 3], axis=0), axis=1))])
    ends = np.searchsorted(way, way + 100.0)
    starts = np.flatnonzero(ends < len(way))
    i, j = starts, ends[starts]
    off = np.linalg.inv(np.linalg.inv(wanted[i]) @ wanted[j]) @ (np.linalg.inv(got[i]) @ got[j])
    turn = np.degrees(Rotation.from_matrix(off[:, :3, :3]).magnitude())
    heading = errors(found, truth).rotation[:, 2]
    return {
        "translation_percent": float(np.mean(np.linalg.norm(off[:, :3, 3], axis=1))),
        "rotation_deg_per_m": float(np.mean(turn) / 100.0),
        "heading_rms_deg": float(np.degrees(np.sqrt(np.mean(heading**2)))),
        "way_m": float(way[-1]),
    }


def outage(seconds: float) -> dict[str, Any]:
    """A MEMS IMU and a 1 Hz receiver (1, 1, 2 m of white noise) that is silent for 60 s in the middle.

    The seeds are of the sensors' noise. Sweeps are matched once, deskewed by the first seed's GNSS + IMU. What exact
    steps would leave is the noise of the fixes before and after.
    """
    drive, _, _ = simulation(seconds)
    first, last = seconds / 2 - 30.0, seconds / 2 + 30.0
    truth = true_trajectory(seconds)
    rows: list[dict[str, float]] = []
    matches: ScanMatches | None = None
    for seed in OUTAGE_SEEDS:
        rng = np.random.default_rng(seed)
        imu = simulate_imu(drive.world.ego, drive.oxts_stamps, drive.frame, ImuNoise(), rng)
        seen = np.arange(drive.oxts_stamps[0] + 0.5, drive.oxts_stamps[-1] - 0.5)
        fixes = simulate_gnss(drive.world.ego, seen, (1.0, 1.0, 2.0), LEVER, rng, outages=[(first, last)])
        gnss = GnssFixes(fixes.stamps, drive.to_map(fixes.positions), fixes.stddevs)
        log = simulated_log(seconds, imu, gnss, LEVER)
        alone = solve(log)
        matches = matches or match_scans(log, alone.trajectory)
        bound = solve(log, matches.relative_poses)
        best = solve(log, exact(matches.relative_poses, truth_at(seconds)))
        row = {}
        for name, solution in (("without", alone), ("with", bound), ("with_exact_steps", best)):
            e = errors(solution.trajectory, truth)
            row[f"{name}_inside_m"] = e.within([(first, last)]).horizontal_rms_m
            row[f"{name}_whole_m"] = e.horizontal_rms_m
        rows.append(row)
        print(f"outage of 60 s, seed {seed}: " + "   ".join(f"{k} {v:.3f}" for k, v in row.items()))
    mean = {key: float(np.sqrt(np.mean([row[key] ** 2 for row in rows]))) for key in rows[0]}
    worst = {key: max(row[key] for row in rows) for key in rows[0]}
    for what, values in (("rms over the seeds", mean), ("worst seed", worst)):
        print(f"outage of 60 s, {what}: " + "   ".join(f"{k} {v:.3f}" for k, v in values.items()))
    return {"seconds": seconds, "seeds": rows, "rms": mean, "worst": worst}


PARTS: dict[str, Callable[[float], dict[str, Any] | None]] = {
    "excerpt": lambda seconds: excerpt(),
    "simulated": simulated,
    "outage": outage,
}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=100.0, help="length of the simulated drive")
    parser.add_argument(
        "--only", nargs="+", choices=PARTS, default=list(PARTS), help="the others are kept as they are"
    )
    parser.add_argument(
        "-o", "--output", type=Path, default=Path(__file__).parent / "results" / "sharpness.json"
    )
    arguments = parser.parse_args()
    for part in arguments.only:
        found = PARTS[part](arguments.seconds)
        if found is not None:
            keep(arguments.output, {part: found}, "small_gicp", "gtsam")
    print(f"\nwritten to {arguments.output}")


if __name__ == "__main__":
    main()
