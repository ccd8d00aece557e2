"""Tiles that are made as tasks: the same bytes wherever they run, and nothing is made twice after a kill."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from raw_street import BLOCKS, FRAME, SETTINGS, VOXELS, content, write_raw

from gnss_sem_map.config import Settings
from gnss_sem_map.errors import DataError
from gnss_sem_map.files.work_folder import TILES
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.mapping import refining, tile_tasks
from gnss_sem_map.mapping.raw_map import open_raw, write_sum
from gnss_sem_map.mapping.refining import Refined, refine_map
from gnss_sem_map.mapping.tile_tasks import on_blocks
from gnss_sem_map.process.execution import InProcess, Task
from gnss_sem_map.process.worker_processes import Processes
from gnss_sem_map.voxels.blocks import Block
from gnss_sem_map.voxels.tile_files import Tile

integration = pytest.mark.integration


@pytest.fixture
def small_tasks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tasks of about two tiles of the street."""
    monkeypatch.setattr(tile_tasks, "VOXELS_PER_TASK", len(VOXELS) // 3)


@pytest.fixture(scope="module")
def before(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Refined]:
    """The street, refined in this process; read only."""
    run = write_raw(tmp_path_factory.mktemp("street") / "run", scans=True)
    return run, refined(run)


def refined(run: Path, **how: Any) -> Refined:
    return refine_map(open_raw(run, open_label_set()), run, SETTINGS, **how)


def assert_same(run: Path, found: Refined, before: tuple[Path, Refined]) -> None:
    assert content(run / "refined") == content(before[0] / "refined")
    assert found.report.to_json() == before[1].report.to_json()
    assert found.kerbs is not None
    assert before[1].kerbs is not None
    for name in ("keys", "leaning", "known", "levels"):
        np.testing.assert_array_equal(getattr(found.kerbs, name), getattr(before[1].kerbs, name))


@integration
def test_processes_refine_to_the_same_bytes(
    before: tuple[Path, Refined], tmp_path: Path, small_tasks: None
) -> None:
    run = write_raw(tmp_path / "run", scans=True)
    told: list[tuple[str, int, int]] = []
    found = refined(run, executor=Processes(2), progress=lambda *counts: told.append(counts))
    assert_same(run, found, before)
    assert {stage: counts for stage, *counts in told} == {"figures": [7, 7], "refinement": [7, 7]}
    assert sorted(path.name for path in run.iterdir()) == ["evidence", "map", "refined"]


@integration
def test_processes_sum_drives_to_the_same_bytes(tmp_path: Path, small_tasks: None) -> None:
    drives = [write_raw(tmp_path / name) for name in ("a", "b")]
    for name, executor in (("here", InProcess()), ("there", Processes(2))):
        (tmp_path / name).mkdir()
        write_sum(drives, tmp_path / name, FRAME, executor=executor)
    assert content(tmp_path / "here/map") == content(tmp_path / "there/map")
    moved = "evidence/moved"
    assert content(tmp_path / "here" / moved) == content(tmp_path / "there" / moved)


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, Block]]:
    """What was computed in this process, for which block."""
    made: list[tuple[str, Block]] = []

    def watch(name: str, original: Callable[..., object]) -> Callable[..., object]:
        def watched(block: Block, *rest: object) -> object:
            made.append((name, block))
            return original(block, *rest)

        return watched

    for name in ("sums_of", "refine_block"):
        monkeypatch.setattr(refining, name, watch(name, getattr(refining, name)))
    return made


@pytest.mark.parametrize("damaged", ["1_0.parquet", "2_0.json"])
def test_what_an_interrupted_refinement_made_is_taken_over(
    damaged: str,
    before: tuple[Path, Refined],
    tmp_path: Path,
    calls: list[tuple[str, Block]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    run, work = write_raw(tmp_path / "run", scans=True), tmp_path / "work"
    original = refining.save

    def save(tile: Tile, *rest: Any) -> None:
        if tile == (4, 0):
            raise KeyboardInterrupt
        original(tile, *rest)

    with monkeypatch.context() as patch:
        patch.setattr(refining, "save", save)
        with pytest.raises(KeyboardInterrupt):
            refined(run, work=work)
    calls.clear()
    file = work / TILES / "refined" / damaged
    file.write_bytes(file.read_bytes()[:-1])
    found = refined(run, work=work)
    assert calls == [("refine_block", block) for block in BLOCKS[1:]]
    assert_same(run, found, before)


def test_other_settings_take_nothing_over(tmp_path: Path, calls: list[tuple[str, Block]]) -> None:
    run, work = write_raw(tmp_path / "run"), tmp_path / "work"
    others = Settings.model_validate({"refinement": {"free_space": {"enabled": False}}})
    refine_map(open_raw(run, open_label_set()), run, others, work=work)
    calls.clear()
    (run / "refined").rename(run / "earlier")
    refined(run, work=work)
    assert [name for name, _ in calls] == ["sums_of"] * len(BLOCKS) + ["refine_block"] * len(BLOCKS)


REFINE = """
import sys
from pathlib import Path
sys.path.insert(0, sys.argv[3])
from raw_street import SETTINGS
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.mapping.raw_map import open_raw
from gnss_sem_map.mapping.refining import refine_map

if __name__ == "__main__":
    run, work = map(Path, sys.argv[1:3])
    refine_map(open_raw(run, open_label_set()), run, SETTINGS, work=work)
"""


@integration
def test_after_a_kill_finished_blocks_are_not_refined_again(
    before: tuple[Path, Refined], tmp_path: Path, calls: list[tuple[str, Block]]
) -> None:
    run, work = write_raw(tmp_path / "run", scans=True), tmp_path / "work"
    tests = str(Path(__file__).parents[2])
    process = subprocess.Popen([sys.executable, "-c", REFINE, str(run), str(work), tests])
    done = work / TILES / "refined"
    while len(list(done.glob("[0-9]_0.json"))) < 2:
        assert process.poll() is None
        time.sleep(0.001)
    process.send_signal(signal.SIGKILL)
    process.wait()
    there = {(int(path.name[0]), 0) for path in done.glob("[0-9]_0.json")}
    found = refined(run, work=work)
    assert calls == [("refine_block", block) for block in BLOCKS if not there.issuperset(block)]
    assert_same(run, found, before)


def test_tasks_hold_neighbours_and_so_many_voxels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tile_tasks, "VOXELS_PER_TASK", 40)
    square = {(x, y): 10 for x in range(-4, 4) for y in range(-4, 4)}
    groups = tile_tasks._groups([(tile,) for tile in square], square)
    assert [len(group) for group in groups] == [4] * 16
    for group in groups:
        assert np.ptp([tile for (tile,) in group], axis=0).tolist() == [1, 1]
    large = {(0, 0): 100, (0, 1): 10, (0, 2): 10, (1, 2): 20}
    blocks = [((0, 0),), ((0, 1),), ((0, 2), (1, 2))]
    assert tile_tasks._groups(blocks, large) == [blocks[:1], blocks[1:]]


def test_one_task_is_done_in_this_process() -> None:
    class Unused:
        def run(self, tasks: Sequence[Task]) -> Iterator[tuple[Task, Any]]:
            raise AssertionError

    assert list(on_blocks("gnss_sem_map.x:y", (), {}, {}, Unused())) == []


def test_tiles_that_a_worker_saved_elsewhere_are_an_error(tmp_path: Path, small_tasks: None) -> None:
    class Elsewhere:
        def run(self, tasks: Sequence[Task]) -> Iterator[tuple[Task, object]]:
            yield from ((task, [None] * len(task.arguments[-1])) for task in tasks)

    drives = [write_raw(tmp_path / name) for name in ("a", "b")]
    (tmp_path / "out").mkdir()
    with pytest.raises(
        DataError, match=r"7 of 7 tiles .* such as 0_0.parquet; do all workers see this folder\?$"
    ):
        write_sum(drives, tmp_path / "out", FRAME, executor=Elsewhere())
