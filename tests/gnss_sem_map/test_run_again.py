"""From the command line: a run that is killed and resumed, or shared by processes."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest
from commands import gnss_sem_map
from street import Street

from gnss_sem_map.voxels import map_json, tiles
from gnss_sem_map.voxels.blocks import blocks_of


def run_of(small_drive: Street, out: Path, *more: str, labels: str | None = None) -> list[str | Path]:
    return [
        "run",
        small_drive.drive,
        "--segmenter",
        labels or f"labels:{small_drive.labels}",
        "-o",
        out,
        *more,
    ]


KILLED = 137
ONE_PROCESS = ("--workers", "1")
"""The command dies, not a process that it has started, on a machine with many cores too."""
LIVE = (
    "--set",
    "dynamics.window_scans=2",
    "--set",
    "mapping.voxel_size_m=0.1",
    "--write-labels",
    *ONE_PROCESS,
)
"""With tiles of 51 m: some are refined together, and some alone."""
SMALL = ("--set", "dynamics.window_scans=1", *ONE_PROCESS)
"""Two scans in a chunk."""
COMMAND = """
import os, re, sys

tiles = 0

def look(event, details):
    global tiles
    if event != "os.rename":
        return
    name = os.path.basename(os.fsdecode(details[1]))
    if name.isdecimal():
        if name == os.environ.get("die_before_chunk"):
            os._exit(137)
        with open("chunks", "a") as file:
            print(name, os.getpid(), file=file)
    if re.fullmatch(r"-?\\d+_-?\\d+[.]json", name):
        if str(tiles) == os.environ.get("die_after_tiles"):
            os._exit(137)
        tiles += 1
        with open("tiles", "a") as file:
            print(name, file=file)

sys.addaudithook(look)  # in the processes that map too: they run this file when they start
if __name__ == "__main__":
    from gnss_sem_map.cli import main
    main()
"""
NETWORK = """
import hashlib, os
from pathlib import Path
import numpy as np

SHADES = np.array([90, 150, 40, 200, 120, 230])
answered = 0

def look(pixels):
    global answered
    answered += 1
    if str(answered) == os.environ.get("die_at_question"):
        os._exit(137)
    with open("asked", "a") as file:
        print(hashlib.sha256(pixels.tobytes()).hexdigest(), file=file)
    classes = np.abs(pixels[:, :, :1].astype(int) - SHADES).argmin(axis=2)
    return np.where(np.arange(6) == classes[:, :, None], 0.85, 0.03).astype(np.float32)

look.class_names = ["road", "sidewalk", "vehicle", "building", "vegetation", "other"]
"""


@dataclass(frozen=True)
class Watched:
    """How a command ended, and what it did on the way."""

    code: int
    err: str
    chunks: list[int]
    """Numbers of the chunks of scans that it mapped and put away."""
    processes: list[int]
    """The process that mapped each."""
    tiles: list[str]
    """Records of the tiles that it refined."""
    asked: list[str]
    """A checksum of every image that the network answered."""


def watched(folder: Path, words: Sequence[str | Path], **dies: int) -> Watched:
    """Run a command that may ask the network `python:network:look`, and that dies when `dies` says."""
    folder.mkdir()
    (folder / "command.py").write_text(COMMAND)
    (folder / "network.py").write_text(NETWORK)
    done = subprocess.run(
        [sys.executable, "command.py", *map(str, words)], cwd=folder, capture_output=True, text=True, check=False,
        env=os.environ | {name: str(number) for name, number in dies.items()},
    )  # fmt: skip
    lines = {
        name: path.read_text().split() if (path := folder / name).exists() else []
        for name in ("chunks", "tiles", "asked")
    }
    numbers = list(map(int, lines["chunks"]))
    return Watched(done.returncode, done.stderr, numbers[::2], numbers[1::2], lines["tiles"], lines["asked"])


def results_of(out: Path) -> dict[str, bytes]:
    """What a run must give again, byte for byte."""
    folders = ("map", "refined", "labels", "labels_raw", "removed", "confidence", "looks")
    files = [path for name in folders for path in (out / name).rglob("*") if path.is_file()]
    return {str(path.relative_to(out)): path.read_bytes() for path in [*files, *out.glob("trajectory*")]}


@pytest.fixture(scope="module")
def whole(small_drive: Street, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("whole") / "out"
    done = gnss_sem_map(*run_of(small_drive, out, *SMALL))
    assert done.returncode == 0, done.stderr
    assert [path.name for path in out.parent.iterdir()] == ["out"], "nothing stays beside the results"
    return out


def assert_same_maps(a: Path, b: Path) -> None:
    for name in ("map", "refined"):
        files = sorted(path.name for path in (a / name).iterdir())
        assert files == sorted(path.name for path in (b / name).iterdir())
        for file in files:
            assert (a / name / file).read_bytes() == (b / name / file).read_bytes(), file


def test_a_killed_run_is_resumed_by_two_processes_and_keeps_what_it_had(
    small_drive: Street, whole: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    died = watched(tmp_path / "first", run_of(small_drive, out, *SMALL), die_before_chunk=1)
    assert died.code == KILLED
    assert died.chunks == [0]
    assert not out.exists()
    resumed = watched(tmp_path / "second", run_of(small_drive, out, *SMALL, "--resume", "--workers", "2"))
    assert resumed.code == 0, resumed.err
    assert sorted(resumed.chunks) == [1, 2, 3, 4, 5], "the chunk that was there is mapped again"
    assert len(set(resumed.processes)) == 2
    assert_same_maps(out, whole)


@pytest.mark.slow
def test_a_run_that_is_killed_while_it_is_refined_keeps_the_blocks_that_it_had(
    small_drive: Street, live: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    words = run_of(small_drive, out, *LIVE, labels="python:network:look")
    voxels = {
        map_json.tile_of(name): about["voxels"] for name, about in map_json.files_of(live / "map").items()
    }
    blocks = {block[0]: block for block in blocks_of(voxels)}
    first = blocks[tiles.z_order(blocks)[0]]
    died = watched(tmp_path / "first", words, die_after_tiles=len(first) + 1)
    assert died.code == KILLED
    assert len(died.tiles) == len(first) + 1
    resumed = watched(tmp_path / "second", [*words, "--resume"])
    assert resumed.code == 0, resumed.err
    of_first = {Path(map_json.name_of(tile)).with_suffix(".json").name for tile in first}
    assert of_first < {*died.tiles}
    assert resumed.tiles
    assert not {*resumed.tiles} & of_first, "a block that was there is refined again"
    assert len(resumed.tiles) == len(voxels) - len(first)
    assert results_of(out) == results_of(live)


@pytest.fixture(scope="module")
def live(small_drive: Street, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An uninterrupted run that asks a network of its own."""
    out = tmp_path_factory.mktemp("live") / "out"
    done = watched(out.with_name("trial"), run_of(small_drive, out, *LIVE, labels="python:network:look"))
    assert done.code == 0, done.err
    assert len(done.asked) == len(set(done.asked)) == len(small_drive.frames)
    return out


@pytest.mark.slow
@pytest.mark.parametrize(
    ("moment", "before"),
    [
        pytest.param({"die_at_question": 7}, 6, id="asking"),
        pytest.param({"die_before_chunk": 2}, 12, id="mapping"),
    ],
)
def test_a_resumed_run_asks_the_network_for_no_image_twice(
    moment: dict[str, int], before: int, small_drive: Street, live: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    words = run_of(small_drive, out, *LIVE, labels="python:network:look")
    died = watched(tmp_path / "first", words, **moment)
    assert died.code == KILLED
    assert len(died.asked) == before
    resumed = watched(tmp_path / "second", [*words, "--resume"])
    assert resumed.code == 0, resumed.err
    asked = died.asked + resumed.asked
    assert len(asked) == len(set(asked)) == len(small_drive.frames)
    assert results_of(out) == results_of(live)
