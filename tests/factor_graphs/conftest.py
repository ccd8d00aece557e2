"""A simulated drive with exact truth, and its solution, shared by the tests that only look at them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from factor_graphs.geodesy import LocalFrame
from factor_graphs.measurements import GnssFixes, ImuNoise, ImuSamples
from factor_graphs.rigid_motion import RigidMotion
from factor_graphs.simulation import random_drive, simulate_biases, simulate_gnss, simulate_imu
from factor_graphs.smoothing import Solution, smooth

FRAME = LocalFrame(49.0, 8.4, 115.0)
LEVER = np.array([0.5, 0.3, 1.0])
STDDEVS = (1.0, 1.0, 2.0)


@dataclass(frozen=True, eq=False)
class Drive:
    """What happened, and what the sensors said of it."""

    motion: RigidMotion
    imu: ImuSamples
    fixes: GnssFixes
    biases: NDArray[np.float64]


def drive(
    seed: int,
    seconds: float = 120.0,
    noise: ImuNoise | None = None,
    moves: Callable[[float, np.random.Generator], RigidMotion] = random_drive,
    **gnss: object,
) -> Drive:
    """A random drive with a 100 Hz MEMS IMU (exact when `noise` is None) and 1 Hz fixes."""
    rng = np.random.default_rng(seed)
    motion = moves(seconds, rng)
    stamps = np.arange(0.0, seconds, 0.01)
    biases = np.zeros((len(stamps), 6)) if noise is None else simulate_biases(stamps, noise, rng)
    imu = simulate_imu(motion, stamps, FRAME, noise, rng, biases=biases)
    fix_stamps = np.arange(0.37, seconds - 0.5, 1.0)
    fixes = simulate_gnss(motion, fix_stamps, STDDEVS, LEVER, None if noise is None else rng, **gnss)
    return Drive(motion, imu, fixes, biases)


@pytest.fixture(scope="session")
def simulate() -> Callable[..., Drive]:
    return drive


@pytest.fixture(scope="session")
def mems() -> Drive:
    return drive(3, noise=ImuNoise())


@pytest.fixture(scope="session")
def mems_solution(mems: Drive) -> Solution:
    return smooth(mems.imu, mems.fixes, FRAME, None, LEVER)
