"""What goes wrong in the field: how far the trajectory is off then, and whether its covariance says so.

    python benchmarks/field.py [--seeds 20] [--only scale reverse]

prints a row per case and writes benchmarks/results/field.json. Each case is a simulated drive with exact truth, a MEMS
IMU at 100 Hz, and one mistake that is in no setting.
"""

import argparse
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from results_file import RESULTS, keep
from scipy.spatial.transform import Rotation

from factor_graphs.accuracy import errors, nees
from factor_graphs.chi_square import quantile
from factor_graphs.geodesy import LocalFrame
from factor_graphs.measurements import GnssFixes, ImuNoise, ImuSamples
from factor_graphs.relative_poses import RelativePoses
from factor_graphs.rigid_motion import Mounted, RigidMotion
from factor_graphs.settings import SmootherSettings
from factor_graphs.simulation import follow, random_drive, simulate_biases, simulate_gnss, simulate_imu
from factor_graphs.smoothing import smooth
from factor_graphs.trajectory import Trajectory

Array = NDArray[np.float64]

FRAME, LEVER = LocalFrame(49.0, 8.4, 115.0), np.array([0.5, 0.3, 1.0])
WRONG = LEVER + np.array([1.0, 0.0, 0.0])
METRE, RTK = (1.0, 1.0, 2.0), (0.02, 0.02, 0.03)
ODOMETRY = np.repeat([5e-4, 5e-3], 3)
STEP_S, PARTS = 0.01, 4


@dataclass(frozen=True, eq=False)
class Log:
    """What is smoothed, and the truth; errors are counted at stamps that are `judged` (first, last)."""

    motion: RigidMotion
    imu: ImuSamples
    fixes: GnssFixes
    p_imu_antenna: Array
    relative: RelativePoses | None = None
    settings: SmootherSettings | None = None
    judged: tuple[float, float] = (-np.inf, np.inf)


def simulate(
    seed: int,
    seconds: float = 300.0,
    stddevs: tuple[float, float, float] = METRE,
    hertz: float = 1.0,
    moves: Callable[[float, np.random.Generator], RigidMotion] = random_drive,
    means: bool = False,
    **gnss: Any,
) -> Log:
    """A drive without a mistake; with `means`, samples of the IMU are means of the interval before their stamp."""
    rng = np.random.default_rng(seed)
    motion, noise = moves(seconds, rng), ImuNoise()
    stamps = np.arange(0.1, seconds, STEP_S)
    biases = simulate_biases(stamps, noise, rng)
    moments = stamps[:, None] - STEP_S * (np.arange(PARTS) + 0.5) / PARTS if means else stamps[:, None]
    exact = [simulate_imu(motion, of_part, FRAME) for of_part in moments.T]
    white = np.repeat([noise.accelerometer_noise_density, noise.gyroscope_noise_density], 3) / np.sqrt(STEP_S)
    values = biases + white * rng.standard_normal(biases.shape)
    values[:, :3] += np.mean([part.specific_force for part in exact], axis=0)
    values[:, 3:] += np.mean([part.angular_rate for part in exact], axis=0)
    imu = ImuSamples(stamps, values[:, :3], values[:, 3:])
    fix_stamps = np.arange(0.47, seconds - 0.5, 1 / hertz)
    return Log(motion, imu, simulate_gnss(motion, fix_stamps, stddevs, LEVER, rng, **gnss), LEVER)


def turned(yaw_deg: float) -> Callable[[float, np.random.Generator], RigidMotion]:
    """Drives of an IMU that is turned by so much on the vehicle."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("z", yaw_deg, degrees=True).as_matrix()
    return lambda seconds, rng: Mounted(random_drive(seconds + 2.0, rng), T)


def on_a_roof(seconds: float, rng: np.random.Generator) -> RigidMotion:
    """The IMU 1.8 m above the axle, on a body that sways."""
    T = np.eye(4)
    T[2, 3] = 1.8
    return Mounted(random_drive(seconds + 2.0, rng), T)


def mostly_reverse(seconds: float, rng: np.random.Generator) -> RigidMotion:
    """Ahead for 50 s, then back at 3 m/s."""
    stamps = np.array([0, 5, 55, 60, 70, 75, seconds - 30, seconds])
    x = np.linspace(0, 800, 80)
    way = np.column_stack([x, 25 * np.sin(x / 40 + rng.uniform(0, 6)), 0 * x])
    return follow(way, stamps, [0.0, 12, 12, 0, 0, -3, -3, 0], suspension_deg=0.3)


def with_bias(log: Log, up_deg_per_s: float) -> Log:
    """The gyroscope turns so much at rest."""
    rates = log.imu.angular_rate + np.radians([0.3, -0.3, 1.0]) * up_deg_per_s
    return replace(log, imu=ImuSamples(log.imu.stamps, log.imu.specific_force, rates))


def scaled(log: Log, scale: float) -> Log:
    """The z axis of the gyroscope turns so many times as much."""
    rates = log.imu.angular_rate * [1, 1, scale]
    return replace(log, imu=ImuSamples(log.imu.stamps, log.imu.specific_force, rates))


def stepping(log: Log) -> Log:
    """The receiver's clock steps by 0.3 s in the middle."""
    stamps = log.fixes.stamps + 0.3 * (log.fixes.stamps > np.median(log.fixes.stamps))
    return replace(log, fixes=replace(log.fixes, stamps=stamps))


def repeated(log: Log) -> Log:
    """Each fix is written ten times a second, until the next one."""
    fixes = log.fixes
    stamps = (fixes.stamps[:, None] + 0.1 * np.arange(10)).ravel()
    rows = np.repeat(np.arange(len(fixes)), 10)
    return replace(log, fixes=GnssFixes(stamps, fixes.positions[rows], fixes.stddevs[rows]))


def jumping(log: Log, by_m: float, first: float, last: float, seed: int) -> Log:
    """Fixes between two stamps are displaced by one vector."""
    azimuth = np.random.default_rng(seed).uniform(0, 2 * np.pi)
    inside = (log.fixes.stamps >= first) & (log.fixes.stamps < last)
    by = by_m * np.array([np.cos(azimuth), np.sin(azimuth), 0.3])
    return replace(
        log,
        fixes=replace(log.fixes, positions=log.fixes.positions + by * inside[:, None]),
        judged=(first, last),
    )


def with_odometry(log: Log, seed: int) -> Log:
    """Relative poses as of LiDAR odometry, twice a second."""
    rng, stamps = np.random.default_rng(seed), np.arange(0.5, log.imu.stamps[-1] - 0.5, 0.5)
    pairs = np.column_stack([stamps[:-1], stamps[1:]])
    between = np.linalg.inv(log.motion.poses(pairs[:, 0])) @ log.motion.poses(pairs[:, 1])
    noise = rng.standard_normal((len(pairs), 6)) * ODOMETRY
    off = np.tile(np.eye(4), (len(pairs), 1, 1))
    off[:, :3, :3], off[:, :3, 3] = Rotation.from_rotvec(noise[:, :3]).as_matrix(), noise[:, 3:]
    covariances = np.tile(np.diag(ODOMETRY**2), (len(pairs), 1, 1))
    return replace(log, relative=RelativePoses(pairs, between @ off, covariances))


LATE = {"time_offset_s": -0.6}
CASES: dict[str, Callable[[int], Log]] = {
    "nothing wrong": simulate,
    "gyroscope bias -2 deg/s": lambda seed: with_bias(simulate(seed), -2.0),
    "gyroscope bias 5 deg/s": lambda seed: with_bias(simulate(seed), 5.0),
    "white fixes of 1 m, 10 Hz": lambda seed: simulate(seed, 600.0, hertz=10.0),
    "RTK of 1 cm, 10 Hz, samples are means": lambda seed: simulate(
        seed, 600.0, (0.01, 0.01, 0.02), 10.0, means=True
    ),
    "repeated, 0.6 s late, IMU turned by 90 deg": lambda seed: repeated(
        simulate(seed, moves=turned(90.0), **LATE)
    ),
    "IMU on the roof, outage of 60 s": lambda seed: replace(
        simulate(seed, moves=on_a_roof, outages=[(150.0, 210.0)]), judged=(150.0, 210.0)
    ),
    "RTK jumps by 5 m for 60 s": lambda seed: jumping(simulate(seed, 600.0, RTK), 5.0, 270.0, 330.0, seed),
    "the same beside 5 % outliers": lambda seed: jumping(
        simulate(seed, 600.0, RTK, outlier_share=0.05), 5.0, 270.0, 330.0, seed
    ),
    "RTK jumps by 20 m for 30 s": lambda seed: jumping(simulate(seed, 600.0, RTK), 20.0, 270.0, 300.0, seed),
    "1 m fixes jump by 20 m for 30 s": lambda seed: jumping(simulate(seed, 600.0), 20.0, 270.0, 300.0, seed),
    "RTK jumps by 5 m for 60 s, LiDAR odometry": lambda seed: with_odometry(
        jumping(simulate(seed, 600.0, RTK), 5.0, 270.0, 330.0, seed), seed
    ),
    "gyroscope scale 1 %": lambda seed: scaled(simulate(seed), 1.01),
    "gyroscope scale 3 %": lambda seed: scaled(simulate(seed), 1.03),
    "mostly reverse": lambda seed: simulate(seed, moves=mostly_reverse),
    "IMU looks backward": lambda seed: simulate(seed, moves=turned(180.0)),
    "clock steps by 0.3 s": lambda seed: stepping(simulate(seed)),
    "clock steps by 0.3 s, RTK": lambda seed: stepping(simulate(seed, stddevs=RTK)),
    "antenna 1 m off, 100 s": lambda seed: replace(simulate(seed, 100.0), p_imu_antenna=WRONG),
    "antenna 1 m off, 100 s, asked for": lambda seed: replace(
        simulate(seed, 100.0),
        p_imu_antenna=WRONG,
        settings=SmootherSettings(estimate_lever_arm=True),
    ),
}


def figures(log: Log) -> dict[str, float]:
    """Errors of the keyframes that are judged, and how they compare with the covariance."""
    found = smooth(
        log.imu, log.fixes, FRAME, log.settings, log.p_imu_antenna, relative_poses=log.relative
    ).keyframes
    found = found[(found.stamps >= log.judged[0]) & (found.stamps < log.judged[1])]
    off = errors(found, log.motion.trajectory(found.stamps))
    squares = nees(off.position[:, :2], horizontal(found))
    return {
        "horizontal_m": off.horizontal_rms_m,
        "heading_deg": off.heading_rms_deg,
        "deviations": float(np.sqrt(squares.mean() / 2)),
        "covered": float(np.mean(squares < quantile(0.9, 2))),
    }


def horizontal(found: Trajectory) -> Array:
    """Covariance of east and north (k, 2, 2) m²."""
    assert found.covariances is not None
    R = found.T_map_imu[:, :3, :3]
    return np.asarray((R @ found.covariances[:, 3:, 3:] @ np.swapaxes(R, 1, 2))[:, :2, :2])


def rows(seeds: int, only: list[str]) -> Iterator[tuple[str, dict[str, float]]]:
    """A case and its figures over all seeds: horizontal and heading, mean and most; deviations; coverage."""
    for name, make in CASES.items():
        if only and not any(word in name for word in only):
            continue
        runs = [figures(make(5000 + seed)) for seed in range(seeds)]
        horizontal_m, heading, deviations, covered = (np.array([run[key] for run in runs]) for key in runs[0])
        yield name, {
            "horizontal_m": horizontal_m.mean(), "most_m": horizontal_m.max(), "heading_deg": heading.mean(),
            "most_deg": heading.max(), "deviations": float(np.sqrt(np.mean(deviations**2))),
            "most_deviations": deviations.max(), "covered": covered.mean(),
        }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument(
        "--only", nargs="+", default=[], help="words of the cases to run; the others are kept"
    )
    parser.add_argument("-o", "--output", type=Path, default=RESULTS / "field.json")
    args = parser.parse_args()
    print(f"{'case':44}{'horizontal m':>16}{'heading deg':>16}{'deviations':>14}{'in 90 %':>9}")
    for name, of in rows(args.seeds, args.only):
        print(
            f"{name:44}{of['horizontal_m']:8.3f}{of['most_m']:8.3f}{of['heading_deg']:8.3f}{of['most_deg']:8.3f}"
            f"{of['deviations']:7.2f}{of['most_deviations']:7.2f}{of['covered']:9.3f}",
            flush=True,
        )
        keep(args.output, {name: of | {"seeds": args.seeds}}, "gtsam", "numpy")


if __name__ == "__main__":
    main()
