"""One heap for all threads, also of Arrow, in the process and in those that it starts; a user's choice stands."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

PROGRAM = """
import os, subprocess, sys
from gnss_sem_map.memory import share_one_heap
share_one_heap()
import pyarrow
told = "import os; print(os.environ['MALLOC_ARENA_MAX'], os.environ['ARROW_DEFAULT_MEMORY_POOL'])"
print(pyarrow.default_memory_pool().backend_name, subprocess.check_output([sys.executable, "-c", told], text=True))
"""


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


ARROW = """
import sys
from gnss_sem_map.memory import leave_pandas_out
leave_pandas_out()
import pyarrow
table = pyarrow.Table.from_pylist([{"number": 1}])
print("pandas" in sys.modules)
pandas = sys.modules.get("pandas") or __import__("pandas")
print(table.to_pandas().number.sum() + pyarrow.array(pandas.Series([2]))[0].as_py())
"""


@pytest.mark.integration
def test_arrow_does_not_import_pandas_but_works_with_it() -> None:
    pytest.importorskip("pandas")
    assert subprocess.check_output([sys.executable, "-c", ARROW], text=True).split() == ["False", "3"]
