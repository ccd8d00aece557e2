"""Simulated navigation unit: KITTI's oxts rows of an exact motion, at 100 Hz.

Like the real unit it reports a fused solution, smooth and wrong by slowly drifting amounts: position by decimetres,
velocity by centimetres per second, attitude by hundredths of a degree.
"""

from collections.abc import Callable, Sequence
from itertools import accumulate
from typing import Final, Literal

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from factor_graphs.geodesy import LocalFrame
from factor_graphs.measurements import ImuNoise
from factor_graphs.simulation import Motion, simulate_gnss, simulate_imu
from gnss_sem_map.simulation.compiled import Floats

Gnss = Literal["unit", "consumer"]
_Axes = tuple[float, float, float]
# white noise and drift of the positions (east, north, up), and the accuracy that is claimed, m
_POSITION_STDDEVS_M: Final[dict[Gnss, tuple[_Axes, _Axes, float]]] = {
    "unit": ((0.002, 0.002, 0.003), (0.35, 0.35, 0.5), 0.35),
    "consumer": ((0.3, 0.3, 0.3), (0.95, 0.95, 0.95), 1.0),
}
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


def oxts_rows(
    motion: Motion,
    stamps: Floats,
    frame: LocalFrame,
    rng: np.random.Generator,
    gnss: Gnss = "unit",
    laps: Floats | None = None,
) -> Floats:
    """The 30 columns at these stamps (100 Hz): (n, 30).

    `laps` (n,): how many laps are driven, with fractions. Then the drifting errors of two passes of one place are
    independent, as if minutes lay between them.
    """
    white, drifting, claimed = _POSITION_STDDEVS_M[gnss]

    def reported() -> Floats:
        return simulate_gnss(
            motion, stamps, white, rng=rng, correlated_stddevs=drifting, correlation_time_s=120.0
        ).positions

    true = motion.poses(stamps)[:, :3, 3]
    positions = reported() if laps is None else true + _renewed(laps, lambda: reported() - true)
    imu = simulate_imu(motion, stamps, frame, NOISE, rng)
    rate = 1.0 / float(np.median(np.diff(stamps)))
    sigmas = np.array([3e-4, 3e-4, 1.2e-3, 0.02, 0.02, 0.02])

    def drift() -> Floats:
        return np.column_stack([_drift(len(stamps), rate, sigma, rng) for sigma in sigmas])

    drifts = (drift() if laps is None else _renewed(laps, drift)).T
    euler = Rotation.from_matrix(motion.poses(stamps)[:, :3, :3]).as_euler("ZYX")
    yaw, pitch, roll = euler[:, 0] + drifts[2], euler[:, 1] + drifts[1], euler[:, 2] + drifts[0]
    velocity = motion.velocities(stamps) + drifts[3:].T
    east, north, up = velocity.T
    forward, left = np.cos(yaw) * east + np.sin(yaw) * north, np.cos(yaw) * north - np.sin(yaw) * east
    level = Rotation.from_euler("YX", np.column_stack([pitch, roll])).as_matrix()
    force, turn = imu.specific_force[..., None], imu.angular_rate[..., None]
    count = len(stamps)
    modes = np.tile([4.0, 10.0, 4.0, 4.0, 0.0], (count, 1))
    return np.column_stack([
        *frame.to_geodetic(positions), roll, pitch, (yaw + np.pi) % (2 * np.pi) - np.pi,
        north, east, forward, left, up,
        force[..., 0], (level @ force)[..., 0], turn[..., 0], (level @ turn)[..., 0],
        np.full(count, claimed), np.full(count, 0.04), modes,
    ])  # fmt: skip


def _drift(count: int, rate: float, sigma: float, rng: np.random.Generator, seconds: float = 60.0) -> Floats:
    """An error that fades over `seconds` (Gauss-Markov of first order)."""
    keep = np.exp(-1.0 / (rate * seconds))
    steps = rng.standard_normal(count) * sigma * np.sqrt(1.0 - keep**2)
    steps[0] = sigma * rng.standard_normal()
    return np.array(list(accumulate(steps.tolist(), lambda error, step: keep * error + step)))


def _renewed(laps: Floats, draw: Callable[[], Floats]) -> Floats:
    """An error (n, k) that is drawn anew twice a lap, each draw fading into the next one.

    Its variance is that of one draw everywhere, and what lies a lap apart has no draw in common.
    """
    number = np.floor(2.0 * laps).astype(int)
    draws = np.stack([draw() for _ in range(number.max() + 2)])
    fade, rows = 0.5 * np.pi * (2.0 * laps - number)[:, None], np.arange(len(laps))
    return np.asarray(np.cos(fade) * draws[number, rows] + np.sin(fade) * draws[number + 1, rows])


def sweep_rows(stamps: Floats, sweeps: Floats, rng: np.random.Generator) -> npt.NDArray[np.int64]:
    """Which 100 Hz row the 10 Hz drive takes for every sweep: the one 10.7 to 22.6 ms after it, as on KITTI."""
    wanted = sweeps + rng.uniform(0.0107, 0.0226, len(sweeps))
    return np.asarray(np.abs(stamps[:, None] - wanted[None, :]).argmin(axis=0))


def row_text(row: Sequence[float] | Floats) -> str:
    """One oxts file: 14 significant digits, whole numbers for the last five columns."""
    return " ".join([*(f"{v:.14g}" for v in row[:25]), *(f"{int(v)}" for v in row[25:])]) + "\n"
