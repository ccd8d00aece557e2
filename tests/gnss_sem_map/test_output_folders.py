"""Output folders: who has the lock, what is on the disk before the old result goes, what comes back."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path

import pytest

from gnss_sem_map.errors import DataError
from gnss_sem_map.files import output_folder
from gnss_sem_map.files.output_folder import claimed, new_folder, restore


def write_result(out: Path, said: str) -> None:
    with new_folder(out) as folder:
        (folder / "map").mkdir()
        (folder / "map/0_0.parquet").write_text(said)
        (folder / "run.json").write_text(said)


def test_a_folder_that_another_command_writes_is_refused_until_that_has_ended(tmp_path: Path) -> None:
    out, lock = tmp_path / "out", tmp_path / ".out.lock"
    with lock.open("w") as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        other.write("gnss-sem-map writes it now (process 7 on far)\n")
        other.flush()
        with pytest.raises(DataError, match="process 7 on far"), claimed(out):
            pass
    with claimed(out):
        pass
    assert list(tmp_path.iterdir()) == []


def test_all_of_a_new_result_is_on_the_disk_before_the_old_one_goes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, synced, swap = tmp_path / "out", set(), output_folder._swap
    fsync = os.fsync

    def noted(number: int) -> None:
        fsync(number)
        synced.add(os.fstat(number).st_ino)

    def swapped(claim: output_folder.Claim, part: Path) -> None:
        there = [part, *part.rglob("*")]
        assert {path.stat().st_ino for path in there} <= synced
        swap(claim, part)

    monkeypatch.setattr(os, "fsync", noted)
    monkeypatch.setattr(output_folder, "_swap", swapped)
    write_result(out, "new")
    assert (out / "run.json").read_text() == "new"


def test_an_old_result_comes_back_if_the_new_one_never_came(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, old = tmp_path / "out", tmp_path / ".out.work/old"
    write_result(out, "old")
    with claimed(out) as claim:
        assert claim.old == old
        out.rename(old)
        monkeypatch.setattr(output_folder.work_folder, "clear", lambda folder: None)  # it is killed here
    monkeypatch.undo()
    restore(out)
    assert (out / "run.json").read_text() == "old"
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    restore(tmp_path / "nothing")
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
