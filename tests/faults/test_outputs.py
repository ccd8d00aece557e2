"""What is at OUT, above it or beside it and not ours stays; who cannot put a result there says so first."""

from __future__ import annotations

import fcntl
import json
import os
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from faults.harness import Outcome, gnss_sem_map
from faults.killing import content, write_result
from street import Street

from gnss_sem_map.errors import DataError
from gnss_sem_map.files.output_folder import new_folder
from gnss_sem_map.files.ownership import MARKER, is_whole

RUN = {
    "run.json": "{}",
    "config.yaml": "a: 1",
    "map/map.json": "{}",
    "map/0_-1.parquet": "x",
    "labels/7.label": "",
}
"""Files of an earlier result."""


def trajectory(street: Street, out: Path | str, folder: Path, **more) -> Outcome:
    """The command that writes a result soonest."""
    return gnss_sem_map("trajectory", street.drive, "-o", out, folder=folder, **more)


def refused(outcome: Outcome, before: dict[str, str], place: Path, named: str) -> list[str]:
    """What is wrong with a refusal: it takes no time, names what is in the way, and changes nothing."""
    faults = list(outcome.faults)
    faults += [f"exit code {outcome.code}"] * (outcome.code != 1)
    faults += [f"does not name {named}"] * (named not in outcome.err)
    faults += ["something was changed"] * (content(place) != before)
    return faults


@pytest.fixture
def own_street(small_drive: Street, tmp_path: Path) -> Street:
    """A copy of the street whose files a trial may lose."""
    root = tmp_path / "street"
    shutil.copytree(small_drive.drive.parents[1], root)
    return Street(
        root / small_drive.drive.relative_to(small_drive.drive.parents[1]), root / "probabilities",
        small_drive.motion, small_drive.frames, {}, {},
    )  # fmt: skip


def result_at(out: Path, listed: bool) -> None:
    write_result(out, RUN)
    if not listed:
        (out / MARKER).unlink()


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
@pytest.mark.parametrize("listed", [True, False])
@pytest.mark.parametrize(
    "command",
    ["trajectory", *(pytest.param(name, marks=pytest.mark.faults) for name in ("run", "merge", "demo"))],
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
        "merge": ("merge", small_drive.drive, small_drive.labels),
        "demo": ("demo", "--seconds", "3"),
    }[command]
    if command == "merge":
        for number, folder in enumerate(("a", "b")):
            write_result(tmp_path / folder, {**RUN, "run.json": json.dumps({"number": number})})
        words = ("merge", tmp_path / "a", tmp_path / "b")
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
@pytest.mark.parametrize("linked", [False, True])
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


def test_an_interrupted_run_without_its_fingerprint_blocks_nobody(small_drive, trial, tmp_path: Path) -> None:
    work = tmp_path / "place" / ".out.work"
    write_result(work, {})
    (work / "0").mkdir()
    (work / "0/record.json").write_text("{")
    outcome = trajectory(small_drive, tmp_path / "place/out", tmp_path / "trial")
    faults = [*outcome.faults, *["refused"] * (outcome.code != 0)]
    faults += ["left"] * (os.listdir(tmp_path / "place") != ["out"])
    trial("left by an interrupted run", faults, outcome)


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


@pytest.mark.skipif(os.getuid() != 0, reason="only root can act as somebody with fewer rights")
@pytest.mark.parametrize("what", ["place", "place/out", "place/out/map"])
def test_without_the_right_to_replace_nothing_is_begun(small_drive, what: str, trial, tmp_path: Path) -> None:
    user = 65534
    result_at(tmp_path / "place/out", listed=True)
    for path in (tmp_path, *tmp_path.rglob("*")):
        os.chown(path, user, user)
    for path in tmp_path.parents:
        if path.stat().st_uid == 0 and path != Path("/"):
            path.chmod(path.stat().st_mode | 0o011)
    (tmp_path / what).chmod(0o555)
    before = content(tmp_path / "place")
    (tmp_path / "trial").mkdir()
    os.chown(tmp_path / "trial", user, user)
    outcome = trajectory(small_drive, tmp_path / "place/out", tmp_path / "trial", user=user)
    (tmp_path / what).chmod(0o755)
    trial("rights", refused(outcome, before, tmp_path / "place", Path(what).name), outcome)


@pytest.fixture
def tiny_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 100 kB."""
    place = tmp_path / "disk"
    place.mkdir()
    done = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=100k", "tmpfs", place], capture_output=True, check=False
    )
    if done.returncode:
        pytest.skip("mounting is not allowed here")
    yield place
    subprocess.run(["umount", "-l", place], check=True)


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


@pytest.mark.parametrize("file_mb", [0.0005, 0.001, 0.003, 0.02])
def test_a_full_disk_leaves_the_earlier_result(small_drive, file_mb: float, trial, tmp_path: Path) -> None:
    out = tmp_path / "place" / "out"
    write_result(out, RUN)
    before = content(out.parent)
    outcome = trajectory(small_drive, out, tmp_path / "trial", file_mb=file_mb)
    if file_mb > 0.01:  # there is room for the small files
        before = content(out.parent) if outcome.code == 0 else before
    faults = refused(outcome, before, out.parent, "") if outcome.code else outcome.faults
    trial("full disk", faults, outcome)


@pytest.mark.parametrize("words", [("--json",), ()])
def test_a_full_stdout_is_one_line(small_drive: Street, words, trial, tmp_path: Path) -> None:
    outcome = gnss_sem_map(
        "trajectory", small_drive.drive, "-o", tmp_path / "out", *words, folder=tmp_path / "trial",
        stdout=Path("/dev/full"),
    )  # fmt: skip
    faults = [*outcome.faults, *["exit code"] * (outcome.code != 1)]
    faults += ["no result"] * (not (tmp_path / "out/run.json").is_file())
    trial("full stdout", faults, outcome)


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
        "merge": ("merge", tmp_path / "a", tmp_path / "b", "-o", place / "out"),
    }
    for number, folder in enumerate("ab"):
        write_result(tmp_path / folder, {**RUN, "run.json": json.dumps({"number": number})})
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


def held(path: Path) -> bool:
    """Make a file such that nobody, not even root, can move or remove it; whether that is possible here."""
    return subprocess.run(["chattr", "+i", path], capture_output=True, check=False).returncode == 0


@pytest.mark.parametrize("what", [".", "map", "map/map.json"])
def test_an_old_result_that_cannot_go_is_never_half_gone_with_the_new_one(
    what: str, trial, tmp_path: Path
) -> None:
    out = tmp_path / "place" / "out"
    write_result(out, RUN)
    if not held(out / what):
        pytest.skip("files cannot be held here")
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


@pytest.mark.faults
def test_a_full_tmpdir_costs_nothing(small_drive: Street, trial, tmp_path: Path) -> None:
    full = tmp_path / "trial" / "tmp"
    full.mkdir(parents=True)
    done = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=4k", "tmpfs", full], capture_output=True, check=False
    )
    if done.returncode:
        pytest.skip("mounting is not allowed here")
    try:
        labels = f"labels:{small_drive.labels}"
        words = ("run", small_drive.drive, "--segmenter", labels, "-o", tmp_path / "out")
        for workers in ("1", "2"):
            chunks = ("--workers", workers, "--set", "dynamics.window_scans=2")
            outcome = gnss_sem_map(*words, *chunks, folder=tmp_path / "trial")
            trial("full TMPDIR", [*outcome.faults, *["refused"] * (outcome.code != 0)], outcome)
    finally:
        subprocess.run(["umount", "-l", full], check=True)


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
