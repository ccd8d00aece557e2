"""Follow a vehicle fix by fix, with the fixed-lag smoother: a simulated drive, its error, and how sure it is.

    python examples/streaming.py [--seconds 120] [--lag 10]

The first 30 s are smoothed as a whole, which finds attitude and biases; from there on every fix gives one state.
"""

import argparse

import numpy as np

from factor_graphs import LocalFrame, smooth
from factor_graphs.measurements import ImuNoise
from factor_graphs.simulation import random_drive, simulate_gnss, simulate_imu
from factor_graphs.streaming import StreamingSmoother

BEGIN_S = 30.0
FRAME = LocalFrame(49.0, 8.4, 115.0)
ANTENNA = (0.5, 0.3, 1.0)


def main() -> None:
    """Simulate, follow, and print a line every ten fixes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=120.0, help="length of the drive (default: 120)")
    parser.add_argument("--lag", type=float, default=10.0, help="how far back fixes correct, s (default: 10)")
    chosen = parser.parse_args()
    if chosen.seconds < BEGIN_S + 5:
        parser.error(
            f"--seconds: found {chosen.seconds:g}, expected {BEGIN_S + 5:g} or more: the first are smoothed"
        )

    rng = np.random.default_rng(1)
    motion = random_drive(chosen.seconds, rng)
    imu = simulate_imu(motion, np.arange(0.0, chosen.seconds, 0.01), FRAME, ImuNoise(), rng)
    fixes = simulate_gnss(motion, np.arange(0.5, chosen.seconds - 0.5), (1.0, 1.0, 2.0), ANTENNA, rng)

    first = smooth(imu[imu.stamps <= BEGIN_S], fixes[fixes.stamps <= BEGIN_S], FRAME, p_imu_antenna=ANTENNA)
    online = StreamingSmoother(first, FRAME, ANTENNA, lag_s=chosen.lag)
    errors = []
    print("time, s   horizontal error, m   its standard deviation, m")
    for i in np.flatnonzero(fixes.stamps > online.state.stamp):
        begin, end = np.searchsorted(imu.stamps, [online.state.stamp, fixes.stamps[i]])
        state = online.add(imu[max(begin - 1, 0) : end + 1], fixes[i : i + 1])
        off = state.T_map_imu[:2, 3] - motion.poses([state.stamp])[0, :2, 3]
        R, covariance = state.T_map_imu[:3, :3], online.pose_covariance()[3:, 3:]  # in the axes of the imu
        stddev = np.sqrt(np.trace((R @ covariance @ R.T)[:2, :2]))
        errors.append(np.linalg.norm(off))
        if i % 10 == 0:
            print(f"{state.stamp:7.1f} {errors[-1]:21.2f} {stddev:27.2f}")
    rms = np.sqrt(np.mean(np.square(errors)))
    print(f"rms of {len(errors)} states: {rms:.2f} m; of the fixes alone {np.hypot(1.0, 1.0):.2f} m")


if __name__ == "__main__":
    main()
