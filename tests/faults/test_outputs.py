"""What is at OUT, above it or beside it and not ours stays."""

from __future__ import annotations

import fcntl
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from faults.harness import gnss_sem_map
from faults.killing import content, write_result
from faults.results import RUN, refused, result_at, trajectory
from street import Street

from gnss_sem_map.errors import DataError
from gnss_sem_map.files.output_folder import new_folder
from gnss_sem_map.files.ownership import MARKER


@pytest.fixture
def own_street(small_drive: Street, tmp_path: Path) -> Street:
    """A copy of the street whose files a trial may lose."""
    root = tmp_path / "street"
    shutil.copytree(small_drive.drive.parents[1], root)
    return Street(
        root / small_drive.drive.relative_to(small_drive.drive.parents[1]), root / "probabilities",
        small_drive.motion, small_drive.frames, {}, {},
    )  # fmt: skip


FOREIGN: dict[str, Callable[[Path], None]] = {
    "thesis.txt": lambda path: path.write_text("important") and None,
    "map/notes.md": lambda path: path.write_text("important") and None,
    "labels/mine.label": lambda path: path.write_text("important") and None,
    "photos/": lambda path: path.mkdir(),
    "link": lambda path: path.symlink_to("/etc"),
    "map/1_1.parquet": lambda path: path.symlink_to("/etc/hostname"),
    ".git/": lambda path: path.mkdir(),
    "pipe": lambda path: os.mkfifo(path),
}


@pytest.mark.parametrize("name", FOREIGN)
@pytest.mark.parametrize("listed", [True, pytest.param(False, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "command",
    ["trajectory", *(pytest.param(name, marks=pytest.mark.faults) for name in ("run", "demo"))],
)
def test_a_result_with_something_foreign_in_it_is_refused_before_any_work(
    small_drive: Street, name: str, listed: bool, command: str, trial, tmp_path: Path
) -> None:
    out = tmp_path / "place" / "out"
    result_at(out, listed)
    FOREIGN[name](out / name)
    before = content(out.parent)
    words = {
        "trajectory": ("trajectory", small_drive.drive),
        "run": ("run", small_drive.drive, "--segmenter", f"labels:{small_drive.labels}"),
        "demo": ("demo", "--seconds", "3"),
    }[command]
    outcome = gnss_sem_map(*words, "-o", out, folder=tmp_path / "trial")
    trial("foreign files in OUT", refused(outcome, before, out.parent, name.rstrip("/")), outcome)


@pytest.mark.parametrize("changed", ["config.yaml", "run.json", "map/map.json"])
def test_a_file_of_ours_that_somebody_changed_is_not_ours_any_more(
    small_drive: Street, changed: str, trial, tmp_path: Path
) -> None:
    out = tmp_path / "place" / "out"
    result_at(out, listed=True)
    (out / changed).write_text("z: 1")  # as long as before
    before = content(out.parent)
    outcome = trajectory(small_drive, out, tmp_path / "trial")
    trial("changed files in OUT", refused(outcome, before, out.parent, changed), outcome)


def test_a_damaged_list_proves_nothing(small_drive: Street, trial, tmp_path: Path) -> None:
    for damage in ("", "{", "[]", '{"files": 3}', '{"files": {"thesis.txt": 1}}', "\0" * 50):
        out = tmp_path / "place" / "out"
        write_result(out, {**RUN, "thesis.txt": "important"})
        (out / MARKER).write_text(damage)
        before = content(out.parent)
        outcome = trajectory(small_drive, out, tmp_path / "trial")
        trial("damaged list in OUT", refused(outcome, before, out.parent, "out"), outcome)
        shutil.rmtree(out)


INPUTS = {
    "the drive": lambda s: s.drive,
    "the folder above it": lambda s: s.drive.parent,
    "the folder above that": lambda s: s.drive.parents[1],
    "in the drive": lambda s: s.drive / "velodyne_points",
    "a new folder in the drive": lambda s: s.drive / "new" / "out",
    "the probabilities": lambda s: s.labels,
    "in the probabilities": lambda s: s.labels / "out",
    "here": lambda s: ".",
    "above": lambda s: "..",
    "the root": lambda s: "/",
    "home": lambda s: Path.home(),
}


@pytest.mark.parametrize("place", INPUTS)
@pytest.mark.parametrize("linked", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_an_input_is_never_a_place_for_results(
    own_street: Street, place: str, linked: bool, trial, tmp_path: Path
) -> None:
    """Even if it holds a run.json and a list, and by whatever link it is reached."""
    street = own_street
    out = INPUTS[place](street)
    if place not in ("here", "above", "the root", "home"):
        out.mkdir(parents=True, exist_ok=True)
        (out / "run.json").write_text("{}")
    before = content(tmp_path / "street")
    if linked:
        (tmp_path / "link").symlink_to(out if isinstance(out, Path) else street.drive.parent)
        out = tmp_path / "link"
    labels = f"labels:{street.labels}"
    words = ("run", street.drive, "--segmenter", labels, "-o", out)
    outcome = gnss_sem_map(*words, folder=tmp_path / "trial", cwd=street.drive.parent)
    trial("inputs as OUT", refused(outcome, before, tmp_path / "street", "choose"), outcome)


def test_files_that_are_read_are_never_in_the_place_for_results(small_drive, trial, tmp_path: Path) -> None:
    """Settings, calibration and labels that lie in an earlier result of ours."""
    for name, option in (
        ("config.yaml", "--config"),
        ("cal.yaml", "--set=calibration="),
        ("w.pt", "--segmenter=refinenet:"),
    ):
        out = tmp_path / "place" / "out"
        write_result(out, {"run.json": "{}", name: "{}"})
        before = content(out.parent)
        words = [option, str(out / name)] if option == "--config" else [f"{option}{out / name}"]
        outcome = gnss_sem_map("run", small_drive.drive, *words, "-o", out, folder=tmp_path / "trial")
        trial("inputs in OUT", refused(outcome, before, out.parent, name), outcome)
        shutil.rmtree(out)


REFUSED = [".out.work", ".out.lock", ".out.work/part", ".out.work/3"]
LEFT_ALONE = [".out.part", ".out.old", "out.new", "out_drive"]


@pytest.mark.parametrize(
    "name", [*REFUSED, *(pytest.param(name, marks=pytest.mark.faults) for name in LEFT_ALONE)]
)
def test_what_lies_beside_is_somebody_elses(small_drive: Street, name: str, trial, tmp_path: Path) -> None:
    """The command does without it, or refuses; it stays in any case."""
    place = tmp_path / "place"
    beside = place / name
    if name == ".out.lock":
        place.mkdir()
        beside.write_text("important")
    else:
        beside.mkdir(parents=True)
        (beside / "thesis.txt").write_text("important")
    before = content(place)
    outcome = trajectory(small_drive, place / "out", tmp_path / "trial")
    kept = {path: look for path, look in content(place).items() if path in before}
    faults = [*outcome.faults, *["lost"] * (kept != before)]
    faults += ["no result"] * (outcome.code == 0 and not (place / "out/run.json").is_file())
    trial("neighbours", faults, outcome)


def test_notes_in_the_folder_of_an_interrupted_run_stay(small_drive: Street, trial, tmp_path: Path) -> None:
    for name in ("notes.txt", "chunks/notes.txt", "0/notes.txt", "0/static/notes.txt", "answers/notes.txt"):
        work = tmp_path / name.replace("/", "_") / ".out.work"
        write_result(work, {})
        (work / name).parent.mkdir(parents=True, exist_ok=True)
        (work / name).write_text("important")
        before = content(work.parent)
        outcome = trajectory(small_drive, work.parent / "out", tmp_path / "trial")
        trial("neighbours", refused(outcome, before, work.parent, name.split("/")[0]), outcome)


@pytest.mark.slow
def test_an_interrupted_run_without_its_fingerprint_blocks_nobody(small_drive, trial, tmp_path: Path) -> None:
    work = tmp_path / "place" / ".out.work"
    write_result(work, {})
    (work / "0").mkdir()
    (work / "0/record.json").write_text("{")
    outcome = trajectory(small_drive, tmp_path / "place/out", tmp_path / "trial")
    faults = [*outcome.faults, *["refused"] * (outcome.code != 0)]
    faults += ["left"] * (os.listdir(tmp_path / "place") != ["out"])
    trial("left by an interrupted run", faults, outcome)


@pytest.mark.slow
def test_a_link_is_followed(small_drive: Street, trial, tmp_path: Path) -> None:
    place = tmp_path / "disk"
    place.mkdir()
    (tmp_path / "link").symlink_to(place / "out")  # that is not there yet
    for _ in range(2):
        outcome = trajectory(small_drive, tmp_path / "link", tmp_path / "trial")
        faults = [*outcome.faults, *["no result there"] * (not (place / "out/run.json").is_file())]
        faults += ["the link is gone"] * (not (tmp_path / "link").is_symlink())
        faults += ["left"] * (os.listdir(place) != ["out"])
        trial("links", faults, outcome)


def test_of_two_commands_the_second_is_refused_and_told_by_whom(small_drive, trial, tmp_path: Path) -> None:
    place = tmp_path / "place"
    write_result(place / "out", RUN)
    said = "gnss-sem-map writes it now (process 4711 on elsewhere, since 2026-01-01 00:00:00)\n"
    (place / ".out.lock").write_text(said)
    before = content(place)
    commands = {
        "trajectory": ("trajectory", small_drive.drive, "-o", place / "out"),
        "run": ("run", small_drive.drive, "--segmenter", "none", "-o", place / "out", "--resume"),
        "demo": ("demo", "-o", place / "out"),
        "segment": (
            "segment",
            small_drive.drive,
            "--segmenter",
            f"labels:{small_drive.labels}",
            "-o",
            place / "out",
        ),
    }
    with (place / ".out.lock").open() as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        for name, words in commands.items():
            outcome = gnss_sem_map(*words, folder=tmp_path / name)
            trial("two into one OUT", refused(outcome, before, place, "process 4711 on elsewhere"), outcome)
    # its holder is gone: the lock holds nobody
    outcome = trajectory(small_drive, place / "out", tmp_path / "trial")
    faults = [*outcome.faults, *["refused"] * (outcome.code != 0)]
    trial("two into one OUT", [*faults, *["left"] * (os.listdir(place) != ["out"])], outcome)


def replace_while_somebody_writes(out: Path, name: str) -> None:
    with new_folder(out) as folder:
        (folder / "run.json").write_text("new")
        (out / name).write_text("important")


def test_what_came_into_the_old_result_under_way_stays_and_the_new_one_is_named(
    trial, tmp_path: Path
) -> None:
    for number, name in enumerate(("thesis.txt", "map/notes.md", "config.yaml")):
        out = tmp_path / f"{number}" / "out"
        write_result(out, RUN)
        with pytest.raises(DataError, match="the new ones are in") as refusal:
            replace_while_somebody_writes(out, name)
        kept = Path(str(refusal.value).rpartition(" ")[2])
        faults = ["lost"] * (
            (out / name).read_text() != "important" or (out / "map/map.json").read_text() != "{}"
        )
        faults += ["no new result"] * ((kept / "run.json").read_text() != "new")
        faults += ["left"] * (sorted(path.name for path in out.parent.iterdir()) != ["out", "out.new"])
        trial("foreign files in OUT", faults)


@pytest.mark.faults
def test_names_are_names_as_long_as_they_are_text(own_street: Street, trial, tmp_path: Path) -> None:
    for name in (b"out\xff", "\u00e4 \u4e2d \U0001f697".encode(), b"-", b"a b'\"$(x)", b"out\n2"):
        out = tmp_path / "place" / os.fsdecode(name)
        outcome = trajectory(own_street, out, tmp_path / "trial")
        is_text = b"\xff" not in name
        faults = [*outcome.faults, *[f"exit code {outcome.code}"] * (outcome.code != 1 - is_text)]
        faults += ["no result"] * ((out / "run.json").is_file() != is_text)
        trial("names", faults, outcome)
    assert len(os.listdir(tmp_path / "place")) == 4


@pytest.mark.faults
def test_a_lock_that_is_none_is_not_touched(small_drive: Street, trial, tmp_path: Path) -> None:
    place = tmp_path / "place"
    place.mkdir()
    makers: list[Callable[[Path], object]] = [
        lambda path: path.write_bytes(b"\xff\xfe thesis"), lambda path: os.mkfifo(path), lambda path: path.mkdir(),
        lambda path: path.symlink_to("/etc/hostname"), lambda path: path.symlink_to(path),
    ]  # fmt: skip
    for make in makers:
        lock = place / ".out.lock"
        make(lock)
        before = lock.lstat()
        outcome = trajectory(small_drive, place / "out", tmp_path / "trial")
        faults = [*outcome.faults, *["not refused"] * (outcome.code != 1)]
        trial(
            "neighbours", [*faults, *["touched"] * (lock.lstat().st_mtime_ns != before.st_mtime_ns)], outcome
        )
        lock.rmdir() if lock.is_dir() and not lock.is_symlink() else lock.unlink()


@pytest.mark.slow
def test_other_commands_write_over_nothing_that_is_not_theirs(small_drive, trial, tmp_path: Path) -> None:
    place = tmp_path / "place"
    place.mkdir()
    (place / "thesis.txt").write_text("important")
    (place / "calibration.yaml").write_text("important: true")
    (place / "2026_04_18").mkdir()
    (place / "2026_04_18" / "calib_cam_to_cam.txt").write_text("important")
    (place / "2026_04_18" / ".2026_04_18_drive_0007_sync.partial").mkdir()
    (place / "2026_04_18" / ".2026_04_18_drive_0007_sync.partial" / "thesis.txt").write_text("important")
    (tmp_path / "run").mkdir()
    before = content(place)
    labels = f"labels:{small_drive.labels}"
    for words, named in (
        (("segment", small_drive.drive, "--segmenter", labels, "-o", place), "choose an empty folder"),
        (("simulate", "--seconds", "0.3", "-o", place), "calibration of another drive"),
        (("simulate", "--seconds", "0.3", "--seed", "7", "-o", place), "in the way"),
        (
            ("calibrate", tmp_path / "run", "--truth", small_drive.labels, "-o", place / "calibration.yaml"),
            "choose",
        ),
        (("evaluate", place, "--truth", small_drive.labels), "no run folder"),
    ):
        outcome = gnss_sem_map(*words, folder=tmp_path / words[0])
        trial("other commands", refused(outcome, before, place, named), outcome)
