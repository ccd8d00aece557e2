"""Every input in turn is unreadable, a folder, a pipe, a loop, empty, noise, or oddly named: one line, no hang."""

from __future__ import annotations

import os
import shutil
import socket
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import street
from faults.harness import gnss_sem_map

from gnss_sem_map.datasets import open_drive
from gnss_sem_map.errors import SemMapError

KITTI = [
    "../calib_imu_to_velo.txt", "../calib_velo_to_cam.txt", "../calib_cam_to_cam.txt", "oxts", "oxts/data",
    "oxts/timestamps.txt", "oxts/data/0000000001.txt", "velodyne_points", "velodyne_points/data",
    "velodyne_points/timestamps.txt", "velodyne_points/timestamps_start.txt", "velodyne_points/timestamps_end.txt",
    "velodyne_points/data/0000000001.bin", "image_02", "image_02/data", "image_02/timestamps.txt",
    "image_02/data/0000000001.png",
]  # fmt: skip
ODOMETRY = [
    "calib.txt", "poses.txt", "times.txt", "velodyne", "velodyne/000001.bin", "image_2", "image_2/000000.png",
]  # fmt: skip
TABLE = [
    "imu.csv", "gnss.csv", "log.yaml", "lidar", "lidar/stamps.csv", "lidar/1.bin", "images", "images/stamps.csv",
    "images/1.png",
]  # fmt: skip
INPUTS = (
    [("kitti", name) for name in KITTI] + [("odometry", n) for n in ODOMETRY] + [("table", n) for n in TABLE]
)


def _as_folder(path: Path) -> None:
    path.mkdir()


def _as_pipe(path: Path) -> None:
    os.mkfifo(path)


def _as_socket(path: Path) -> None:
    here = Path.cwd()
    os.chdir(path.parent)  # names of sockets are short
    try:
        with socket.socket(socket.AF_UNIX) as made:
            made.bind(path.name)
    finally:
        os.chdir(here)


def _as_loop(path: Path) -> None:
    path.symlink_to(path.name)


def _as_link_to_nothing(path: Path) -> None:
    path.symlink_to("not-there")


def _as_device(path: Path) -> None:
    path.symlink_to("/dev/zero")


def _as_nothing(path: Path) -> None:
    del path


def _as_empty(path: Path) -> None:
    path.touch()


def _as_noise(path: Path) -> None:
    path.write_bytes(np.random.default_rng(0).bytes(4001))


def _as_a_terabyte(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(1 << 40)


INSTEAD = {
    function.__name__.removeprefix("_as_"): function
    for function in (
        _as_folder, _as_pipe, _as_socket, _as_loop, _as_link_to_nothing, _as_device, _as_nothing, _as_empty, _as_noise,
        _as_a_terabyte,
    )
}  # fmt: skip


def _copy(drive: Path, folder: Path) -> Path:
    shutil.copytree(drive.parent, folder / drive.parent.name)
    return folder / drive.parent.name / drive.name


def _replace(drive: Path, name: str, instead: Callable[[Path], None]) -> None:
    path = drive / name
    path = path.parent.resolve() / path.name
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    instead(path)


def _read_whole(drive: Path) -> str:
    """What is said of a drive of which everything is read."""
    try:
        log = open_drive(drive)
    except SemMapError as error:
        return str(error)
    said = ""
    for item in (*log.scans, *log.images):
        try:
            item.read()
        except SemMapError as error:
            said = str(error)
    return said or "".join(skip.where + skip.reason for skip in log.skips)


@pytest.mark.parametrize("instead", INSTEAD)
@pytest.mark.parametrize(("layout", "name"), INPUTS)
def test_something_else_in_place_of_an_input_is_said(layout, name, instead, drives, trial, tmp_path) -> None:
    drive = _copy(drives[layout], tmp_path)
    _replace(drive, name, INSTEAD[instead])
    said = _read_whole(drive)
    is_optional = name in (
        "log.yaml",
        "image_02",
        "lidar",
        "images",
        "image_2",
        "velodyne",
        "velodyne_points",
    )
    said_nothing = not said and not (instead in ("nothing", "folder", "empty") and is_optional)
    trial("files", ["not a word"] if said_nothing else [], (layout, name, instead, said))
    assert "\n" not in said


@pytest.mark.faults
@pytest.mark.parametrize("instead", ["pipe", "loop", "folder", "device", "a_terabyte", "noise"])
@pytest.mark.parametrize(("layout", "name"), INPUTS)
def test_a_command_says_it_in_one_line(layout, name, instead, drives, trial, tmp_path) -> None:
    drive = _copy(drives[layout], tmp_path)
    _replace(drive, name, INSTEAD[instead])
    outcome = gnss_sem_map(
        "trajectory", drive, "-o", tmp_path / "out", "--set", "trajectory.lidar_odometry=false",
        folder=tmp_path / "run",
    )  # fmt: skip
    trial("files", outcome.faults, outcome)


def _without_rights(arguments: tuple[object, ...], folder: Path) -> tuple[int, str]:
    """A command as a user who is not root: its exit code and what it printed on stderr."""
    read_end, write_end = os.pipe()
    child = os.fork()
    if child == 0:
        os.environ["NUMBA_CACHE_DIR"] = str(folder)
        os.dup2(write_end, 2)
        code = 99
        try:
            if os.getuid() == 0:
                os.setgid(65534)
                os.setuid(65534)
            open_drive(Path(str(arguments[0])))
            code = 0
        except SemMapError as error:
            os.write(2, str(error).encode())
            code = 1
        finally:
            os._exit(code)
    os.close(write_end)
    with os.fdopen(read_end) as pipe:
        text = pipe.read()
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), text


@pytest.mark.parametrize(("layout", "name"), INPUTS)
def test_what_may_not_be_read_is_said(layout, name, drives, trial, tmp_path) -> None:
    drive = _copy(drives[layout], tmp_path)
    for folder in (tmp_path, *tmp_path.parents):
        if folder.stat().st_uid == os.getuid() and folder != Path("/"):
            folder.chmod(folder.stat().st_mode | 0o011)
    for path in (tmp_path, *tmp_path.rglob("*")):
        path.chmod(0o755)
    (drive / name).chmod(0)
    code, said = _without_rights((drive,), tmp_path)
    is_frame = Path(name).stem.isdecimal()
    faults = (
        []
        if code == 0 and is_frame
        else []
        if code == 1 and "Permission denied" in said
        else [f"{code} {said}"]
    )
    trial("rights", faults)


@pytest.mark.parametrize("suffix", [".jpg", ".jpeg", ".JPG", ".PNG"])
def test_jpeg_is_read_like_png(suffix: str, drives, trial, tmp_path: Path) -> None:
    for layout, folder in (("kitti", "image_02/data"), ("odometry", "image_2"), ("table", "images")):
        drive = _copy(drives[layout], tmp_path / layout)
        before = open_drive(drives[layout])
        for path in list((drive / folder).glob("*.png")):
            pixels = cv2.imread(str(path))
            path.unlink()
            encoded = cv2.imencode(suffix.lower(), pixels, [cv2.IMWRITE_JPEG_QUALITY, 98])[1]
            path.with_suffix(suffix).write_bytes(encoded.tobytes())
        after = open_drive(drive)
        assert [(i.number, i.stamp) for i in after.images] == [(i.number, i.stamp) for i in before.images]
        assert after.calibration.image_sizes == {"": (street.WIDTH, street.HEIGHT)}
        different = np.abs(after.images[0].read().astype(int) - before.images[0].read())
        assert np.median(different) <= 3
        trial("files")


def test_of_a_png_and_a_jpg_of_one_frame_the_png_is_read_and_the_other_is_named(
    drives, trial, tmp_path
) -> None:
    drive = _copy(drives["kitti"], tmp_path)
    (drive / "image_02/data/0000000001.jpg").write_bytes(b"\xff\xd8\xff")
    log = open_drive(drive)
    assert log.images[1].read().shape == (street.HEIGHT, street.WIDTH, 3)
    assert [s.reason for s in log.skips] == ["frame 1 has another file, 0000000001.png"]
    trial("files")


def test_a_jpg_that_is_cut_short_is_refused_and_not_half_grey(drives, trial, tmp_path: Path) -> None:
    drive = _copy(drives["table"], tmp_path)
    encoded = cv2.imencode(".jpg", np.random.default_rng(0).integers(0, 255, (96, 300, 3), np.uint8))[
        1
    ].tobytes()
    (drive / "images/1.png").unlink()
    (drive / "images/1.jpg").write_bytes(encoded[: len(encoded) // 2])
    with pytest.raises(SemMapError, match="damaged image"):
        open_drive(drive).images[1].read()
    trial("files")


def test_a_scan_that_shrinks_or_is_written_again_is_no_longer_read(drives, trial, tmp_path: Path) -> None:
    for layout, name in (("kitti", "velodyne_points/data/0000000001.bin"), ("table", "lidar/1.bin")):
        drive = _copy(drives[layout], tmp_path / layout)
        log, path = open_drive(drive), drive / name
        path.write_bytes(path.read_bytes()[:1600])
        with pytest.raises(SemMapError, match="changed while the drive was read"):
            log.scans[1].read()
        trial("files")


def test_names_that_are_no_text_can_be_said(drives, trial, tmp_path: Path) -> None:
    for layout, drive in drives.items():
        odd = Path(os.fsdecode(os.fsencode(tmp_path) + b"/\xff\xfe " + layout.encode()))
        shutil.copytree(drive.parent, odd)
        log = open_drive(odd / drive.name)
        assert log.scans
        log.name.encode("utf-8")
        (
            odd
            / drive.name
            / {"kitti": "oxts/timestamps.txt", "odometry": "poses.txt"}.get(layout, "imu.csv")
        ).unlink()
        with pytest.raises(SemMapError) as caught:
            open_drive(odd / drive.name)
        assert "\\xff\\xfe" in str(caught.value)
        trial("names")


@pytest.mark.parametrize("command", ["trajectory", "check", "evaluate", "run", "calibrate"])
def test_odd_names_on_the_command_line_are_answered_in_one_line(command: str, trial, tmp_path: Path) -> None:
    rest = {
        "evaluate": ["--truth", "x"],
        "calibrate": ["--truth", "x"],
        "check": [],
    }
    for name in (os.fsdecode(b"\xff\xfe"), "x" * 300, "/" + "y/" * 3000, "a\tb\nc", ""):
        outcome = gnss_sem_map(
            command, name, *rest.get(command, ["-o", tmp_path / "out"]), folder=tmp_path / "run", cwd=tmp_path
        )
        trial("names", outcome.faults, outcome)


def test_a_frame_number_of_19_digits_is_not_rounded(drives, trial, tmp_path: Path) -> None:
    drive = _copy(drives["table"], tmp_path)
    for sensor, suffix in (("lidar", ".bin"), ("images", ".png")):
        lines = (drive / sensor / "stamps.csv").read_text().splitlines()
        base = 1_316_995_200_123_456_789
        for k in range(4):
            (drive / sensor / f"{k}{suffix}").rename(drive / sensor / f"{base + k}{suffix}")
        changed = [f"{base + int(n)},{t}" for n, t in (line.split(",") for line in lines[1:])]
        (drive / sensor / "stamps.csv").write_text("\n".join([lines[0], *changed]) + "\n")
    log = open_drive(drive)
    assert [scan.number - base for scan in log.scans] == [0, 1, 2, 3]
    assert [image.number - base for image in log.images] == [0, 1, 2, 3]
    assert not log.skips
    trial("names")
