"""What was stopped goes on, or is made again where it is damaged; what was finished is not done twice."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any, NoReturn

import pytest
import street_drives
from commands import gnss_sem_map
from damage import flipped, halved
from maps_of_drives import SETTINGS, assert_same, mapped, products, run_of
from street_drives import Drives

from factor_graphs.geodesy import LocalFrame
from gnss_sem_map.config import Settings
from gnss_sem_map.datasets import open_drive
from gnss_sem_map.errors import DataError
from gnss_sem_map.files import work_folder
from gnss_sem_map.files.output_folder import RESUMABLE
from gnss_sem_map.files.ownership import CONTENT_BYTES, write_list
from gnss_sem_map.mapping.fusion import store_of
from gnss_sem_map.mapping.labelled_scans import Drive
from gnss_sem_map.process.execution import Task, path_of
from gnss_sem_map.process.worker_processes import Processes
from gnss_sem_map.runs import drive_tasks, finished_run, many_drives, pipeline, run_folder
from gnss_sem_map.runs.binding import bind
from gnss_sem_map.runs.drive_job import DriveJob, closing_drives, job_for
from gnss_sem_map.runs.many_drives import HowMapped, add_drive, remove_drive, run_drives
from gnss_sem_map.runs.map_job import MapJob
from gnss_sem_map.runs.source import source_of

KILLED_BY_ITSELF = """
import os, signal, sys

def look(event, details):
    place = os.fsdecode(details[1]) if event == "os.rename" else ""
    folder, _, name = place.rpartition("/")
    if folder.endswith("/drives") and name == "b":  # its map is put away
        os.kill(os.getpid(), signal.SIGKILL)

sys.addaudithook(look)
from gnss_sem_map.cli import main
main()
"""


def test_a_run_that_is_killed_in_its_second_drive_is_resumed_there(
    made: dict[str, Path], drives: Drives, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    words = run_of([drives.by_name["a"], drives.by_name["b"]], drives, out, "--workers", "1")
    died = subprocess.run([sys.executable, "-c", KILLED_BY_ITSELF, *map(str, words)], check=False)
    assert died.returncode == -signal.SIGKILL
    assert not out.exists()
    first = (tmp_path / ".out.work/drives/a/run.json").stat()
    assert not (tmp_path / ".out.work/drives/b/run.json").exists()
    done = gnss_sem_map(*words, "--resume")
    assert done.returncode == 0, done.stderr
    assert os.path.samestat((out / "drives/a/run.json").stat(), first), "the finished drive is mapped again"
    assert_same(out, made["ab"])
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def stopped(*_: object, **__: object) -> NoReturn:
    raise KeyboardInterrupt


def stop_of(run: Callable[[], object], module: ModuleType, name: str) -> KeyboardInterrupt:
    """How a run ends that is stopped where it calls this function."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, name, stopped)
        with pytest.raises(KeyboardInterrupt) as stopping:
            run()
    return stopping.value


@pytest.mark.slow
def test_a_run_that_is_stopped_in_its_first_drive_keeps_the_chunks(
    made: dict[str, Path], drives: Drives, how: HowMapped, tmp_path: Path
) -> None:
    out, chunk = tmp_path / "out", tmp_path / ".out.work/drives/.a.work/0"
    ended = stop_of(lambda: mapped("ab", drives, out, how), drive_tasks, "_put")
    assert ended.__notes__ == [RESUMABLE.format(tmp_path / ".out.work")]
    there = (chunk / "record.json").stat()
    stop_of(lambda: mapped("ab", drives, out, replace(how, resume=True)), drive_tasks, "_put")
    assert os.path.samestat((chunk / "record.json").stat(), there), "the chunk is mapped again"
    mapped("ab", drives, out, replace(how, resume=True))
    assert_same(out, made["ab"])
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def calls_of_the_pipeline(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the drives that are mapped from now on."""
    calls, original = [], drive_tasks.write_map

    def watched(drive: Drive, *rest: Any) -> None:
        calls.append(drive.log.name)
        original(drive, *rest)

    monkeypatch.setattr(drive_tasks, "write_map", watched)
    return calls


@pytest.mark.slow
def test_adding_that_was_stopped_leaves_the_map_and_is_resumed(
    made: dict[str, Path], drives: Drives, how: HowMapped, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, calls = shutil.copytree(made["ab"], tmp_path / "out"), calls_of_the_pipeline(monkeypatch)
    stop_of(lambda: remove_drive(out, "b"), many_drives, "write_drives")
    assert [path.name for path in tmp_path.iterdir()] == ["out"], "no drive was to be mapped again"
    adding = stop_of(lambda: add_drive(out, drives.by_name["c"], how), many_drives, "write_drives")
    assert adding.__notes__ == [RESUMABLE.format(tmp_path / ".out.work")]
    calls.clear()
    assert products(out) == products(made["ab"])
    add_drive(out, drives.by_name["c"], replace(how, resume=True))
    assert_same(out, made["abc"])
    assert calls == []


@pytest.mark.slow
def test_a_finished_drive_is_resumed_only_when_it_was_mapped_in_the_same_way(
    drives: Drives, how: HowMapped, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = calls_of_the_pipeline(monkeypatch)
    monkeypatch.setattr(many_drives, "write_drives", stopped)
    coarse = Settings.model_validate({"mapping": {"voxel_size_m": 0.4}})
    elsewhere = LocalFrame(49.01, 8.42, 100.0)
    for settings, origin, again, times in (
        (SETTINGS, None, how, 1),
        (SETTINGS, None, replace(how, resume=True), 0),
        (coarse, None, replace(how, resume=True), 1),
        (coarse, elsewhere, replace(how, resume=True), 1),
        (coarse, elsewhere, replace(how, segmenter="none", resume=True), 1),
    ):
        calls.clear()
        with pytest.raises(KeyboardInterrupt):
            run_drives([drives.by_name["a"]], tmp_path / "out", settings, again, origin=origin)
        assert len(calls) == times


@pytest.mark.slow
def test_what_is_damaged_of_an_interrupted_run_is_made_again(
    made: dict[str, Path], drives: Drives, how: HowMapped, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, work = tmp_path / "out", tmp_path / ".out.work"
    stop_of(lambda: mapped("ab", drives, out, how), many_drives, "write_drives")
    halved(work / "drives/.a.work/located.npz")
    flipped(work / "drives/.b.work/checked.npz")
    halved(work / "drives/a/run.json")
    (work / "drives/b/metrics.json").unlink()
    calls = calls_of_the_pipeline(monkeypatch)
    mapped("ab", drives, out, replace(how, resume=True))
    assert calls == ["a", "b"]
    assert_same(out, made["ab"])


@pytest.mark.slow
def test_a_changed_byte_of_a_large_file_of_a_finished_drive_is_found(
    made: dict[str, Path], drives: Drives, how: HowMapped, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where files are compared by their size alone, it ends up in the map, or stops every run that is resumed."""
    out, file = tmp_path / "out", tmp_path / ".out.work/drives/a/trajectory.png"
    stop_of(lambda: mapped("ab", drives, out, how), many_drives, "write_drives")
    assert file.stat().st_size > CONTENT_BYTES
    flipped(file)
    calls = calls_of_the_pipeline(monkeypatch)
    mapped("ab", drives, out, replace(how, resume=True))
    assert calls == ["a"]
    assert_same(out, made["ab"])


@pytest.mark.slow
def test_adding_that_was_stopped_when_the_map_was_there_is_resumed_too(
    made: dict[str, Path], drives: Drives, how: HowMapped, tmp_path: Path
) -> None:
    out, work = shutil.copytree(made["ab"], tmp_path / "out"), tmp_path / ".out.work"
    stop_of(lambda: add_drive(out, drives.by_name["c"], how), many_drives, "write_drives")
    kept = shutil.copytree(work, tmp_path / "kept")
    again = replace(how, resume=True)
    add_drive(out, drives.by_name["c"], again)
    kept.rename(work)  # as if it had been killed before it removed it
    add_drive(out, drives.by_name["c"], again)
    assert_same(out, made["abc"])
    assert not work.exists()


@pytest.mark.slow
@pytest.mark.parametrize("names", ["a", "ab"])
def test_a_run_that_was_stopped_when_the_map_was_there_does_nothing_twice(
    names: str, made: dict[str, Path], drives: Drives, how: HowMapped, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    out, calls = shutil.copytree(made[names], tmp_path / "out"), calls_of_the_pipeline(monkeypatch)

    def resumed(**more: Any) -> None:
        (tmp_path / ".out.work/drives").mkdir(parents=True)  # it was killed when it cleaned up
        write_list(tmp_path / ".out.work")
        if len(names) == 1:
            more = {"settings": SETTINGS, **more}
            finished_run.run(drives.by_name["a"], out, drives.labels, force=True, resume=True, **more)
        else:
            places, again = [drives.by_name[name] for name in names], replace(how, resume=True)
            run_drives(places, out, more.pop("settings", SETTINGS), again, **more)
        assert [path.name for path in tmp_path.iterdir()] == ["out"]

    before = (out / "run.json").stat()
    resumed()
    assert calls == []
    assert os.path.samestat((out / "run.json").stat(), before)
    resumed(write_labels=True)
    assert calls == list(names)
    calls.clear()
    resumed(write_labels=True)
    assert calls == []
    resumed(write_labels=True, settings=SETTINGS.changed("mapping.voxel_size_m=0.4"))
    assert calls == list(names)


@pytest.mark.slow
def test_commands_find_the_result_that_a_killed_one_had_moved_away(
    made: dict[str, Path], drives: Drives, how: HowMapped, tmp_path: Path
) -> None:
    out, work = tmp_path / "out", tmp_path / ".out.work"
    for words in (
        ["add", out, drives.by_name["c"], "--segmenter", drives.labels, "--force"],
        ["refine", out],
    ):
        shutil.rmtree(out, ignore_errors=True)
        work.mkdir()
        write_list(work)
        shutil.copytree(made["ab"], work / "old")
        done = gnss_sem_map(*words)
        assert done.returncode == 0, done.stderr
        assert_same(out, made["abc" if "add" in words else "ab"])
        assert [path.name for path in tmp_path.iterdir()] == ["out"]


@pytest.mark.slow
def test_a_drive_that_two_workers_write_at_once_is_there_once(drives: Drives, tmp_path: Path) -> None:
    """A cluster calls a task again when it takes its worker for lost; the first call may go on."""
    job, words = stopped_before_it_is_written(drives, tmp_path)
    task = Task("a", path_of(drive_tasks.finish), words)
    with closing(Processes(2)) as processes:
        assert [found for _, found in processes.run([task, replace(task)])] == [None, None]
    assert (job.made / "run.json").is_file()
    assert sorted(path.name for path in job.made.parent.iterdir()) == [".a.work", "a"]


@pytest.mark.slow
def test_a_task_of_a_run_that_was_followed_by_another_one_does_nothing(
    drives: Drives, tmp_path: Path
) -> None:
    job, words = stopped_before_it_is_written(drives, tmp_path)
    replace(job, force=not job.force).begin()
    with pytest.raises(DataError, match=r"job\.json: is gone; this task is of a run that has ended$"):
        drive_tasks.finish(*words)
    assert not job.made.exists()


def stopped_before_it_is_written(drives: Drives, work: Path) -> tuple[DriveJob, tuple[Any, ...]]:
    """The first drive, all of whose chunks are mapped, and the arguments of the task that writes its map."""
    run = MapJob(SETTINGS, open_drive(drives.by_name["a"]).frame, work)
    job = job_for(source_of(drives.by_name["a"], drives.labels), run, force=True)
    with closing_drives():
        [one], _ = (list(found.values()) for found in pipeline.locate_drives([job], run))
        bound = bind({"a": one}, {}, run).keys["a"]
        placed = drive_tasks.place(*job.key, one.located, bound)
        count = len(placed["chunks"])
        store_of(job.folder, placed["map"], count, SETTINGS).begun(resume=False)
        drive_tasks.map_range(*job.key, placed["map"], 0, count)
    return job, (*job.key, {"located": one.located, "bound": bound, "mapped": placed["map"]}, 0.0)


def test_a_removal_that_was_stopped_when_the_map_was_there_does_nothing_twice(
    made: dict[str, Path], tmp_path: Path
) -> None:
    out, work = shutil.copytree(made["abc"], tmp_path / "out"), tmp_path / ".out.work"
    stop_of(lambda: remove_drive(out, "c"), work_folder, "clear")
    assert_same(out, made["ab"])
    before = (out / "run.json").stat()
    with pytest.raises(DataError, match="holds no drive 'd'"):
        remove_drive(out, "d", resume=True)
    assert remove_drive(out, "c", resume=True).about["merged"] == ["a", "b"]
    assert os.path.samestat((out / "run.json").stat(), before)
    assert not work.exists()
    with pytest.raises(DataError, match="holds no drive 'c'"):
        remove_drive(out, "c", resume=True)


@pytest.mark.slow
def test_a_name_that_is_not_in_the_map_leaves_what_another_command_has_done(
    made: dict[str, Path], drives: Drives, how: HowMapped, tmp_path: Path
) -> None:
    out, work = shutil.copytree(made["ab"], tmp_path / "out"), tmp_path / ".out.work"
    stop_of(lambda: add_drive(out, drives.by_name["c"], how), many_drives, "write_drives")
    mapped_there = work / "drives/c/run.json"
    before = mapped_there.stat()
    with pytest.raises(DataError, match="holds no drive 'd'; expected one of a, b"):
        remove_drive(out, "d", resume=True)
    assert os.path.samestat(mapped_there.stat(), before)
    add_drive(out, drives.by_name["c"], replace(how, resume=True))
    assert_same(out, made["abc"])


@pytest.mark.slow
def test_a_drive_that_was_added_while_another_command_began_stays(
    made: dict[str, Path], drives: Drives, how: HowMapped, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, claimed_run = shutil.copytree(made["a"], tmp_path / "out"), run_folder.claimed_run

    def after_another(*words: Any, **more: Any) -> Any:
        monkeypatch.setattr(run_folder, "claimed_run", claimed_run)
        add_drive(out, drives.by_name["b"], how)
        return claimed_run(*words, **more)

    monkeypatch.setattr(run_folder, "claimed_run", after_another)
    add_drive(out, drives.by_name["c"], how)
    assert_same(out, made["abc"])


@pytest.mark.slow
def test_a_finished_drive_is_mapped_again_when_what_it_was_read_from_has_changed(
    how: HowMapped, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written, calls = street_drives.write(tmp_path / "drives", ("a", "b")), calls_of_the_pipeline(monkeypatch)
    labels, drive = Path(written.labels.partition(":")[2].format(drive="a")), written.by_name["b"]
    places, again = list(written.by_name.values()), replace(how, segmenter=written.labels, resume=True)
    monkeypatch.setattr(many_drives, "write_drives", stopped)

    def mapped_again(changed: Path, content: bytes) -> list[str]:
        changed.write_bytes(content)
        calls.clear()
        with pytest.raises(KeyboardInterrupt):
            run_drives(places, tmp_path / "out", SETTINGS, again)
        return list(calls)

    image, row = labels / "0000000002.npz", drive / "oxts/data/0000000003.txt"
    latitude, rest = row.read_text().split(" ", 1)
    assert mapped_again(image, image.read_bytes()) == ["a", "b"]
    assert mapped_again(row, f"{float(latitude) + 1e-7:.12f} {rest}".encode()) == ["b"]
    assert mapped_again(image, image.read_bytes()) == ["a"]
