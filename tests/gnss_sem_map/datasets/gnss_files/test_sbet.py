"""Positions of an SBET: its week and its accuracy."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from receivers import (
    LEAP_NS,
    read,
    sbet,
    week_seconds,
)
from ros import START_NS

from gnss_sem_map.datasets.gnss_files.time_systems import GPS_EPOCH_NS, WEEK_NS
from gnss_sem_map.errors import DataError


def test_an_sbet_finds_its_week_and_is_thinned(tmp_path: Path) -> None:
    path = sbet(tmp_path, week_seconds(START_NS + LEAP_NS) + np.arange(0, 2, 0.005))
    found = read(path, stddevs_m=(0.02, 0.02, 0.05))
    np.testing.assert_allclose(found.rows[:, 0], np.arange(20) * 0.1, atol=6e-3)
    np.testing.assert_allclose(found.rows[0, 1:7], [49.0, 8.4, 160.0, 0.02, 0.02, 0.05])


@pytest.mark.parametrize("name", ["out.sbet", "track.bin", "track.dat", "track.txt", "track"])
def test_an_sbet_is_one_by_its_content(tmp_path: Path, name: str) -> None:
    seconds = week_seconds(START_NS + LEAP_NS) + np.arange(0, 2, 0.005)
    rows = [read(sbet(tmp_path, seconds, one), stddevs_m=(1, 1, 1)).rows for one in ("plain.sbet", name)]
    assert len(rows[0]) == 20
    np.testing.assert_array_equal(*rows)


def test_an_sbet_needs_its_accuracy(tmp_path: Path) -> None:
    seconds = week_seconds(START_NS + LEAP_NS) + np.arange(0, 2, 0.005)
    path = sbet(tmp_path, seconds)
    with pytest.raises(DataError, match="tells no accuracy; set `accuracy:` to its smrmsg file"):
        read(path)
    errors = np.zeros((3, 10))
    errors[:, 0], errors[:, 1:4] = seconds[[0, 200, 399]], [0.1, 0.2, 0.3]
    errors.tofile(tmp_path / "smrmsg.out")
    np.testing.assert_allclose(read(path, accuracy="smrmsg.out").rows[:, 4:7], [[0.2, 0.1, 0.3]] * 20)


def test_other_bytes_are_no_sbet(tmp_path: Path) -> None:
    path = sbet(tmp_path, np.arange(0, 2, 0.01))
    path.write_bytes(path.read_bytes()[:-3])
    with pytest.raises(DataError, match="expected rows of 17 doubles; truncated"):
        read(path, stddevs_m=(1, 1, 1))
    np.random.default_rng(0).normal(0, 1e9, (10, 17)).tofile(path)
    with pytest.raises(DataError, match="no rising time of a week"):
        read(path, stddevs_m=(1, 1, 1))


@pytest.mark.parametrize("goes_on", [True, False])
@pytest.mark.parametrize("of_accuracy", [0.0, 400.0])
def test_an_sbet_over_the_end_of_a_week(tmp_path: Path, goes_on: bool, of_accuracy: float) -> None:
    """Its seconds begin anew, or go on; the file of its errors may begin earlier."""
    week = (START_NS + LEAP_NS - GPS_EPOCH_NS) // WEEK_NS + 1
    end_ns = GPS_EPOCH_NS + week * WEEK_NS - LEAP_NS  # of the week, Unix time
    seconds = WEEK_NS / 1e9 + np.arange(-2, 2, 0.05)
    errors = np.zeros((2, 10))
    errors[:, 0], errors[:, 1:4] = seconds[[0, -1]] + [-of_accuracy, of_accuracy], [0.1, 0.2, 0.3]
    if not goes_on:
        seconds, errors[:, 0] = seconds % (WEEK_NS / 1e9), errors[:, 0] % (WEEK_NS / 1e9)
    errors.tofile(tmp_path / "smrmsg.out")
    path, drive_ns = sbet(tmp_path, seconds), (end_ns - 2 * 10**9, end_ns + 2 * 10**9)
    found = read(path, drive_ns, accuracy="smrmsg.out")
    np.testing.assert_allclose(found.stamps_ns, drive_ns[0] + np.arange(40) * 1e8, atol=6e7)
    np.testing.assert_allclose(found.rows[:, 4:7], [[0.2, 0.1, 0.3]] * 40)
