"""The factor graph against the classical filter, on the same simulated drives with a GNSS outage of a minute.

    python examples/kalman_baseline.py [--drives 3] [--seconds 300]

prints one table: an error-state Kalman filter (EKF), the same with a backward pass (RTS), and the graph, which also
uses that the axle of a vehicle does not slide.
"""

import argparse
from collections import defaultdict

import numpy as np

from factor_graphs import LocalFrame, smooth
from factor_graphs.accuracy import coverage, errors, pose_nees
from factor_graphs.kalman import kalman_smooth
from factor_graphs.measurements import ImuNoise
from factor_graphs.simulation import random_drive, simulate_gnss, simulate_imu

FRAME = LocalFrame(49.0, 8.4, 115.0)
ANTENNA = (0.5, 0.3, 1.0)
OUTAGE_S = 60.0


def main() -> None:
    """Simulate, estimate three times, and print the mean over the drives."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--drives", type=int, default=3, help="number of drives (default: 3)")
    parser.add_argument("--seconds", type=float, default=300.0, help="length of each (default: 300)")
    chosen = parser.parse_args()
    if chosen.drives < 1 or chosen.seconds < OUTAGE_S + 20:
        parser.error(
            f"expected --drives of 1 or more, and --seconds of {OUTAGE_S + 20:g} or more, around the outage"
        )

    figures = defaultdict(list)
    for seed in range(chosen.drives):
        for name, row in compare(seed, chosen.seconds).items():
            figures[name].append(row)
    print(f"{'':13}  horizontal, m  in the outage, m  heading, °  inside the 90 % ellipse")
    for name, rows in figures.items():
        horizontal, lost, heading, inside = np.mean(rows, axis=0)
        print(f"{name:13} {horizontal:14.2f} {lost:17.2f} {heading:11.2f} {100 * inside:22.0f} %")


def compare(seed: int, seconds: float) -> dict[str, tuple[float, ...]]:
    """Of every estimator: rms error, the same in the outage, rms heading error, and how many errors it expected."""
    rng = np.random.default_rng(seed)
    motion = random_drive(seconds, rng)
    outage = ((seconds - OUTAGE_S) / 2, (seconds + OUTAGE_S) / 2)
    imu = simulate_imu(motion, np.arange(0.0, seconds, 0.01), FRAME, ImuNoise(), rng)
    stamps = np.arange(0.5, seconds - 0.5)
    fixes = simulate_gnss(motion, stamps, (1.0, 1.0, 2.0), ANTENNA, rng, outages=[outage])

    kalman = kalman_smooth(imu, fixes, FRAME, p_imu_antenna=ANTENNA)
    graph = smooth(imu, fixes, FRAME, p_imu_antenna=ANTENNA)
    estimates = {"EKF": kalman.filtered, "EKF + RTS": kalman.smoothed, "factor graph": graph.keyframes}
    rows = {}
    for name, estimate in estimates.items():
        truth = motion.trajectory(estimate.stamps)
        off, inside = errors(estimate, truth), coverage(pose_nees(estimate, truth).horizontal, 2).inside[1]
        lost = off.within([outage]).horizontal_rms_m
        rows[name] = (off.horizontal_rms_m, lost, off.heading_rms_deg, inside)
    return rows


if __name__ == "__main__":
    main()
