"""Sweeps that are thinned and saved when they are first read: the same points, and the file is not read again."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from factor_graphs.trajectory import Trajectory
from gnss_sem_map.errors import DataError
from gnss_sem_map.scans.thinned_sweeps import ThinnedSweeps
from gnss_sem_map.sensor_log import Calibration, Points, Scan, SensorLog

IS_TIMED = 3
"""The sweep whose points have stamps."""
DAMAGED = 4


class Files:
    """A log of five sweeps, and how often each was read."""

    def __init__(self) -> None:
        self.reads: Counter[int] = Counter()
        scans = [Scan(f"{i}", i, 0.1 * i, partial(self.read, i)) for i in range(5)]
        standing = Trajectory(np.array([0.0, 1.0]), np.tile(np.eye(4), (2, 1, 1)))
        self.log = SensorLog("drive", 0, Calibration(np.eye(4)), tuple(scans), (), given=standing)

    def read(self, number: int) -> Points:
        self.reads[number] += 1
        if number == DAMAGED:
            raise DataError("4.bin: truncated scan")
        random = np.random.default_rng(number)
        rows = random.uniform(-80.0, 80.0, (60, 4)).astype(np.float32)
        stamps = np.sort(random.uniform(0.0, 0.1, 60)) if number == IS_TIMED else None
        return Points(rows[:, :3], rows[:, 3], stamps)


def every_fifth(points: Points) -> Points:
    return points[np.arange(len(points.xyz)) % 5 == 0]


def assert_same(found: Points, expected: Points) -> None:
    np.testing.assert_array_equal(found.rows, expected.rows)
    assert (found.stamps is None) == (expected.stamps is None)
    if found.stamps is not None and expected.stamps is not None:
        np.testing.assert_array_equal(found.stamps, expected.stamps)


@pytest.fixture
def files() -> Files:
    return Files()


def sweeps_of(files: Files, folder: Path | None, use: str = "some") -> ThinnedSweeps:
    return ThinnedSweeps(files.log, use, every_fifth, frozenset({1, IS_TIMED, DAMAGED}), folder)


def test_what_one_stage_has_read_another_one_takes_bit_for_bit(files: Files, tmp_path: Path) -> None:
    for scan in sweeps_of(files, tmp_path).listening().scans[:DAMAGED]:
        assert_same(scan.read(), files.read(scan.number))
    files.reads.clear()
    later = sweeps_of(files, tmp_path)  # as of another process
    for number in (1, IS_TIMED, 1):
        assert_same(later[number], every_fifth(Files().read(number)))
    assert not files.reads
    assert sorted(path.name for path in tmp_path.iterdir()) == ["1.some.npz", f"{IS_TIMED}.some.npz"]


def test_what_is_forgotten_is_read_again(files: Files, tmp_path: Path) -> None:
    sweeps, other = sweeps_of(files, tmp_path), sweeps_of(files, tmp_path, "other")
    _ = sweeps[1], other[1]
    sweeps.forget()
    assert [path.name for path in tmp_path.iterdir()] == ["1.other.npz"]
    files.reads.clear()
    assert_same(sweeps[1], other[1])
    assert files.reads == {1: 1}
    sweeps_of(files, None).forget()


def test_who_needs_a_sweep_first_reads_and_saves_it(files: Files, tmp_path: Path) -> None:
    for _ in range(3):
        assert_same(sweeps_of(files, tmp_path)[1], every_fifth(Files().read(1)))
    assert files.reads == {1: 1}


def test_one_reading_saves_a_sweep_for_all_its_uses(files: Files, tmp_path: Path) -> None:
    first = sweeps_of(files, tmp_path, "first")
    second = replace(first, log=first.listening(), use="second")
    assert_same(second[1], first[1])
    assert files.reads == {1: 1}


def test_other_sweeps_are_not_saved(files: Files, tmp_path: Path) -> None:
    sweeps = sweeps_of(files, tmp_path)
    for _ in range(2):
        assert_same(sweeps[2], every_fifth(Files().read(2)))
    assert files.reads == {2: 2}
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("damage", [b"", b"no archive", None])
def test_a_damaged_file_is_read_again_from_the_drive(
    files: Files, tmp_path: Path, damage: bytes | None
) -> None:
    sweeps = sweeps_of(files, tmp_path)
    assert_same(sweeps[1], sweeps[1])
    (file,) = tmp_path.iterdir()
    file.write_bytes(file.read_bytes()[:-40] if damage is None else damage)
    assert_same(sweeps[1], every_fifth(Files().read(1)))
    assert files.reads == {1: 2}


def test_a_sweep_that_cannot_be_read_is_an_error_for_each(files: Files, tmp_path: Path) -> None:
    sweeps = sweeps_of(files, tmp_path)
    for read in (sweeps.listening().scans[DAMAGED].read, partial(sweeps.__getitem__, DAMAGED)):
        with pytest.raises(DataError, match="truncated"):
            read()
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("folder", [None, "nowhere"])
def test_without_a_folder_sweeps_are_read_each_time(files: Files, tmp_path: Path, folder: str | None) -> None:
    sweeps = sweeps_of(files, folder and tmp_path / folder)
    assert_same(sweeps.listening().scans[1].read(), Files().read(1))
    assert_same(sweeps[1], every_fifth(Files().read(1)))
    assert files.reads == {1: 2}
    assert not list(tmp_path.iterdir())
