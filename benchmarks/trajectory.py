"""How good the trajectory is: simulated drives with exact truth, one real log, and the cost of it all.

    python benchmarks/trajectory.py [--seeds 10] [--only cost streaming]

prints the tables and writes benchmarks/results/trajectory.json. Times are CPU seconds of one core.
"""

import argparse
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray
from results_file import keep
from scipy.spatial.transform import Rotation

from factor_graphs.accuracy import anees_band, coverage, errors, nees, pose_nees, state_error
from factor_graphs.chi_square import quantile
from factor_graphs.geodesy import LocalFrame
from factor_graphs.kalman import kalman_smooth
from factor_graphs.measurements import GnssFixes, ImuNoise, ImuSamples, clean_imu
from factor_graphs.rigid_motion import Mounted, RigidMotion, drone, hand_held
from factor_graphs.settings import SmootherSettings
from factor_graphs.simulation import random_drive, simulate_biases, simulate_gnss, simulate_imu
from factor_graphs.smoothing import Solution, smooth
from factor_graphs.streaming import StreamingSmoother
from factor_graphs.trajectory import Trajectory

FRAME = LocalFrame(49.0, 8.4, 115.0)
LEVER = np.array([0.5, 0.3, 1.0])
STDDEVS = (1.0, 1.0, 2.0)
OUTAGES = ((100.0, 130.0), (250.0, 310.0), (450.0, 480.0))
# How an IMU may sit elsewhere: yaw to the left and pitch downwards, and the distance to the rear axle.
MOUNTED_DEG, MOUNTED_AHEAD_M = (2.0, 1.0), 1.2


def mounted(seconds: float, rng: np.random.Generator) -> Mounted:
    """A random drive, seen by an IMU that looks 2° left and 1° down, 1.2 m ahead of the rear axle."""
    T_vehicle_imu = np.eye(4)
    T_vehicle_imu[:3, :3] = Rotation.from_euler("ZYX", [*MOUNTED_DEG, 0.0], degrees=True).as_matrix()
    T_vehicle_imu[0, 3] = MOUNTED_AHEAD_M
    return Mounted(random_drive(seconds, rng), T_vehicle_imu)


CASES: dict[str, dict[str, Any]] = {
    "clean": {},
    "outages of 30, 60, 30 s": {"outages": OUTAGES},
    "10 % outliers": {"outlier_share": 0.1},
    "30 % outliers": {"outlier_share": 0.3},
    "IMU 2°, 1°, 1.2 m off the axle": {"moves": mounted},
    "the same with outages": {"moves": mounted, "outages": OUTAGES},
    "hand-held": {"moves": hand_held},
    "drone": {"moves": drone},
}
WALKING = ImuNoise(
    **{name: 5 * getattr(ImuNoise(), name) for name in ("accelerometer_bias_walk", "gyroscope_bias_walk")}
)
HONESTY: dict[str, dict[str, Any]] = {
    "clean": {},
    "outages of 30, 60, 30 s": {"outages": OUTAGES},
    "10 % outliers": {"outlier_share": 0.1},
    "30 % outliers": {"outlier_share": 0.3},
    "IMU 3 times noisier than said": {"noise": ImuNoise().scaled(3.0)},
    "the same with outages": {"noise": ImuNoise().scaled(3.0), "outages": OUTAGES},
    "biases walk 5 times faster, outages": {"noise": WALKING, "outages": OUTAGES},
    "IMU 2°, 1°, 1.2 m off, outages": {"moves": mounted, "outages": OUTAGES},
}
PLAIN = SmootherSettings(standing_stddev_mps=None, vehicle_constraint="off")
GRAPHS = {
    "graph, no constraint": PLAIN,
    "graph, standing": SmootherSettings(vehicle_constraint="off"),
    "graph (default)": SmootherSettings(),
}
Figures = dict[str, float]


def simulate(
    seed: int,
    seconds: float = 600.0,
    moves: Callable[[float, np.random.Generator], RigidMotion] = random_drive,
    noise: ImuNoise | None = None,
    **gnss: Any,
) -> tuple[RigidMotion, ImuSamples, GnssFixes, NDArray[np.float64]]:
    """A drive of `seconds` s, its MEMS-grade IMU at 100 Hz, its fixes at 1 Hz, and the true biases.

    `noise` is the IMU's own, where it is not what the smoother believes.
    """
    rng = np.random.default_rng(seed)
    motion = moves(seconds, rng)
    stamps, noise = np.arange(0.0, seconds, 0.01), noise or ImuNoise()
    biases = simulate_biases(stamps, noise, rng)
    imu = simulate_imu(motion, stamps, FRAME, noise, rng, biases=biases)
    return (
        motion,
        imu,
        simulate_gnss(motion, np.arange(0.0, seconds - 0.5), STDDEVS, LEVER, rng, **gnss),
        biases,
    )


def judge(found: Trajectory, motion: RigidMotion, outages: Sequence[tuple[float, float]] = ()) -> Figures:
    """Horizontal, vertical and heading error, and the share of positions in their 90 % ellipsoid; also in outages."""
    e = errors(found, motion.trajectory(found.stamps))
    inside = e.within(outages)
    worst = np.linalg.norm(inside.position[:, :2], axis=1).max(initial=0.0)
    assert found.covariances is not None
    R = found.T_map_imu[:, :3, :3]
    P = R @ found.covariances[:, 3:, 3:] @ np.swapaxes(R, 1, 2)
    covered = [nees(e.position[:, :n], P[:, :n, :n]) < quantile(0.9, n) for n in (2, 3)]
    lost = np.isin(e.stamps, inside.stamps)
    return {
        "horizontal_m": e.horizontal_rms_m, "vertical_m": e.vertical_rms_m, "heading_deg": e.heading_rms_deg,
        "inside_outages_m": inside.horizontal_rms_m, "inside_outages_max_m": float(worst),
        "covered_horizontal": float(np.mean(covered[0])), "covered_3d": float(np.mean(covered[1])),
        "covered_horizontal_inside_outages": float(np.mean(covered[0][lost])) if lost.any() else float("nan"),
        "covered_3d_inside_outages": float(np.mean(covered[1][lost])) if lost.any() else float("nan"),
    }  # fmt: skip


def estimate(imu: ImuSamples, fixes: GnssFixes) -> dict[str, Trajectory]:
    """Every estimator's trajectory at its keyframes."""
    both = kalman_smooth(imu, fixes, FRAME, None, LEVER)
    graphs = {name: smooth(imu, fixes, FRAME, settings, LEVER).keyframes for name, settings in GRAPHS.items()}
    return {"error-state EKF": both.filtered, "EKF + RTS": both.smoothed, **graphs}


def simulated(seeds: int) -> dict[str, dict[str, Figures]]:
    """Every estimator in every case: mean over the seeds."""
    table: dict[str, dict[str, Figures]] = {}
    for case, gnss in CASES.items():
        runs = []
        for seed in range(seeds):
            motion, imu, fixes, _ = simulate(seed, **gnss)
            outages = gnss.get("outages", ())
            runs.append({name: judge(found, motion, outages) for name, found in estimate(imu, fixes).items()})
        print(f"\n{case:36} h rms m   u rms m  yaw rms °  90 % h, 3D  in outages m (mean of worst), 90 %")
        table[case] = {}
        for name in runs[0]:
            mean = {key: float(np.mean([run[name][key] for run in runs])) for key in runs[0][name]}
            outage = ""
            if "outages" in gnss:
                outage = "{inside_outages_m:8.3f} ({inside_outages_max_m:.2f})".format(**mean)
                outage += " {covered_horizontal_inside_outages:.2f} {covered_3d_inside_outages:.2f}".format(
                    **mean
                )
            line = "{horizontal_m:9.3f} {vertical_m:9.3f} {heading_deg:9.3f}"
            line += "    {covered_horizontal:.2f} {covered_3d:.2f}"
            print(f"  {name:32}" + line.format(**mean) + outage)
            table[case][name] = mean
    return table


def honesty(seeds: int) -> dict[str, Any]:
    """Share of positions in their 90 % ellipsoid, and scale gap k: everywhere, in outages, and within 30 s of them."""
    table: dict[str, Any] = {}
    print(
        f"\n{'90 % coverage h, 3D; k h, 3D':36} all                     in outages              within 30 s of them"
    )
    for case, told in HONESTY.items():
        outages, squares = told.get("outages", ()), dict[str, list[tuple[NDArray[np.float64], ...]]]()
        for seed in range(seeds):
            motion, imu, fixes, _ = simulate(seed, **told)
            found = smooth(imu, fixes, FRAME, None, LEVER).keyframes
            values = pose_nees(found, motion.trajectory(found.stamps))
            both = np.stack([values.horizontal, values.position])
            inside, near = (
                np.any([(found.stamps >= a - m) & (found.stamps <= b + m) for a, b in outages], axis=0)
                for m in (0.0, 30.0)
            )
            whole = np.ones(len(found), dtype=bool)
            for place, chosen in (("all", whole), ("in outages", inside), ("near outages", near & ~inside)):
                if outages or place == "all":
                    squares.setdefault(place, []).append(both[:, chosen])
        table[case] = {}
        for place, parts in squares.items():
            of_place = [
                coverage(row, dof) for row, dof in zip(np.concatenate(parts, axis=1), (2, 3), strict=True)
            ]
            table[case][place] = {
                "covered_horizontal": of_place[0].inside[1], "covered_3d": of_place[1].inside[1],
                "k_horizontal": of_place[0].scale_gap, "k_3d": of_place[1].scale_gap,
            }  # fmt: skip
        line = "{covered_horizontal:.3f} {covered_3d:.3f} {k_horizontal:.2f} {k_3d:.2f}   "
        print(f"{case:36}", *(line.format(**figures) for figures in table[case].values()), flush=True)
    return table


def consistency(seeds: int) -> Figures:
    """Mean normalised error squared of the 15-number state, at one moment per drive."""
    values = []
    for seed in range(seeds):
        motion, imu, fixes, biases = simulate(seed)
        s = smooth(imu, fixes, FRAME, PLAIN.model_copy(update={"robust": False}), LEVER)
        k = int(np.searchsorted(s.keyframes.stamps, 300.0))
        stamp = s.keyframes.stamps[k]
        bias = np.array([np.interp(stamp, imu.stamps, column) for column in biases.T])
        velocities = s.keyframes.velocities
        assert velocities is not None
        e = state_error(
            s.keyframes.T_map_imu[k], velocities[k], s.biases[k],
            motion.poses([stamp])[0], motion.velocities([stamp])[0], bias,
        )  # fmt: skip
        values.append(float(nees(e, s.state_covariances[k])))
    low, high = anees_band(15, seeds)
    print(
        f"\nANEES of 15 states over {seeds} drives: {np.mean(values):.2f}; 99 % band {low:.2f} to {high:.2f}"
    )
    return {"anees": float(np.mean(values)), "band_low": low, "band_high": high}


def real_log() -> dict[str, Figures]:
    """The KITTI log in gtsam's wheel: every tenth fix used, and windows of 60 s withheld."""
    folder = Path(gtsam.__file__).parent / "Data"
    rows = np.loadtxt(folder / "KittiEquivBiasedImu.txt", skiprows=1)
    gps = np.loadtxt(folder / "KittiGps_converted.txt", skiprows=1, delimiter=",")
    epoch = rows[0, 0]
    imu, repairs = clean_imu(rows[:, 0] - epoch, rows[:, 2:5], rows[:, 5:8])
    # the example that ships with this log gives the fixes a variance of 0.07 m²; the IMU's noise is its data sheet's
    fixes = GnssFixes(gps[:, 0] - epoch, gps[:, 1:], np.full((len(gps), 3), 0.07**0.5))
    noise = ImuNoise(
        accelerometer_noise_density=0.01, gyroscope_noise_density=1.75e-4,
        accelerometer_bias_walk=1.67e-4, gyroscope_bias_walk=2.91e-6,
    )  # fmt: skip
    windows = [(60.0, 120.0), (180.0, 240.0), (300.0, 360.0), (390.0, 450.0)]
    withheld = np.logical_or.reduce([(fixes.stamps >= a) & (fixes.stamps <= b) for a, b in windows])
    table = {}
    print(f"\nthe real log in gtsam's wheel ({repairs})")
    tenth, plain = np.arange(len(fixes)) % 10 == 0, SmootherSettings(imu_noise=noise)
    for name, used, settings in (
        ("every tenth fix", tenth, plain),
        ("60 s withheld, no vehicle", ~withheld, plain.model_copy(update={"vehicle_constraint": "off"})),
        ("60 s windows withheld", ~withheld, plain),
    ):
        start = time.process_time()
        s = smooth(imu, fixes[used], FRAME, settings)
        seconds = time.process_time() - start
        judged = ~used & (fixes.stamps <= s.trajectory.end)
        off = s.trajectory.at(fixes.stamps[judged])[:, :3, 3] - fixes.positions[judged]
        distance = np.linalg.norm(off, axis=1)
        table[name] = {
            "rms_3d_m": float(np.sqrt(np.mean(distance**2))), "max_m": float(distance.max()),
            "horizontal_rms_m": float(np.sqrt(np.mean(np.sum(off[:, :2] ** 2, axis=1)))),
            "fixes_judged": float(judged.sum()), "inflation": s.inflation,
            "chi2_per_dof": s.chi2_per_dof, "cpu_s": seconds,
        }  # fmt: skip
        line = "3D rms {rms_3d_m:.3f} m, horizontal {horizontal_rms_m:.3f} m, max {max_m:.2f} m"
        line += " at {fixes_judged:.0f} unused fixes; IMU noise x {inflation:.0f}; {cpu_s:.2f} s"
        print(f"  {name:24}" + line.format(**table[name]))
    return table


def mounting(seeds: int) -> Figures:
    """How well the mounting of an IMU is found, in drives with outages: RMS and largest errors of it."""
    off = []
    for seed in range(seeds):
        _, imu, fixes, _ = simulate(seed, moves=mounted, outages=OUTAGES)
        found = smooth(imu, fixes, FRAME, None, LEVER).vehicle
        assert found is not None
        assert found.held
        off.append([*(found.yaw_pitch_deg - MOUNTED_DEG), found.mounting[2] - MOUNTED_AHEAD_M])
    rms, largest = np.sqrt(np.mean(np.square(off), axis=0)), np.abs(off).max(axis=0)
    figures = {
        "yaw_rms_deg": float(rms[0]), "pitch_rms_deg": float(rms[1]), "ahead_rms_m": float(rms[2]),
        "yaw_max_deg": float(largest[0]), "pitch_max_deg": float(largest[1]), "ahead_max_m": float(largest[2]),
    }  # fmt: skip
    line = "\nmounting, rms (largest) error: yaw {yaw_rms_deg:.3f} ({yaw_max_deg:.3f})°, "
    line += "pitch {pitch_rms_deg:.3f} ({pitch_max_deg:.3f})°, place {ahead_rms_m:.3f} ({ahead_max_m:.3f}) m"
    print(line.format(**figures))
    return figures


def cost(rounds: int = 5, longest: float = 7200.0) -> dict[str, Figures]:
    """CPU time of the whole solution, dense output and covariances included, by length of the drive.

    The same time of driving in drives of every length: one of two hours, eight of a quarter of an hour, which take the
    machine as long. The speed of a machine changes from minute to minute, and a short run would find a quick one more
    often than a long one. All lengths are run in turn, each drive in a process of its own: the least time of each, and
    the median over the rounds of what it takes over the shortest.
    """
    print("\nlength s   CPU s   times real time   of what the shortest takes per second")
    lengths = (900.0, 1800.0, 3600.0, longest)
    drives = {s: [simulate(seed, s)[1:3] for seed in range(round(longest / s))] for s in lengths}
    spent = np.array([[sum(_cpu_s(*one) for one in drives[s]) for s in lengths] for _ in range(rounds)])
    least, over_linear = spent.min(axis=0), np.median(spent / spent[:, :1], axis=0)
    table: dict[str, Figures] = {}
    for seconds, cpu_s, ratio in zip(lengths, least.tolist(), over_linear.tolist(), strict=True):
        speed = longest / cpu_s
        table[f"{seconds:.0f} s"] = {
            "cpu_s": seconds / speed, "times_real_time": speed, "over_linear": ratio
        }  # fmt: skip
        print(f"{seconds:8.0f} {seconds / speed:7.2f} {speed:12.0f} {ratio:12.3f}", flush=True)
    return table


def _cpu_s(imu: ImuSamples, fixes: GnssFixes) -> float:
    """CPU time of a drive in a process of its own, as users run it: memory of the drive before would be quicker."""
    with ProcessPoolExecutor(1, get_context("fork")) as process:
        return process.submit(_cpu_s_here, imu, fixes).result()


def _cpu_s_here(imu: ImuSamples, fixes: GnssFixes) -> float:
    """Without what a process does but once: its first minute is solved before."""
    _smoothed(imu[imu.stamps < 60.0], fixes[fixes.stamps < 60.0])
    start = time.process_time()
    _smoothed(imu, fixes)
    return time.process_time() - start


def _smoothed(imu: ImuSamples, fixes: GnssFixes) -> Solution:
    return smooth(imu, fixes, FRAME, None, LEVER)


def streaming(lag_s: float = 10.0) -> Figures:
    """Mean and longest CPU time per fix of the fixed-lag smoother, and its error."""
    motion, imu, fixes, _ = simulate(0)
    begin = imu.stamps <= 40.0
    first = ImuSamples(imu.stamps[begin], imu.specific_force[begin], imu.angular_rate[begin])
    online = StreamingSmoother(
        smooth(first, fixes[fixes.stamps <= 40.0], FRAME, None, LEVER), FRAME, LEVER, lag_s
    )
    spent, off = [], []
    for i in np.flatnonzero(fixes.stamps > online.state.stamp):
        a, b = np.searchsorted(imu.stamps, [online.state.stamp, fixes.stamps[i]])
        rows = slice(max(a - 1, 0), b + 1)
        news = ImuSamples(imu.stamps[rows], imu.specific_force[rows], imu.angular_rate[rows])
        start = time.process_time()
        state = online.add(news, fixes[i : i + 1])
        spent.append(1e3 * (time.process_time() - start))
        off.append((state.T_map_imu - motion.poses([state.stamp])[0])[:2, 3])
    figures = {
        "mean_ms": float(np.mean(spent)), "max_ms": float(np.max(spent)), "restarts": float(online.restarts),
        "horizontal_m": float(np.sqrt(np.mean(np.sum(np.square(off), axis=1)))),
    }  # fmt: skip
    line = "\nstreaming, lag {:.0f} s: {mean_ms:.2f} ms per fix (max {max_ms:.1f}), "
    line += "h rms {horizontal_m:.2f} m, {restarts:.0f} restarts"
    print(line.format(lag_s, **figures))
    return figures


PARTS: dict[str, Callable[[int], Any]] = {
    "simulated": simulated,
    "honesty": honesty,
    "consistency": consistency,
    "real_log": lambda seeds: real_log(),
    "mounting": mounting,
    "cost": lambda seeds: cost(),
    "streaming": lambda seeds: streaming(),
}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument(
        "--only", nargs="+", choices=PARTS, default=list(PARTS), help="the others are kept as they are"
    )
    parser.add_argument(
        "-o", "--output", type=Path, default=Path(__file__).parent / "results" / "trajectory.json"
    )
    arguments = parser.parse_args()
    for part in arguments.only:
        found = {"seeds": arguments.seeds} | PARTS[part](arguments.seeds)
        keep(arguments.output, {part: found}, "gtsam")
    print(f"\nwritten to {arguments.output}")


if __name__ == "__main__":
    main()
