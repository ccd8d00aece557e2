"""Simulated navigation unit: KITTI's oxts rows of an exact motion, at 100 Hz.

Like the real unit it reports a fused solution, smooth and wrong by slowly drifting amounts: position by decimetres,
velocity by centimetres per second, attitude by hundredths of a degree.
"""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from factor_graphs.geodesy import LocalFrame
from factor_graphs.measurements import ImuNoise
from factor_graphs.simulation import Motion, simulate_gnss, simulate_imu
from gnss_sem_map.simulation.compiled import Floats

POSITION_STDDEVS_M = (0.35, 0.35, 0.5)
NOISE = ImuNoise(
    accelerometer_noise_density=1.5e-3,
    gyroscope_noise_density=8e-5,
    accelerometer_bias_walk=2e-5,
    gyroscope_bias_walk=1e-6,
    accelerometer_bias_stddev=0.01,
    gyroscope_bias_stddev=2e-4,
)
COLUMNS = [
    "lat",
    "lon",
    "alt",
    "roll",
    "pitch",
    "yaw",
    "vn",
    "ve",
    "vf",
    "vl",
    "vu",
    "ax",
    "ay",
    "az",
    "af",
    "al",
    "au",
    "wx",
    "wy",
    "wz",
    "wf",
    "wl",
    "wu",
    "pos_accuracy",
    "vel_accuracy",
    "navstat",
    "numsats",
    "posmode",
    "velmode",
    "orimode",
]

_MEANINGS = {
    "lat": "latitude (deg)", "lon": "longitude (deg)", "alt": "altitude (m)",
    "roll": "roll angle (rad), positive = left side up", "pitch": "pitch angle (rad), positive = front down",
    "yaw": "heading (rad), 0 = east, positive = counter clockwise", "vn": "velocity towards north (m/s)",
    "ve": "velocity towards east (m/s)", "vf": "forward velocity, level (m/s)", "vl": "leftward velocity, level (m/s)",
    "vu": "upward velocity (m/s)", "ax": "specific force in x, vehicle front (m/s^2)",
    "ay": "specific force in y, vehicle left (m/s^2)", "az": "specific force in z, vehicle top (m/s^2)",
    "af": "specific force forward, level (m/s^2)", "al": "specific force leftward, level (m/s^2)",
    "au": "specific force upward (m/s^2)", "wx": "angular rate around x (rad/s)", "wy": "angular rate around y (rad/s)",
    "wz": "angular rate around z (rad/s)", "wf": "angular rate around the level forward axis (rad/s)",
    "wl": "angular rate around the level leftward axis (rad/s)", "wu": "angular rate around the upward axis (rad/s)",
    "pos_accuracy": "position accuracy (m)", "vel_accuracy": "velocity accuracy (m/s)",
    "navstat": "navigation status", "numsats": "number of satellites tracked", "posmode": "position mode",
    "velmode": "velocity mode", "orimode": "orientation mode",
}  # fmt: skip
DATAFORMAT = "".join(f"{name + ':':<14} {_MEANINGS[name]}\n" for name in COLUMNS)


def oxts_rows(motion: Motion, stamps: Floats, frame: LocalFrame, rng: np.random.Generator) -> Floats:
    """The 30 columns at these stamps (100 Hz): (n, 30)."""
    fixes = simulate_gnss(
        motion,
        stamps,
        (0.002, 0.002, 0.003),
        rng=rng,
        correlated_stddevs=POSITION_STDDEVS_M,
        correlation_time_s=120.0,
    )
    imu = simulate_imu(motion, stamps, frame, NOISE, rng)
    rate = 1.0 / float(np.median(np.diff(stamps)))
    drifts = [_drift(len(stamps), rate, sigma, rng) for sigma in (3e-4, 3e-4, 1.2e-3, 0.02, 0.02, 0.02)]
    euler = Rotation.from_matrix(motion.poses(stamps)[:, :3, :3]).as_euler("ZYX")
    yaw, pitch, roll = euler[:, 0] + drifts[2], euler[:, 1] + drifts[1], euler[:, 2] + drifts[0]
    velocity = motion.velocities(stamps) + np.column_stack(drifts[3:])
    east, north, up = velocity.T
    forward, left = np.cos(yaw) * east + np.sin(yaw) * north, np.cos(yaw) * north - np.sin(yaw) * east
    level = Rotation.from_euler("YX", np.column_stack([pitch, roll])).as_matrix()
    force, turn = imu.specific_force[..., None], imu.angular_rate[..., None]
    count = len(stamps)
    accuracy = np.full(count, float(np.hypot(*POSITION_STDDEVS_M[:2]) / np.sqrt(2.0)))
    modes = np.tile([4.0, 10.0, 4.0, 4.0, 0.0], (count, 1))
    return np.column_stack([
        *frame.to_geodetic(fixes.positions), roll, pitch, (yaw + np.pi) % (2 * np.pi) - np.pi,
        north, east, forward, left, up,
        force[..., 0], (level @ force)[..., 0], turn[..., 0], (level @ turn)[..., 0],
        accuracy, np.full(count, 0.04), modes,
    ])  # fmt: skip


def _drift(count: int, rate: float, sigma: float, rng: np.random.Generator, seconds: float = 60.0) -> Floats:
    """An error that fades over `seconds` (Gauss-Markov of first order)."""
    keep = np.exp(-1.0 / (rate * seconds))
    drive = rng.standard_normal(count) * sigma * np.sqrt(1.0 - keep**2)
    drive[0] = sigma * rng.standard_normal()
    return np.asarray(lfilter([1.0], [1.0, -keep], drive))


def sweep_rows(stamps: Floats, sweeps: Floats, rng: np.random.Generator) -> npt.NDArray[np.int64]:
    """Which 100 Hz row the 10 Hz drive takes for every sweep: the one 10.7 to 22.6 ms after it, as on KITTI."""
    wanted = sweeps + rng.uniform(0.0107, 0.0226, len(sweeps))
    return np.asarray(np.abs(stamps[:, None] - wanted[None, :]).argmin(axis=0))


def row_text(row: Sequence[float] | Floats) -> str:
    """One oxts file: 14 significant digits, whole numbers for the last five columns."""
    return " ".join([*(f"{v:.14g}" for v in row[:25]), *(f"{int(v)}" for v in row[25:])]) + "\n"
