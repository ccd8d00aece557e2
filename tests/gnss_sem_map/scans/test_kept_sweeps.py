"""Sweeps that are handed over from one stage to the next: the same points, read once."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import pytest
from counted_reads import DAMAGED, five_sweeps

from gnss_sem_map.errors import DataError
from gnss_sem_map.scans import kept_sweeps
from gnss_sem_map.scans.kept_sweeps import KeptSweeps


def test_what_one_stage_has_read_the_next_one_takes() -> None:
    log, reads = five_sweeps()
    sweeps = KeptSweeps()
    first, second = sweeps.keeping(log), sweeps.taking(log)
    for number in (2, 0, 2):
        assert first.scans[number].read().xyz[0, 0] == number
    assert [scan.read().xyz[0, 0] for scan in second.scans[:4]] == [0, 1, 2, 3]
    assert reads == {0: 1, 1: 1, 2: 1, 3: 1}
    second.scans[2].read()
    assert reads[2] == 2  # it is kept no longer


def test_a_sweep_that_cannot_be_read_is_an_error_in_both_stages() -> None:
    log, _ = five_sweeps()
    sweeps = KeptSweeps()
    for stage in (sweeps.keeping(log), sweeps.taking(log)):
        with pytest.raises(DataError, match="truncated"):
            stage.scans[DAMAGED].read()


def test_threads_that_want_the_same_sweep_read_it_once() -> None:
    log, reads = five_sweeps()
    kept = KeptSweeps().keeping(log)
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda _: kept.scans[1].read(), range(50)))
    assert reads == {1: 1}


def test_what_nobody_takes_can_be_let_go() -> None:
    log, reads = five_sweeps()
    sweeps = KeptSweeps()
    sweeps.keeping(log).scans[1].read()
    sweeps.forget()
    assert sweeps.taking(log).scans[1].read().xyz[0, 0] == 1
    assert reads == {1: 2}


def test_memory_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    log, reads = five_sweeps()
    monkeypatch.setattr(kept_sweeps, "MOST_KEPT", 2)
    sweeps = KeptSweeps()
    for stage in (sweeps.keeping(log), sweeps.taking(log)):
        for scan in stage.scans[:3]:
            scan.read()
    assert reads == {0: 1, 1: 1, 2: 2}
