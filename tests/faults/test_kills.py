"""kill -9 at every change of the disk: the old result or the new one is there, and --resume gives the same bytes."""

from __future__ import annotations

import random
import shutil
import signal
from collections.abc import Callable
from pathlib import Path

import pytest
from chunks import assert_same, build_maps
from faults.harness import gnss_sem_map
from faults.killing import (
    command,
    content,
    killed_before_change,
    look_in,
    map_street,
    street_drive,
    write_result,
    write_run_like,
)
from street import Street

from gnss_sem_map.files.ownership import MARKER, is_partial
from gnss_sem_map.mapping.checkpoints import REMOVED, STATIC
from gnss_sem_map.mapping.fusion import map_scans
from gnss_sem_map.process.run_stats import RunStats

OLD = {
    "run.json": "{}",
    "map.laz": "old",
    "map/map.json": "old",
    "map/0_0.parquet": "old",
    "labels/0.label": "",
}
NEW = {"run.json": "{1}", "map.ply": "new", "map/map.json": "new", "refined/map.json": "new"}
MOST_CHANGES = 1000


def told(folder: Path) -> dict[str, str]:
    """The files of a result, but for the list of them, and the beginning of a new one."""
    return {name: look for name, look in content(folder).items() if name != MARKER and not is_partial(name)}


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, str], dict[str, str]]:
    """An old result, and what the files of the old and of the new one are."""
    folder = tmp_path_factory.mktemp("results")
    write_result(folder / "old", OLD)
    write_result(folder / "new", NEW)
    return folder / "old", told(folder / "old"), told(folder / "new")


def neighbours(folder: Path) -> dict[str, str]:
    """Files of somebody else, with names as ours."""
    for name in (
        ".out.part/thesis.txt",
        "out.work/thesis.txt",
        ".other.work/thesis.txt",
        "out.old/thesis.txt",
    ):
        (folder / name).parent.mkdir(parents=True)
        (folder / name).write_text("important")
    return content(folder)


@pytest.mark.parametrize("listed", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_a_result_is_replaced_whole_whenever_it_is_killed(
    results, listed: bool, trial, tmp_path: Path
) -> None:
    old, was, becomes = results
    seen = set()
    for number in range(1, MOST_CHANGES):
        folder = tmp_path / f"{number}"
        foreign = neighbours(folder)
        shutil.copytree(old, folder / "out")
        if not listed:
            (folder / "out" / MARKER).unlink()
        died = killed_before_change(number, folder, write_run_like, folder / "out", NEW)
        there = told(folder / "out") if (folder / "out").exists() else None
        faults = [] if there in (None, was, becomes) else [f"half a result at change {number}"]
        look_in(folder / "out")
        there = told(folder / "out")
        faults += [] if there in (was, becomes) else [f"not whole after the next command, at change {number}"]
        seen.add(there == was)
        write_run_like(folder / "out", NEW)
        faults += [] if told(folder / "out") == becomes else [f"not replaced at change {number}"]
        shutil.rmtree(folder / "out")
        faults += [] if content(folder) == foreign else [f"left or lost beside it: {content(folder)}"]
        trial("kill at a swap", faults)
        if not died:
            break
    assert number > 20, "too few moments: nothing was shown"
    assert seen == {True, False}


@pytest.mark.faults
def test_the_command_that_puts_it_right_may_be_killed_too(results, trial, tmp_path: Path) -> None:
    old, was, becomes = results
    for first in range(8, MOST_CHANGES, 2):
        for second in range(1, MOST_CHANGES, 2):
            folder = tmp_path / f"{first}.{second}"
            folder.mkdir()
            shutil.copytree(old, folder / "out")
            first_died = killed_before_change(first, folder, write_result, folder / "out", NEW)
            second_died = killed_before_change(second, folder, look_in, folder / "out")
            look_in(folder / "out")
            there = told(folder / "out")
            trial("kill twice at a swap", [] if there in (was, becomes) else ["not whole"], (first, second))
            left = [path.name for path in folder.iterdir() if path.name != "out"]
            assert left == []
            shutil.rmtree(folder)
            if not second_died:
                break
        if not first_died:
            break


def assert_same_chunks(small_drive: Street, work: Path, at_once) -> None:
    drive, stats = street_drive(small_drive.drive, small_drive.labels), RunStats()
    store = map_scans(drive, work, stats, resume=True)
    for layer, expected in ((STATIC, at_once[0].static), (REMOVED, at_once[0].removed)):
        found = store.whole(layer)
        assert_same(found, expected)
    assert stats.counts == at_once[1].counts
    assert not list(work.glob(".*.*.*"))


@pytest.fixture(scope="module")
def at_once(small_drive: Street):
    stats = RunStats()
    return build_maps(street_drive(small_drive.drive, small_drive.labels), stats), stats


@pytest.mark.parametrize(
    "step", [pytest.param(17, marks=pytest.mark.slow), pytest.param(2, marks=pytest.mark.faults)]
)
def test_a_mapping_that_is_killed_goes_on_to_the_same_bytes(
    small_drive: Street, at_once, step: int, trial: Callable[..., None], tmp_path: Path
) -> None:
    for number in range(1, MOST_CHANGES, step):
        work = tmp_path / f"work{number}"
        died = killed_before_change(number, work, map_street, small_drive.drive, small_drive.labels, work)
        assert_same_chunks(small_drive, work, at_once)
        trial("kill while mapping")
        if not died:
            break
    assert number > 30


def clear_work(work: Path) -> None:
    from gnss_sem_map.files import work_folder

    work_folder.clear(work)


@pytest.mark.parametrize(
    "step", [pytest.param(7, marks=pytest.mark.slow), pytest.param(1, marks=pytest.mark.faults)]
)
def test_a_clean_up_that_is_killed_is_not_mistaken_for_work(
    small_drive: Street, at_once, step: int, trial: Callable[..., None], tmp_path: Path
) -> None:
    map_street(small_drive.drive, small_drive.labels, tmp_path / "mapped")
    for number in range(1, MOST_CHANGES, step):
        work = tmp_path / f"work{number}"
        shutil.copytree(tmp_path / "mapped", work)
        died = killed_before_change(number, work, clear_work, work)
        assert_same_chunks(small_drive, work, at_once)
        trial("kill while cleaning up")
        shutil.rmtree(work)
        if not died:
            break
    assert number > 15


def run_words(small_drive: Street, out: Path, *more: str) -> tuple[str, ...]:
    labels = f"labels:{small_drive.labels}"
    chunks = ("--set", "dynamics.window_scans=2", "--write-labels")
    return ("run", str(small_drive.drive), "--segmenter", labels, "-o", str(out), *chunks, *more)


def results_of(out: Path) -> dict[str, str]:
    """What a run must give again, byte for byte."""
    names = ("map/", "refined/", "labels", "removed/", "confidence/", "trajectory", "map.ply", "config.yaml")
    return {name: look for name, look in content(out).items() if name.startswith(names)}


@pytest.fixture(scope="module")
def whole(small_drive: Street, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    folder = tmp_path_factory.mktemp("whole")
    done = gnss_sem_map(*run_words(small_drive, folder / "out"), folder=folder / "trial")
    assert done.code == 0, done
    assert sorted(path.name for path in folder.iterdir()) == ["out", "trial"]
    return results_of(folder / "out")


def kill_a_run(small_drive: Street, whole, trial, folder: Path, after_s: float) -> None:
    """Killed, then resumed, and killed again, and at last left alone."""
    words, faults = run_words(small_drive, folder / "out", "--resume"), []
    for number, moment in enumerate((after_s, after_s / 2)):
        interrupt = (moment, signal.SIGKILL)
        outcome = gnss_sem_map(*words, folder=folder / f"trial{number}", interrupt=interrupt)
        faults += [f"left {outcome.left}"] * bool(outcome.left) + ["orphans"] * outcome.orphans
        if (folder / "out").exists():
            faults += ["another result"] * (results_of(folder / "out") != whole)
    outcome = gnss_sem_map(*words, folder=folder / "last")
    faults += [*outcome.faults, *["another result"] * (results_of(folder / "out") != whole)]
    beside = sorted(path.name for path in folder.iterdir() if not path.name.startswith(("trial", "last")))
    faults += [f"left beside: {beside}"] * (beside != ["out"])
    trial("kill a run", faults, outcome)


@pytest.mark.faults
def test_runs_killed_at_random_moments_and_resumed_give_the_same_bytes(
    small_drive, whole, trial, tmp_path: Path
) -> None:
    chance = random.Random(18)
    for number in range(8):
        (tmp_path / f"{number}").mkdir()
        kill_a_run(small_drive, whole, trial, tmp_path / f"{number}", chance.uniform(0.5, 6.0))


@pytest.mark.faults
def test_a_run_killed_while_it_finishes_and_resumed_gives_the_same_bytes(
    small_drive, whole, trial, tmp_path: Path
) -> None:
    """Over an older result, whose place the new one takes: the older one is removed, and then what was mapped."""
    for number in (150, 180, 200, 210, 220, 230, 240, 250, 260, 270, 290, 310):
        out = tmp_path / f"{number}" / "out"
        write_result(out, OLD)
        words = run_words(small_drive, out)
        died = killed_before_change(number, tmp_path, command, words)
        resumed = gnss_sem_map(*words, "--resume", folder=tmp_path / f"trial{number}")
        faults = [*resumed.faults, *["another result"] * (results_of(out) != whole)]
        faults += ["left beside"] * (len(list(out.parent.iterdir())) != 1)
        trial("kill a finishing run", faults, resumed)
        if not died:
            break
