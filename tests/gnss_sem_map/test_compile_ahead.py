"""The list of kernels is that of a run, and compiling ahead ends with what it is for."""

from __future__ import annotations

import inspect
import multiprocessing
import signal
import sys
from pathlib import Path

import pytest
from numba.core.dispatcher import Dispatcher

from gnss_sem_map.cli import compile_ahead
from gnss_sem_map.cli.compile_ahead import compile_kernels, compiling_ahead, listed_kernels
from gnss_sem_map.cli.demo import demonstrate
from gnss_sem_map.cli.logs import STAGES


def test_every_listed_kernel_takes_so_many_arguments() -> None:
    listed = list(listed_kernels())
    assert len(listed) > 50
    for kernel, types in listed:
        inspect.signature(kernel.py_func).bind(*types)


def missed() -> set[str]:
    """The kernels of a run that were not on disk when this process needed them, with their types."""
    modules = [module for name, module in sys.modules.items() if name.startswith("gnss_sem_map.")]
    kernels = {one for module in modules for one in vars(module).values() if isinstance(one, Dispatcher)}
    return {
        f"{kernel.py_func.__module__} {kernel.py_func.__name__} {types}"
        for kernel in kernels
        if not kernel.py_func.__module__.startswith("gnss_sem_map.simulation.")
        for types in kernel.stats.cache_misses
    }


def missed_by_a_demo(out: Path) -> set[str]:
    """Those that are compiled by a demo, after the list."""
    compile_kernels()
    listed = missed()
    demonstrate(out, 3.0)
    return missed() - listed


@pytest.mark.slow
def test_a_demo_compiles_no_kernel_of_a_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", f"{tmp_path}/compiled")
    with multiprocessing.get_context("spawn").Pool(1) as fresh:
        assert fresh.apply(missed_by_a_demo, (tmp_path / "demo",)) == set(), "python benchmarks/kernels.py"


@pytest.mark.integration
def test_a_second_process_compiles_until_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compile_ahead, "cores", lambda: 2)
    with compiling_ahead() as compiler:
        assert compiler is not None
        assert compiler.poll() is None
    assert compiler.returncode == -signal.SIGTERM


def test_there_is_none_on_one_core(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compile_ahead, "cores", lambda: 1)
    with compiling_ahead() as compiler:
        assert compiler is None


@pytest.mark.integration
def test_the_log_says_why_nothing_is_compiled_ahead(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compile_ahead, "cores", lambda: 2)
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "1")
    said: list[str] = []
    monkeypatch.setattr(STAGES, "warning", lambda text, *values: said.append(text % values))
    with compiling_ahead() as compiler:
        assert compiler is not None
        compiler.wait()
    [line] = said
    assert "not ahead: AttributeError" in line
