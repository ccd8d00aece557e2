"""A place that cannot take a result is refused in one line, and the earlier result stays whole."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from declared import ROOT, absent
from faults.harness import gnss_sem_map
from faults.killing import content, write_result
from faults.results import RUN, refused, result_at, trajectory
from street import Street

from gnss_sem_map.errors import DataError
from gnss_sem_map.files.ownership import is_whole


@pytest.mark.parametrize(
    "kind", ["loop", "file", "below a file", "long", "nul", "pipe", "device", "dead end"]
)
def test_what_cannot_be_a_place_is_refused_in_one_line(
    small_drive: Street, kind: str, trial, tmp_path: Path
) -> None:
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    (tmp_path / "file").write_text("important")
    os.mkfifo(tmp_path / "pipe")
    places = {
        "loop": tmp_path / "loop", "file": tmp_path / "file", "below a file": tmp_path / "file" / "out",
        "long": tmp_path / ("x" * 300), "nul": tmp_path / "loop" / "out", "pipe": tmp_path / "pipe",
        "device": Path("/dev/null"), "dead end": Path("/proc/self/out"),
    }  # fmt: skip
    before = content(tmp_path)
    outcome = trajectory(small_drive, places[kind], tmp_path.with_name(f"{tmp_path.name}-trial"))
    trial("impossible OUT", refused(outcome, before, tmp_path, "choose"), outcome)


@pytest.mark.parametrize("what", ["place", "place/out", "place/out/map"])
def test_without_the_right_to_replace_nothing_is_begun(small_drive, what: str, trial, tmp_path: Path) -> None:
    result_at(tmp_path / "place/out", listed=True)
    (tmp_path / "trial").mkdir()
    user = None if os.getuid() else as_nobody(tmp_path)
    (tmp_path / what).chmod(0o555)
    before = content(tmp_path / "place")
    outcome = trajectory(small_drive, tmp_path / "place/out", tmp_path / "trial", user=user)
    (tmp_path / what).chmod(0o755)
    trial("rights", refused(outcome, before, tmp_path / "place", Path(what).name), outcome)


def as_nobody(folder: Path) -> int:
    """A user with fewer rights than root, to whom a folder is given."""
    user = 65534
    for path in (folder, *folder.rglob("*")):
        os.chown(path, user, user)
    for path in folder.parents:
        if path.stat().st_uid == 0 and path != Path("/"):
            path.chmod(path.stat().st_mode | 0o011)
    return user


@contextmanager
def mounted(place: Path, size: str) -> Iterator[None]:
    """A file system of this size, which only root can make."""
    place.mkdir(parents=True)
    command = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", place]
    if subprocess.run(command, capture_output=True, check=False).returncode:
        absent(ROOT, "mounting is not allowed here")
    try:
        yield
    finally:
        subprocess.run(["umount", "-l", place], check=True)


@pytest.fixture
def tiny_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 100 kB."""
    with mounted(tmp_path / "disk", "100k"):
        yield tmp_path / "disk"


@pytest.mark.slow
def test_a_mount_point_is_refused_and_a_folder_on_it_is_not(
    small_drive, tiny_disk: Path, trial, tmp_path: Path
) -> None:
    outcome = trajectory(small_drive, tiny_disk, tmp_path / "trial")
    trial("mounts", refused(outcome, {}, tiny_disk, "mount point"), outcome)
    write_result(tiny_disk / "out", RUN)
    before = content(tiny_disk)
    outcome = trajectory(small_drive, tiny_disk / "out", tmp_path / "trial")
    trial("full disk", refused(outcome, before, tiny_disk, "No space"), outcome)
    assert os.listdir(tiny_disk) == ["out"]


@pytest.mark.parametrize(
    "file_mb", [0.001, *(pytest.param(mb, marks=pytest.mark.slow) for mb in (0.0005, 0.003, 0.02))]
)
def test_a_full_disk_leaves_the_earlier_result(small_drive, file_mb: float, trial, tmp_path: Path) -> None:
    out = tmp_path / "place" / "out"
    write_result(out, RUN)
    before = content(out.parent)
    outcome = trajectory(small_drive, out, tmp_path / "trial", file_mb=file_mb)
    if file_mb > 0.01:  # there is room for the small files
        before = content(out.parent) if outcome.code == 0 else before
    faults = refused(outcome, before, out.parent, "") if outcome.code else outcome.faults
    trial("full disk", faults, outcome)


@pytest.mark.parametrize("words", [("--json",), pytest.param((), marks=pytest.mark.slow)])
def test_a_full_stdout_is_one_line(small_drive: Street, words, trial, tmp_path: Path) -> None:
    outcome = gnss_sem_map(
        "trajectory", small_drive.drive, "-o", tmp_path / "out", *words, folder=tmp_path / "trial",
        stdout=Path("/dev/full"),
    )  # fmt: skip
    faults = [*outcome.faults, *["exit code"] * (outcome.code != 1)]
    faults += ["no result"] * (not (tmp_path / "out/run.json").is_file())
    trial("full stdout", faults, outcome)


@pytest.mark.parametrize("what", [".", "map", "map/map.json"])
def test_an_old_result_that_cannot_go_is_never_half_gone_with_the_new_one(
    what: str, trial, tmp_path: Path
) -> None:
    out = tmp_path / "place" / "out"
    write_result(out, RUN)
    hold = ["chattr", "+i", out / what]  # not even root can move or remove it then
    if subprocess.run(hold, capture_output=True, check=False).returncode:
        absent(ROOT, "files cannot be held here")
    try:
        said = ""
        for number in range(2):
            try:
                write_result(out, {"run.json": f"{number}"})
            except DataError as error:
                said += f"{error} "
        whole = [path for path in out.parent.iterdir() if path.name.startswith("out")]
        faults = ["half a result"] * (not all(is_whole(path) for path in whole))
        faults += ["nothing at OUT"] * (not out.is_dir())
        faults += ["not named"] * (str(tmp_path) not in said)
        trial("rights", faults, said)
    finally:
        subprocess.run(["chattr", "-R", "-i", tmp_path], capture_output=True, check=True)


@pytest.mark.faults
def test_a_full_tmpdir_costs_nothing(small_drive: Street, trial, tmp_path: Path) -> None:
    with mounted(tmp_path / "trial" / "tmp", "4k"):
        labels = f"labels:{small_drive.labels}"
        words = ("run", small_drive.drive, "--segmenter", labels, "-o", tmp_path / "out")
        for workers in ("1", "2"):
            chunks = ("--workers", workers, "--set", "dynamics.window_scans=2")
            outcome = gnss_sem_map(*words, *chunks, folder=tmp_path / "trial")
            trial("full TMPDIR", [*outcome.faults, *["refused"] * (outcome.code != 0)], outcome)
