"""Sweeps that are thinned and saved when they are first read: the same points, and the file is not read again."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from counted_reads import DAMAGED, TIMED, five_sweeps, points_of

from gnss_sem_map.errors import DataError
from gnss_sem_map.scans.thinned_sweeps import ThinnedSweeps
from gnss_sem_map.sensor_log import Points, SensorLog


def every_fifth(points: Points) -> Points:
    return points[np.arange(len(points.xyz)) % 5 == 0]


def assert_same(found: Points, expected: Points) -> None:
    np.testing.assert_array_equal(found.rows, expected.rows)
    assert (found.stamps is None) == (expected.stamps is None)
    if found.stamps is not None and expected.stamps is not None:
        np.testing.assert_array_equal(found.stamps, expected.stamps)


def sweeps_of(log: SensorLog, folder: Path | None, use: str = "some") -> ThinnedSweeps:
    return ThinnedSweeps(log, use, every_fifth, frozenset({1, TIMED, DAMAGED}), folder)


def test_what_one_stage_has_read_another_one_takes_bit_for_bit(tmp_path: Path) -> None:
    log, reads = five_sweeps()
    for scan in sweeps_of(log, tmp_path).listening().scans[:DAMAGED]:
        assert_same(scan.read(), points_of(scan.number))
    reads.clear()
    later = sweeps_of(log, tmp_path)  # as of another process
    for number in (1, TIMED, 1):
        assert_same(later[number], every_fifth(points_of(number)))
    assert not reads
    assert sorted(path.name for path in tmp_path.iterdir()) == ["1.some.npz", f"{TIMED}.some.npz"]


def test_what_is_forgotten_is_read_again(tmp_path: Path) -> None:
    log, reads = five_sweeps()
    sweeps, other = sweeps_of(log, tmp_path), sweeps_of(log, tmp_path, "other")
    _ = sweeps[1], other[1]
    sweeps.forget()
    assert [path.name for path in tmp_path.iterdir()] == ["1.other.npz"]
    reads.clear()
    assert_same(sweeps[1], other[1])
    assert reads == {1: 1}
    sweeps_of(log, None).forget()


def test_who_needs_a_sweep_first_reads_and_saves_it(tmp_path: Path) -> None:
    log, reads = five_sweeps()
    for _ in range(3):
        assert_same(sweeps_of(log, tmp_path)[1], every_fifth(points_of(1)))
    assert reads == {1: 1}


def test_one_reading_saves_a_sweep_for_all_its_uses(tmp_path: Path) -> None:
    log, reads = five_sweeps()
    first = sweeps_of(log, tmp_path, "first")
    second = replace(first, log=first.listening(), use="second")
    assert_same(second[1], first[1])
    assert reads == {1: 1}


def test_other_sweeps_are_not_saved(tmp_path: Path) -> None:
    log, reads = five_sweeps()
    sweeps = sweeps_of(log, tmp_path)
    for _ in range(2):
        assert_same(sweeps[2], every_fifth(points_of(2)))
    assert reads == {2: 2}
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("damage", [b"", b"no archive", None])
def test_a_damaged_file_is_read_again_from_the_drive(tmp_path: Path, damage: bytes | None) -> None:
    log, reads = five_sweeps()
    sweeps = sweeps_of(log, tmp_path)
    assert_same(sweeps[1], sweeps[1])
    (file,) = tmp_path.iterdir()
    file.write_bytes(file.read_bytes()[:-40] if damage is None else damage)
    assert_same(sweeps[1], every_fifth(points_of(1)))
    assert reads == {1: 2}


def test_a_sweep_that_cannot_be_read_is_an_error_for_each(tmp_path: Path) -> None:
    log, _ = five_sweeps()
    sweeps = sweeps_of(log, tmp_path)
    for read in (sweeps.listening().scans[DAMAGED].read, partial(sweeps.__getitem__, DAMAGED)):
        with pytest.raises(DataError, match="truncated"):
            read()
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("folder", [None, "nowhere"])
def test_without_a_folder_sweeps_are_read_each_time(tmp_path: Path, folder: str | None) -> None:
    log, reads = five_sweeps()
    sweeps = sweeps_of(log, folder and tmp_path / folder)
    assert_same(sweeps.listening().scans[1].read(), points_of(1))
    assert_same(sweeps[1], every_fifth(points_of(1)))
    assert reads == {1: 2}
    assert not list(tmp_path.iterdir())
