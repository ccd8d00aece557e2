"""What wheel speed is worth in outages of GNSS: simulated drives with exact truth.

    python benchmarks/wheels.py [--seeds 10]

prints a table and writes benchmarks/results/wheels.json. The wheels are those of a vehicle's bus: 20 Hz, without sign,
3 % and 0.1 m/s off, 0.04 s late, rounded to 0.05 m/s; they slip for 5 % of the time.
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from results_file import keep
from trajectory import FRAME, LEVER, OUTAGES, judge, mounted, simulate

from factor_graphs.measurements import WheelSpeeds
from factor_graphs.rigid_motion import RigidMotion
from factor_graphs.settings import SmootherSettings
from factor_graphs.simulation import random_drive, simulate_wheels
from factor_graphs.smoothing import smooth

SECONDS, SLIP_SHARE = 600.0, 0.05
TRUTH = np.array([1.03, 0.1, 0.04])
DRIVES = {"IMU at the axle": random_drive, "IMU 2°, 1°, 1.2 m off the axle": mounted}
SETTINGS = {
    "no vehicle constraint": SmootherSettings(vehicle_constraint="off"),
    "vehicle constraint": SmootherSettings(),
}
HEAD = "horizontal m   in outages m (mean of worst)   90 % ellipse: all, in outages"


def slips(rng: np.random.Generator) -> list[tuple[float, float, float]]:
    """Wheels that spin, drag or are locked, 1 to 6 s at a time."""
    found: list[tuple[float, float, float]] = []
    while sum(last - first for first, last, _ in found) < SLIP_SHARE * SECONDS:
        first = rng.uniform(0.0, SECONDS)
        found.append(
            (first, first + rng.uniform(1.0, 6.0), float(rng.choice([rng.uniform(0.05, 0.6), -0.3, -1.0])))
        )
    return found


def wheels_of(motion: RigidMotion, seed: int, slipping: bool) -> WheelSpeeds:
    """What the wheels of a drive say."""
    rng, (scale, offset, latency) = np.random.default_rng(1000 + seed), TRUTH
    return simulate_wheels(
        motion, np.arange(0.02, SECONDS, 0.05), rng, scale=scale, offset_mps=offset, latency_s=latency,
        stddev_mps=0.03, quantum_mps=0.05, signed=False, slips=slips(rng) if slipping else (),
    )  # fmt: skip


def compare(seeds: int) -> dict[str, Any]:
    """Errors with and without wheels: mean over the seeds; how well their calibration is found."""
    table: dict[str, Any] = {}
    for drive, moves in DRIVES.items():
        runs: dict[str, list[dict[str, float]]] = {}
        for seed in range(seeds):
            motion, imu, fixes, _ = simulate(seed, SECONDS, moves, outages=OUTAGES)
            speeds = {
                "no wheels": None,
                "wheels": wheels_of(motion, seed, slipping=False),
                "slipping wheels": wheels_of(motion, seed, slipping=True),
            }
            for name, settings in SETTINGS.items():
                for which, wheels in speeds.items():
                    s = smooth(imu, fixes, FRAME, settings, LEVER, wheels=wheels)
                    figures = judge(s.keyframes, motion, OUTAGES)
                    if s.wheels is not None and s.wheels.stddevs is not None:
                        off = s.wheels.calibration[:3] - TRUTH
                        figures |= {"scale_error": abs(float(off[0])), "slip_share": s.wheels.slip_share}
                        figures["calibration_nees"] = float(np.mean((off / s.wheels.stddevs[:3]) ** 2))
                    runs.setdefault(f"{name}, {which}", []).append(figures)
        print(f"\n{drive:45} {HEAD}")
        table[drive] = {}
        for name, figures_of in runs.items():
            mean = {key: float(np.mean([run[key] for run in figures_of])) for key in figures_of[0]}
            line = "{horizontal_m:8.3f} {inside_outages_m:13.3f} ({inside_outages_max_m:.2f})"
            line += " {covered_horizontal:17.2f} {covered_horizontal_inside_outages:.2f}"
            found = "  scale off by {scale_error:.4f}, slip {slip_share:.3f}" if "scale_error" in mean else ""
            print(f"  {name:45}" + (line + found).format(**mean))
            table[drive][name] = mean
    return table


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument(
        "-o", "--output", type=Path, default=Path(__file__).parent / "results" / "wheels.json"
    )
    arguments = parser.parse_args()
    results = {"seeds": arguments.seeds, "drives": compare(arguments.seeds)}
    keep(arguments.output, results, "gtsam")
    print(f"\nwritten to {arguments.output}")


if __name__ == "__main__":
    main()
