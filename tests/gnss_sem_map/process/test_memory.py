"""One heap for all threads, also of Arrow; a user's choice stands. Much freed memory goes back, or is kept."""

from __future__ import annotations

import ctypes
import os
import resource
import subprocess
import sys

import pytest

PROGRAM = """
import os, subprocess, sys
from gnss_sem_map.process.memory import share_one_heap
share_one_heap()
import pyarrow
told = "import os; print(os.environ['MALLOC_ARENA_MAX'], os.environ['ARROW_DEFAULT_MEMORY_POOL'])"
print(pyarrow.default_memory_pool().backend_name, subprocess.check_output([sys.executable, "-c", told], text=True))
"""

FREED_BETWEEN_OTHERS = """
from gnss_sem_map.process.machine import held_bytes
from gnss_sem_map.process.memory import release_memory, share_one_heap
share_one_heap()
import numpy as np

def one_of_sixteen(count):
    return [np.ones(1 << 17) for _ in range(count)][::16]

release_memory(always=True)
start, kept = held_bytes(), []
for count, always in ((32, False), (32, True), (160, False)):
    kept += one_of_sixteen(count)
    before = held_bytes()
    release_memory(always)
    print((before - start) >> 20, (held_bytes() - start) >> 20)
"""

LARGE_ARRAYS = """
import resource
from gnss_sem_map.process.machine import held_bytes
from gnss_sem_map.process.memory import release_memory, reuse_memory, share_one_heap
share_one_heap()

def new_pages():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(10):
        bytearray(b"x") * (6 << 20)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

each_anew = new_pages()
reuse_memory()
new_pages()
kept = new_pages()
before = held_bytes()
release_memory(always=True)
print(each_anew, kept, (before - held_bytes()) >> 20)
"""

only_glibc = pytest.mark.skipif(
    not hasattr(ctypes.CDLL(None), "malloc_trim"), reason="only glibc returns memory when asked"
)


@pytest.mark.integration
@only_glibc
@pytest.mark.parametrize(
    ("chosen", "are_kept"),
    [({}, True), ({"MALLOC_MMAP_THRESHOLD_": "1000000"}, False)],
    ids=["ours", "a user's"],
)
def test_large_arrays_use_memory_again_until_it_is_released(chosen: dict[str, str], are_kept: bool) -> None:
    """Ten arrays of 6 MB, one after the other: pages that the system hands out, and MB that go back in the end."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("MALLOC_")}
    said = subprocess.check_output([sys.executable, "-c", LARGE_ARRAYS], text=True, env=environment | chosen)
    each_anew, later, returned = map(int, said.split())
    pages = 10 * (6 << 20) // resource.getpagesize()
    assert each_anew >= pages
    assert (later <= 100, returned >= 3) == (are_kept, are_kept)
    assert are_kept or later >= pages


@pytest.mark.integration
@only_glibc
def test_freed_memory_between_other_objects_goes_back_once_it_is_much() -> None:
    """MB held before and after: little stays, unless all of it is to go back; much goes back."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("MALLOC_")}
    said = subprocess.check_output([sys.executable, "-c", FREED_BETWEEN_OTHERS], text=True, env=environment)
    (little, stayed), (again, returned), (much, left) = (map(int, line.split()) for line in said.splitlines())
    assert little >= 30
    assert stayed >= little - 1
    assert again >= 30
    assert returned <= 10
    assert much >= 150
    assert left <= 25


@pytest.mark.integration
@pytest.mark.parametrize(
    ("chosen", "expected"),
    [
        ({}, ["system", "1", "system"]),
        ({"MALLOC_ARENA_MAX": "4"}, ["system", "4", "system"]),
        ({"ARROW_DEFAULT_MEMORY_POOL": "mimalloc"}, ["mimalloc", "1", "mimalloc"]),
    ],
)
def test_all_threads_use_one_heap(chosen: dict[str, str], expected: list[str]) -> None:
    ours = ("MALLOC_ARENA_MAX", "ARROW_DEFAULT_MEMORY_POOL")
    environment = {name: value for name, value in os.environ.items() if name not in ours}
    said = subprocess.check_output([sys.executable, "-c", PROGRAM], text=True, env=environment | chosen)
    assert said.split() == expected
