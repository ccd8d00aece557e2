"""One short drive with small sensors, simulated once and looked at by many tests."""

from pathlib import Path

import numpy as np
import pytest
from made_once import made_once

from gnss_sem_map.simulation import Camera, Lidar, Simulation, prepare, simulate

SECONDS, SEED = 1.2, 0
CAMERA = Camera(414, 125, 240.5, 203.2, 57.6)


def small_lidar(range_stddev_m: float) -> Lidar:
    """24 rings of 300 columns."""
    return Lidar(np.radians(np.linspace(2.0, -24.0, 24)), columns=300, range_stddev_m=range_stddev_m)


@pytest.fixture(scope="session")
def town_drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A drive on disk."""

    def make(folder: Path) -> Path:
        return simulate(folder, SECONDS, SEED, lidar=small_lidar(0.02), camera=CAMERA, workers=2)

    return made_once(tmp_path_factory, "town", make)


@pytest.fixture(scope="session")
def simulation() -> Simulation:
    """What `town_drive` was written from."""
    return prepare(SECONDS, SEED, small_lidar(0.02), CAMERA)


@pytest.fixture(scope="session")
def whole_drive() -> Simulation:
    """The default drive of 30 s, with exact ranges; nothing is rendered."""
    return prepare(30.0, SEED, small_lidar(0.0), CAMERA)
