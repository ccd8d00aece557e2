"""A simulated drive with exact truth, and its solution, shared by the tests that only look at them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from factor_graphs.geodesy import LocalFrame
from factor_graphs.measurements import GnssFixes, ImuNoise, ImuSamples
from factor_graphs.problem import Problem, pose_problem
from factor_graphs.relative_poses import RelativePoses
from factor_graphs.rigid_motion import RigidMotion
from factor_graphs.settings import SmootherSettings
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


def odometry(motion: RigidMotion, stamps: NDArray[np.float64]) -> RelativePoses:
    """Relative poses without errors: each keyframe to the next, and every fifth, an anchor, to all up to the next."""
    earlier = np.concatenate([np.arange(len(stamps) - 1), np.arange(len(stamps) - 1) // 5 * 5])
    pairs = np.unique(np.column_stack([earlier, np.tile(np.arange(1, len(stamps)), 2)]), axis=0)
    T = motion.poses(stamps)
    between = np.linalg.inv(T[pairs[:, 0]]) @ T[pairs[:, 1]]
    covariance = np.diag(np.repeat([1e-3, 0.01], 3) ** 2)
    return RelativePoses(stamps[pairs], between, np.tile(covariance, (len(pairs), 1, 1)))


@pytest.fixture
def bound() -> Problem:
    """A problem whose keyframes are bound by odometry."""
    one = drive(2, seconds=20.0, noise=ImuNoise())
    relative = odometry(one.motion, np.arange(1.0, 19.0, 0.2))
    problem = pose_problem(one.imu, one.fixes, FRAME, SmootherSettings(), LEVER, None, relative)
    assert problem.is_bound
    return problem
