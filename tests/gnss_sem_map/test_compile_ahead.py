"""What a demo compiles is compiled by another process meanwhile, once, and nothing of that process stays."""

from __future__ import annotations

import multiprocessing
import tempfile
from pathlib import Path

import pytest
from processes import wait_until

from gnss_sem_map.cli.compile_ahead import compiled_ahead
from gnss_sem_map.scans.prefetch import THREADS_VARIABLE


@pytest.fixture
def kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where numba keeps what it compiles: nothing yet. The machine has two cores."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "kept"))
    monkeypatch.setenv(THREADS_VARIABLE, "2")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path / "kept"


@pytest.mark.slow
def test_kernels_of_the_last_stage_are_compiled(kept: Path) -> None:
    with compiled_ahead():
        [process] = multiprocessing.active_children()
        process.join(900.0)
        assert process.exitcode == 0
    compiled = {path.name.split("-")[0] for path in kept.rglob("*.nbi")}
    assert {"raycast.cast_ray", "kernels.fuse", "normals._upright", "render._draw"} <= compiled
    with compiled_ahead():
        assert not multiprocessing.active_children()


@pytest.mark.integration
def test_the_process_ends_with_the_context(kept: Path) -> None:
    with compiled_ahead():
        [process] = multiprocessing.active_children()
        assert wait_until(kept.exists, 300.0)
    assert not process.is_alive()
    assert list(kept.parent.iterdir()) == [kept]


@pytest.mark.parametrize(("name", "threads"), [("render._draw-1.py311.nbi", "2"), ("other.nbi", "1")])
def test_no_process_where_kernels_are_kept_or_on_one_core(
    kept: Path, name: str, threads: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(THREADS_VARIABLE, threads)
    (kept / "export_1").mkdir(parents=True)
    (kept / "export_1" / name).touch()
    with compiled_ahead():
        assert not multiprocessing.active_children()
