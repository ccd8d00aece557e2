"""Drives of nothing but an IMU and fixes, and what the pre-flight says about them."""

from __future__ import annotations

from typing import Any

import numpy as np

from factor_graphs.geodesy import LocalFrame
from factor_graphs.measurements import ImuNoise
from factor_graphs.simulation import random_drive, simulate_gnss, simulate_imu
from gnss_sem_map import config
from gnss_sem_map.preflight import inertial, positions
from gnss_sem_map.preflight.findings import Finding, Level
from gnss_sem_map.preflight.sample import Sample
from gnss_sem_map.sensor_log import Calibration, SensorLog
from gnss_sem_map.sensor_log.conventions import SensorConventions

FRAME = LocalFrame(49.0, 8.4, 115.0)
SETTINGS = config.load()
LEVER = (0.5, 0.3, 1.0)


def drive(
    seed: int,
    seconds: float = 60.0,
    noise: ImuNoise | None = None,
    stddev_m: float = 1.0,
    every_s: float = 1.0,
    **gnss: Any,
) -> SensorLog:
    """A random drive with a 100 Hz IMU (exact when `noise` is None) and fixes of a receiver."""
    rng = np.random.default_rng(seed)
    motion = random_drive(seconds, rng)
    imu = simulate_imu(motion, np.arange(0.0, seconds, 0.01), FRAME, noise, rng)
    stddevs = (stddev_m, stddev_m, 2 * stddev_m)
    fixes = simulate_gnss(motion, np.arange(0.37, seconds - 0.2, every_s), stddevs, LEVER, rng, **gnss)
    calibration = Calibration(np.eye(4), p_imu_antenna=np.array(LEVER))
    return SensorLog("drive", 0, calibration, (), (), FRAME, imu, fixes)


def findings(log: SensorLog, conventions: SensorConventions | None = None) -> list[Finding]:
    sample = Sample(log.in_our_conventions(conventions or SensorConventions()), SETTINGS, None)
    return [*inertial.check(sample), *positions.check(sample)]


def wrong(found: list[Finding]) -> list[str]:
    return [str(finding) for finding in found if finding.level is not Level.GREEN]
