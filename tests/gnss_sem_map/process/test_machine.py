"""Cores and memory that a process may use, and what it holds; how many workers that makes."""

from __future__ import annotations

import mmap
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from small_tasks import blas_threads
from threadpoolctl import threadpool_limits

from gnss_sem_map.cli.options import default_workers
from gnss_sem_map.mapping import passes
from gnss_sem_map.process import machine
from gnss_sem_map.process.machine import cores, held_bytes, memory_bytes, most_held_bytes, threads
from gnss_sem_map.scans.revisits import RevisitSettings


def test_threads_obey_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GNSS_SEM_MAP_THREADS", "3")
    assert threads() == 3
    for nonsense in ("", "0", "many", "-2"):
        monkeypatch.setenv("GNSS_SEM_MAP_THREADS", nonsense)
        assert threads() == cores()


def test_workers_are_one_fewer_than_the_cores_that_the_process_may_use(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(machine, "memory_bytes", lambda: 64 << 30)
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {2, 3, 5, 7}, raising=False)
    assert default_workers() == 3
    monkeypatch.delattr(os, "sched_getaffinity")  # as on macOS
    monkeypatch.setattr(os, "cpu_count", lambda: 8)
    assert default_workers() == 7
    assert threads() == 8


@pytest.mark.parametrize(("memory_gb", "workers"), [(16, 7), (8, 3), (2, 1), (0.5, 1)])
def test_workers_of_16_cores_have_2_gb_each(
    memory_gb: float, workers: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(16)), raising=False)
    monkeypatch.setattr(machine, "memory_bytes", lambda: int(memory_gb * (1 << 30)))
    assert default_workers() == workers


def test_a_container_has_the_memory_that_it_may_use(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    limit = tmp_path / "memory.max"
    monkeypatch.setattr("gnss_sem_map.process.machine.CONTAINER_MEMORY", limit)
    whole = memory_bytes()
    for text, expected in (("1000000\n", 1000000), ("max\n", whole), ("", whole)):
        limit.write_text(text)
        assert memory_bytes() == expected


def test_what_a_process_holds_grows_by_what_it_writes_and_never_exceeds_its_peak() -> None:
    before = held_bytes()
    written = np.frombuffer(mmap.mmap(-1, 64 << 20), np.uint8)  # not what others have freed
    written[:] = 1
    held = held_bytes()
    assert 63 << 20 <= held - before <= 80 << 20
    assert held_bytes(os.getpid()) - most_held_bytes() < 1 << 20  # the system counts pages in portions
    assert most_held_bytes() < memory_bytes()
    del written


@pytest.mark.integration
def test_a_process_that_has_ended_holds_nothing() -> None:
    with subprocess.Popen([sys.executable, "-c", ""]) as ended:
        pass
    assert held_bytes(ended.pid) == 0


def test_blas_has_one_thread_while_it_is_asked_for() -> None:
    with threadpool_limits(2, "blas"):
        with machine.one_blas_thread():
            assert set(blas_threads()) == {1}
        assert set(blas_threads()) == {2}


def test_drives_are_bound_with_one_thread_of_blas(monkeypatch: pytest.MonkeyPatch) -> None:
    # with two, the covariances of six drives that were bound had other last bits than with one
    found: list[int] = []

    class Asked(Exception):
        pass

    def register(*_: object) -> None:
        found.extend(blas_threads())
        raise Asked

    monkeypatch.setattr(passes, "register_passes", register)
    with threadpool_limits(2, "blas"), pytest.raises(Asked):
        passes.bind_passes([], RevisitSettings())
    assert set(found) == {1}


PROGRAM = """
from gnss_sem_map.cli import commands

def asked():
    import scipy.linalg
    from threadpoolctl import threadpool_info
    print({about["num_threads"] for about in threadpool_info() if about["user_api"] == "blas"})
    return 0

commands._called = asked
commands.main()
"""


@pytest.mark.integration
def test_a_command_has_one_thread_of_blas_whatever_its_environment_says() -> None:
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "2", "OMP_NUM_THREADS": "2"}
    said = subprocess.run([sys.executable, "-c", PROGRAM], env=environment, capture_output=True, text=True)
    assert (said.stdout, said.stderr) == ("{1}\n", "")
