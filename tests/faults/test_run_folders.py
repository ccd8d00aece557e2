"""A run's own folder, damaged since: every command that reads it back says so in one line."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import street
from faults.harness import gnss_sem_map

from gnss_sem_map import config
from gnss_sem_map.errors import SemMapError
from gnss_sem_map.evaluation.score_run import score_run
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.mapping.raw_map import open_raw
from gnss_sem_map.runs.calibrating import calibrate
from gnss_sem_map.voxels import tiles

RAW_IDS = {street.ROAD: 40, street.SIDEWALK: 48, street.VEHICLE: 10, street.BUILDING: 50}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A run of the small street with its point labels, and the truth."""
    folder = tmp_path_factory.mktemp("run")
    drive = street.write(folder)
    outcome = gnss_sem_map(
        "run", drive.drive, "--segmenter", f"labels:{drive.labels}", "-o", folder / "out", "--write-labels",
        "--force", folder=folder / "process",
    )  # fmt: skip
    assert outcome.code == 0, outcome
    (folder / "truth").mkdir()
    for number, classes in drive.scan_classes.items():
        ids = np.vectorize(RAW_IDS.get)(classes).astype("<u4")
        ids.tofile(folder / "truth" / f"{number:010d}.label")
    return folder / "out", folder / "truth"


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def _flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 8
    path.write_bytes(content)


def _empty(path: Path) -> None:
    path.write_bytes(b"")


def _lost(path: Path) -> None:
    path.unlink()


def _noise(path: Path) -> None:
    path.write_bytes(np.random.default_rng(0).bytes(3001))


def _folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


def _pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def _list(path: Path) -> None:
    path.write_text("[1, 2, 3]")


def _other_types(path: Path) -> None:
    content = json.loads(path.read_text()) if path.suffix == ".json" else {"a": 1}
    path.write_text(json.dumps({name: [1, "x"] for name in content}))


DAMAGES = [_cut, _flip, _empty, _lost, _noise, _folder, _pipe, _list, _other_types]
FILES = [
    "run.json", "config.yaml", "metrics.json", "trajectory.parquet", "map/map.json", "map/TILE", "refined/map.json",
    "refined/TILE", "labels/0000000003.label", "labels_raw/0000000003.label", "confidence/0000000003.bin",
    "looks/0000000003.bin", "removed/0000000003.label", "attributes/TILE",
]  # fmt: skip


def _damaged(out: Path, name: str, damage: Callable[[Path], None], folder: Path) -> Path:
    copy = folder / "out"
    shutil.copytree(out, copy)
    path = min((copy / name).parent.glob("*.parquet")) if name.endswith("TILE") else copy / name
    damage(path)
    return copy


@pytest.mark.slow
@pytest.mark.parametrize(
    "damage",
    DAMAGES,
    ids=lambda damage: damage.__name__,
)
@pytest.mark.parametrize("name", FILES)
def test_a_damaged_run_gives_our_own_errors(name, damage, made, trial, tmp_path: Path) -> None:
    out, truth = made
    copy = _damaged(out, name, damage, tmp_path)
    said = []
    for read in (
        lambda: score_run(copy, truth),
        lambda: config.load(copy / "config.yaml"),
        lambda: tiles.read(copy / "map"),
        lambda: open_raw(copy, open_label_set()).fused.whole(),
    ):
        try:
            read()
        except SemMapError as error:
            said.append(str(error))
    faults = [f"{len(text.splitlines())} lines" for text in said if len(text.splitlines()) != 1]
    trial("run folders", faults, said)


@pytest.mark.faults
@pytest.mark.parametrize("damage", DAMAGES, ids=lambda damage: damage.__name__)
@pytest.mark.parametrize("name", FILES[:8])
def test_a_command_says_in_one_line_that_a_run_is_damaged(name, damage, made, trial, tmp_path: Path) -> None:
    out, truth = made
    copy = _damaged(out, name, damage, tmp_path)
    for number, words in enumerate((
        ("evaluate", copy, "--truth", truth),
        ("refine", copy, "-o", tmp_path / "again"),
        ("calibrate", copy, "--truth", truth, "-o", tmp_path / "calibration.yaml"),
    )):  # fmt: skip
        outcome = gnss_sem_map(*words, folder=tmp_path / f"process{number}")
        trial("run folders", outcome.faults, outcome)


@pytest.mark.slow
def test_a_python_segmenter_that_only_a_run_names_is_not_opened(made, trial, tmp_path: Path) -> None:
    out, truth = made
    copy = tmp_path / "out"
    shutil.copytree(out, copy)
    about = json.loads((copy / "run.json").read_text())
    about["inputs"]["segmenter"] = "python:foreign_code:look"
    (copy / "run.json").write_text(json.dumps(about))
    (tmp_path / "foreign_code.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')\n")
    outcome = gnss_sem_map(
        "calibrate",
        copy,
        "--truth",
        truth,
        "-o",
        tmp_path / "c.yaml",
        folder=tmp_path / "process",
        cwd=tmp_path,
    )
    assert outcome.code == 1
    assert "which is code to run; say --segmenter" in outcome.err
    assert not (tmp_path / "ran").exists()
    trial("run folders", outcome.faults, outcome)
    with pytest.raises(SemMapError, match="No module named 'foreign_code'"):
        calibrate([(copy, truth)], segmenter="python:foreign_code:look")
