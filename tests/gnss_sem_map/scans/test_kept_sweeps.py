"""Sweeps that are handed over from one stage to the next: the same points, read once."""

from __future__ import annotations

from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
import pytest

from factor_graphs.trajectory import Trajectory
from gnss_sem_map.errors import DataError
from gnss_sem_map.scans import kept_sweeps
from gnss_sem_map.scans.kept_sweeps import KeptSweeps
from gnss_sem_map.sensor_log import Calibration, Points, Scan, SensorLog


class Files:
    """A log of five sweeps, and how often each was read."""

    def __init__(self) -> None:
        self.reads: Counter[int] = Counter()
        scans = [Scan(f"{i}", i, 0.1 * i, partial(self.read, i)) for i in range(5)]
        standing = Trajectory(np.array([0.0, 1.0]), np.tile(np.eye(4), (2, 1, 1)))
        self.log = SensorLog("drive", 0, Calibration(np.eye(4)), tuple(scans), (), given=standing)

    def read(self, number: int) -> Points:
        self.reads[number] += 1
        if number == 4:
            raise DataError("4.bin: truncated scan")
        return Points(np.full((3, 3), number, np.float32), np.zeros(3, np.float32), None)


@pytest.fixture
def files() -> Files:
    return Files()


def test_what_one_stage_has_read_the_next_one_takes(files: Files) -> None:
    sweeps = KeptSweeps()
    first, second = sweeps.keeping(files.log), sweeps.taking(files.log)
    for number in (2, 0, 2):
        assert first.scans[number].read().xyz[0, 0] == number
    assert [scan.read().xyz[0, 0] for scan in second.scans[:4]] == [0, 1, 2, 3]
    assert files.reads == {0: 1, 1: 1, 2: 1, 3: 1}
    second.scans[2].read()
    assert files.reads[2] == 2  # it is kept no longer


def test_a_sweep_that_cannot_be_read_is_an_error_in_both_stages(files: Files) -> None:
    sweeps = KeptSweeps()
    for log in (sweeps.keeping(files.log), sweeps.taking(files.log)):
        with pytest.raises(DataError, match="truncated"):
            log.scans[4].read()


def test_threads_that_want_the_same_sweep_read_it_once(files: Files) -> None:
    log = KeptSweeps().keeping(files.log)
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda _: log.scans[1].read(), range(50)))
    assert files.reads == {1: 1}


def test_what_nobody_takes_can_be_let_go(files: Files) -> None:
    sweeps = KeptSweeps()
    sweeps.keeping(files.log).scans[1].read()
    sweeps.forget()
    assert sweeps.taking(files.log).scans[1].read().xyz[0, 0] == 1
    assert files.reads == {1: 2}


def test_memory_is_bounded(files: Files, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kept_sweeps, "MOST_KEPT", 2)
    sweeps = KeptSweeps()
    for log in (sweeps.keeping(files.log), sweeps.taking(files.log)):
        for scan in log.scans[:3]:
            scan.read()
    assert files.reads == {0: 1, 1: 1, 2: 2}
