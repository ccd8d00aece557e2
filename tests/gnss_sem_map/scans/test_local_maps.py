"""Places of a track, and the sweeps nearest to them."""

import tracemalloc
from types import SimpleNamespace

import numpy as np

from factor_graphs.trajectory import Trajectory
from gnss_sem_map.scans.local_maps import LocalMaps, nearest, sweeps_along


def test_the_nearest_value_is_the_first_of_equal_ones_as_a_search_of_all_finds_it() -> None:
    rng = np.random.default_rng(1)
    for count in (1, 2, 50):
        values = np.sort(rng.integers(0, 20, count)).astype(float)  # with many that are equal
        wanted = np.concatenate([rng.uniform(-5.0, 25.0, 200), values, values + 0.5])
        expected = np.abs(values[None] - wanted[:, None]).argmin(axis=1)
        np.testing.assert_array_equal(nearest(values, wanted), expected)


def memory_of(scans: int) -> int:
    stamps, T = np.arange(scans) * 0.1, np.tile(np.eye(4), (scans, 1, 1))
    T[:, 0, 3] = 1.4 * np.arange(scans)
    log = SimpleNamespace(
        scans=[SimpleNamespace(stamp=stamp) for stamp in stamps.tolist()],
        calibration=SimpleNamespace(T_imu_lidar=np.eye(4)),
    )
    trajectory = Trajectory(stamps, T)
    tracemalloc.start()
    LocalMaps(sweeps_along(log, trajectory), trajectory, stamps[::7])
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return most


def test_memory_grows_with_the_drive_not_with_its_square() -> None:
    assert memory_of(8000) < 4.5 * memory_of(2000)
