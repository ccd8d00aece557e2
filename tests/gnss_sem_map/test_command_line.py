"""Options of all commands: how much is printed, the log file, the dry run; and Ctrl-C at any moment."""

from __future__ import annotations

import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import typer.testing
from commands import gnss_sem_map
from street import Street

from gnss_sem_map import simulation
from gnss_sem_map.cli import app
from gnss_sem_map.cli.console import print_preflight, print_run
from gnss_sem_map.datasets import readers
from gnss_sem_map.errors import DataError
from gnss_sem_map.preflight.findings import Preflight
from gnss_sem_map.runs import expected_cost
from gnss_sem_map.sensor_log import Skip

pytestmark = pytest.mark.integration

DOCS = Path(__file__).parents[2] / "docs"


def test_a_dry_run_says_what_is_there_and_writes_nothing(small_drive: Street, tmp_path: Path) -> None:
    out = tmp_path / "new" / "out"
    words = (
        "run",
        small_drive.drive,
        "--segmenter",
        f"labels:{small_drive.labels}",
        "-o",
        out,
        "--workers",
        "1",
    )
    done = gnss_sem_map(*words, "--dry-run")
    assert (done.returncode, done.stderr) == (0, "")
    scans = len(list(small_drive.drive.glob("velodyne*/data/*")))
    assert f"{scans} scans over" in done.stdout
    assert f"labels:{small_drive.labels}" in done.stdout
    assert re.search(r"expected: about [\d.]+ min with 1 process that map", done.stdout)
    assert "nothing was written" in done.stdout
    assert list(tmp_path.iterdir()) == []


def test_a_dry_run_tells_the_origin_that_is_given(small_drive: Street, tmp_path: Path) -> None:
    words = ("run", small_drive.drive, "--segmenter", "none", "-o", tmp_path / "out", "--dry-run")
    done = gnss_sem_map(*words, "--origin", "49.02,8.43,110")
    assert done.returncode == 0, done.stderr
    assert "origin: 49.020000, 8.430000" in done.stdout


def test_an_origin_that_is_too_far_is_refused_before_the_work(small_drive: Street, tmp_path: Path) -> None:
    words = ("run", small_drive.drive, "--segmenter", "none", "-o", tmp_path / "out", "--force")
    for more in ((), ("--dry-run",)):
        done = gnss_sem_map(*words, "--origin", "48,11,0", *more)
        assert done.returncode == 1
        assert len(done.stderr.splitlines()) == 1
        assert "km from the origin of the map (48.000000, 11.000000, 0.0 m)" in done.stderr
        assert "choose an --origin near the drive" in done.stderr
        assert not list(tmp_path.iterdir())


def test_a_dry_run_refuses_what_the_run_would_refuse(small_drive: Street, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.tex").write_text("years of work")
    for words, message in (
        (("-o", tmp_path / "out", "--segmenter", "none"), "thesis.tex"),
        (("-o", tmp_path / "new", "--segmenter", "labels:/nowhere"), "/nowhere"),
        (("-o", tmp_path / "new", "--segmenter", "none", "--crs", "4326"), "4326"),
    ):
        done = gnss_sem_map("run", small_drive.drive, *words, "--dry-run")
        assert done.returncode in (1, 2)
        assert message in done.stderr
        assert len(done.stderr.splitlines()) == 1


@pytest.mark.parametrize("has_images", [True, False])
def test_a_dry_run_without_a_segmenter_ends_as_the_run_does(
    has_images: bool, small_drive: Street, tmp_path: Path
) -> None:
    """A map of several drives is refused without one also where these have no images."""
    drives = [small_drive.drive]
    if not has_images:
        date = shutil.copytree(small_drive.drive.parent, tmp_path / small_drive.drive.parent.name)
        drives = 2 * [date / small_drive.drive.name]
        shutil.rmtree(drives[0] / "image_02")
    words = ("run", *drives, "-o", tmp_path / "new")
    run, dry = gnss_sem_map(*words), gnss_sem_map(*words, "--dry-run")
    assert (dry.returncode, dry.stderr, dry.stdout) == (run.returncode, run.stderr, run.stdout)
    assert run.returncode == 1
    assert "--segmenter none" in dry.stderr


@pytest.mark.parametrize("wrong", ["one name", "no cloud", "no such place"])
def test_a_dry_run_of_several_drives_ends_as_the_run_does(
    wrong: str, small_drive: Street, tmp_path: Path
) -> None:
    (tmp_path / "again").mkdir()
    (tmp_path / "again" / small_drive.drive.name).symlink_to(small_drive.drive)
    options = {
        "one name": [tmp_path / "again" / small_drive.drive.name],
        "no cloud": ["--align-to", tmp_path / "city.laz"],
        "no such place": ["--align-to", tmp_path / "city.laz", "--crs", "2193"],
    }[wrong]
    words = ("-q", "run", small_drive.drive, *options, "--segmenter", "none", "-o", tmp_path / "new")
    run, dry = gnss_sem_map(*words), gnss_sem_map(*words, "--dry-run")
    assert run.returncode == 1
    assert (dry.returncode, dry.stderr, dry.stdout) == (run.returncode, run.stderr, run.stdout)


def test_a_dry_run_without_scans_ends_as_the_run_does(small_drive: Street, tmp_path: Path) -> None:
    options = ("--frames", "900:", "--segmenter", "none", "-o", tmp_path / "new")
    words = ("-q", "run", small_drive.drive, *options)
    run, dry = gnss_sem_map(*words), gnss_sem_map(*words, "--dry-run")
    assert (dry.returncode, dry.stderr, dry.stdout) == (run.returncode, run.stderr, run.stdout)
    assert run.returncode == 1
    assert "has no LiDAR scan" in dry.stderr


def test_a_dry_run_counts_on_a_damaged_scan_being_skipped(small_drive: Street, tmp_path: Path) -> None:
    date = tmp_path / small_drive.drive.parent.name
    shutil.copytree(small_drive.drive.parent, date)
    drive = date / small_drive.drive.name
    for scan in drive.glob("velodyne*/data/*"):
        scan.write_bytes(b"damaged")
    done = gnss_sem_map("run", drive, "--segmenter", "none", "-o", tmp_path / "new", "--dry-run")
    assert (done.returncode, done.stderr) == (0, "")
    assert "expected: about" in done.stdout


def test_the_help_names_every_format_of_drives() -> None:
    [option] = [
        each for each in typer.main.get_command(app).commands["run"].params if each.name == "drive_format"
    ]
    for name in readers():
        assert re.search(rf"\b{name}\b", option.help)


def test_the_constants_of_the_dry_run_are_those_of_the_page_on_scale() -> None:
    table = dict(re.findall(r"^\| ([^|]+) \| ([\d.,]+) \|$", (DOCS / "scale.md").read_text(), re.MULTILINE))
    known = {name: float(value.replace(",", "")) for name, value in table.items()}
    assert known["CPU per scan, ms"] == expected_cost.CPU_MS_PER_SCAN
    assert known["peak memory, drive of 480 s, MB"] == expected_cost.PEAK_MB
    assert known["smoothing and binding, MB per hour of a drive"] == expected_cost.TRAJECTORY_MB_PER_HOUR


def test_stages_and_warnings_go_to_terminal_and_file_as_the_options_say(
    small_drive: Street, tmp_path: Path
) -> None:
    log = tmp_path / "log.txt"
    words = ("trajectory", small_drive.drive, "-o", tmp_path / "out")
    loud = gnss_sem_map("-v", "--log-file", log, *words)
    assert loud.returncode == 0
    assert "scan matching: begins" in loud.stderr
    text = log.read_text()
    assert f"gnss-sem-map -v --log-file {log} trajectory" in text
    assert "scan matching: done after" in text
    assert text.splitlines()[-1].endswith("exit code 0")

    quiet = gnss_sem_map("-q", "--log-file", log, *words)
    assert (quiet.returncode, quiet.stderr) == (0, "")
    assert log.read_text().count("exit code 0") == 2  # it is appended to

    missing = gnss_sem_map("--log-file", log, "trajectory", tmp_path / "nowhere", "-o", tmp_path / "other")
    assert len(missing.stderr.splitlines()) == 1
    assert "nowhere" in log.read_text()
    assert log.read_text().splitlines()[-1].endswith("exit code 1")

    no_labels = gnss_sem_map("--log-file", log, "run", small_drive.drive, "-o", tmp_path / "other")
    assert no_labels.returncode == 1
    assert no_labels.stderr.strip() in log.read_text()

    refused = gnss_sem_map("--log-file", tmp_path / "no" / "log", *words)
    assert refused.returncode == 1
    assert len(refused.stderr.splitlines()) == 1
    assert gnss_sem_map("-q", "-v", *words).returncode == 2

    inside = gnss_sem_map("--log-file", tmp_path / "out" / "log.txt", *words)
    assert inside.returncode == 2
    assert "a folder of results; choose another place" in inside.stderr
    assert not (tmp_path / "out" / "log.txt").exists()


def test_the_first_progress_comes_before_large_packages_are_loaded(tmp_path: Path) -> None:
    seen = (
        "import logging, sys\n"
        "from gnss_sem_map.cli import logs\n"
        "class First(logging.Handler):\n"
        "    def emit(self, record):\n"
        "        print(record.getMessage(), sorted({'numba', 'scipy', 'gtsam', 'numpy'} & set(sys.modules)))\n"
        "        sys.exit()\n"
        "logs.STAGES.addHandler(First())\n"
        "from gnss_sem_map.cli import main\n"
        "main()\n"
    )
    words = [sys.executable, "-c", seen, "run", str(tmp_path), "-o", str(tmp_path / "out")]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.stdout == "loading: begins, 1 steps []\n", done.stderr


@pytest.mark.parametrize(
    "after_s", [0.12, 2.0, *(pytest.param(s, marks=pytest.mark.slow) for s in (0.08, 0.2, 0.5))]
)
def test_ctrl_c_is_one_line_from_the_first_import_on(
    after_s: float, small_drive: Street, tmp_path: Path
) -> None:
    """The interpreter's own start is not ours: the moment counts from when we take signals, before large imports."""
    code = (
        "from gnss_sem_map import cli\n"
        "taken = cli.stop_on_signals\n"
        "cli.stop_on_signals = lambda: (taken(), print('begun', flush=True))\n"
        "cli.main()\n"
    )
    words = ("run", small_drive.drive, "--segmenter", "none", "-o", tmp_path / "out", "--workers", "1")
    process = subprocess.Popen(
        [sys.executable, "-c", code, *map(str, words)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )  # fmt: skip
    assert process.stdout is not None
    process.stdout.readline()
    time.sleep(after_s)
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=600)
    assert process.returncode == 130
    assert len(said.splitlines()) == 1
    assert said.startswith("gnss-sem-map: stopped by SIGINT")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("layout", ["table", "rosbag1", "mcap", "kitti-360"])
def test_a_drive_that_is_there_is_refused_before_anything_is_simulated(
    layout: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def worked(*_: object, **__: object) -> None:
        raise AssertionError("a drive was simulated")

    for name in ("simulate", "prepare"):
        monkeypatch.setattr(simulation, name, worked)
    (tmp_path / "2026_04_19_drive_0031").mkdir()
    words = ["simulate", "-o", str(tmp_path), "--seed", "31", "--session", "1", "--layout", layout]
    with pytest.raises(DataError, match="2026_04_19_drive_0031: is already there"):
        typer.testing.CliRunner().invoke(app, words, catch_exceptions=False)


def test_what_is_left_out_for_one_reason_is_one_line_of_the_check(capsys: pytest.CaptureFixture[str]) -> None:
    skips = [Skip("scan", f"frame {number}", "repeated stamp") for number in (7, 8, 9)]
    skips.insert(1, Skip("image", "frame 7", "repeated stamp"))
    print_preflight("drive", Preflight((), 0.0), skips, Path("check.html"))
    assert capsys.readouterr().out.splitlines()[1:-1] == [
        "left out: scan, frame 7 and 2 more: repeated stamp",
        "left out: image, frame 7: repeated stamp",
    ]


def test_the_summary_counts_frames_that_are_skipped_not_their_entries(
    capsys: pytest.CaptureFixture[str],
) -> None:
    for frames, says in (
        ({"scan": 25, "image": 2}, "7 voxels, 27 skips"),
        ({"scan": 1}, "7 voxels, 1 skip\n"),
    ):
        about = {
            "name": "x",
            "counts": {},
            "seconds": {},
            "map": {"voxels": 7},
            "skips": {"count": 1, "frames": frames},
        }
        print_run(about, Path("out"), as_json=False)
        assert says in capsys.readouterr().out
