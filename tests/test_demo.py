"""The demo as a newcomer runs it, on a shorter drive, and its scores against the exact truth."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from commands import gnss_sem_map, in_a_process

from gnss_sem_map.errors import how_to_install


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, str]:
    """Folder of the run, folder of the truth, and what was printed."""
    out = tmp_path_factory.mktemp("demo") / "demo"
    done = in_a_process("demo", "-o", out, "--seconds", "3", "--seed", "1")
    assert done.returncode == 0, done.stderr
    (drive,) = (out.parent / "demo_drive").glob("*/*_sync")
    return out, drive / "truth", done.stdout


@pytest.mark.slow
def test_the_demo_leaves_every_figure(demo: tuple[Path, Path, str]) -> None:
    out, _, _ = demo
    metrics = json.loads((out / "metrics.json").read_text())
    for stage in ("raw", "refined"):
        figures = metrics["semantics"][stage]
        assert set(figures) >= {"mean_accuracy", "mean_iou", "coverage", "classes"}
        assert list(figures["classes"]) == ["road", "sidewalk", "vehicle", "building", "vegetation"]
        assert 0 < figures["mean_iou"] <= figures["mean_accuracy"] <= 1
    refined = metrics["semantics"]["refined"]
    assert refined["seen"]["mean_iou"] > metrics["semantics"]["raw"]["mean_iou"]
    assert refined["seen"]["points"] + refined["unseen"]["points"] == refined["points"]
    assert refined["unseen"]["coverage"] < refined["coverage"] < refined["seen"]["coverage"]
    assert 0 < refined["open"] <= refined["strict"]["mean_iou"] <= refined["mean_iou"]
    assert set(metrics["dynamic"]) >= {"SA", "DA", "AA"}
    assert metrics["trajectory"]["ate_m"] < 2.0
    for part in ("position", "orientation"):  # one short drive is one sample of three degrees of freedom
        assert 0 < metrics["trajectory"][f"{part}_nees_per_dof"] < 10
    assert 0 <= metrics["calibration"]["ece"] < 0.2


@pytest.mark.slow
def test_the_demo_says_what_it_did_and_where_the_pictures_are(demo: tuple[Path, Path, str]) -> None:
    out, _, printed = demo
    for says in (
        "sidewalk",
        "moving vehicles removed",
        "trajectory",
        "NEES per degree of freedom",
        "refinement",
        "mapping",
        "small network",
    ):
        assert says in printed, says
    for name in ("flight.webp", "perspective.png", "topview.png", "report.html", "viewer.html"):
        assert str(out / name) in printed
        assert (out / name).stat().st_size > 10_000
    (costs,) = (line for line in printed.splitlines() if "mapping " in line)  # every stage once
    for stage in ("simulate", "segment", "trajectory", "mapping", "refinement", "export"):
        assert costs.count(f"{stage} ") == 1


WITHOUT_TORCH = """
import importlib.util, sys

class Absent:
    def find_spec(self, name, *_):
        if name == "torch":
            raise ModuleNotFoundError("No module named 'torch'", name="torch")

sys.meta_path.insert(0, Absent())
find_spec = importlib.util.find_spec
importlib.util.find_spec = lambda name: None if name == "torch" else find_spec(name)
from gnss_sem_map.cli import main
main()
"""


def demo_without_torch(*words: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", WITHOUT_TORCH, "demo", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.mark.slow
def test_a_missing_package_is_named_before_anything_is_simulated(tmp_path: Path) -> None:
    done = demo_without_torch("-o", tmp_path / "demo", "--labels", "network")
    assert done.returncode == 1
    assert f"torch is not installed; {how_to_install('segmentation')}" in done.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_the_corrupted_truth_can_stand_in_for_the_network(
    demo: tuple[Path, Path, str], tmp_path: Path
) -> None:
    out = tmp_path / "demo"
    done = gnss_sem_map("demo", "-o", out, "--seconds", "3", "--seed", "1", "--labels", "corrupted")
    assert done.returncode == 0, done.stderr
    assert "true class images, corrupted" in done.stdout
    ours, theirs = (json.loads((run / "metrics.json").read_text()) for run in (out, demo[0]))
    assert ours["trajectory"] == theirs["trajectory"]  # the same drive
    assert ours["semantics"] != theirs["semantics"]


@pytest.mark.slow
def test_scores_agree_with_the_independent_scorer(
    demo: tuple[Path, Path, str], real_data: Path, tmp_path: Path
) -> None:
    out, truth, _ = demo
    (tmp_path / "labels").mkdir()
    for file in (out / "labels").iterdir():  # the scorer knows no `other`, which it counts as unlabelled
        labels = np.fromfile(file, np.uint32)
        np.where(labels == 99, 0, labels).astype(np.uint32).tofile(tmp_path / "labels" / file.name)
    subprocess.run(
        [
            sys.executable, real_data.parent / "score.py", tmp_path / "labels", truth / "labels",
            "--json", tmp_path / "s.json",
        ],
        check=True, capture_output=True,
    )  # fmt: skip
    theirs = json.loads((tmp_path / "s.json").read_text())["POOLED"]
    ours = json.loads((out / "metrics.json").read_text())["semantics"]["refined"]
    assert ours["mean_iou"] == theirs["observed"]["mean_iou"]
    assert ours["mean_accuracy"] == theirs["observed"]["mean_accuracy"]
    assert ours["coverage"] == theirs["coverage"]
    assert ours["strict"]["mean_iou"] == theirs["strict"]["mean_iou"]


@pytest.mark.slow
def test_a_run_can_be_scored_again_on_fewer_points(demo: tuple[Path, Path, str]) -> None:
    out, truth, _ = demo
    done = gnss_sem_map("evaluate", out, "--truth", truth, "--restrict-to", truth / "single_frame", "--json")
    assert done.returncode == 0, done.stderr
    restricted = json.loads(done.stdout)["semantics"]["refined"]
    whole = gnss_sem_map("evaluate", out, "--truth", truth, "--json")
    everything = json.loads(whole.stdout)["semantics"]["refined"]
    assert restricted["points"] < everything["points"]
    assert restricted["coverage"] > everything["coverage"]
    printed = gnss_sem_map("evaluate", out, "--truth", truth)
    of_all = f"all points coverage {100 * everything['coverage']:.1f} %, strict mean IoU"
    assert of_all in " ".join(printed.stdout.split())


def test_a_folder_that_no_demo_wrote_is_left_alone(tmp_path: Path) -> None:
    precious = tmp_path / "mine_drive" / "precious.txt"
    precious.parent.mkdir()
    precious.write_text("years of work")
    done = gnss_sem_map("demo", "-o", tmp_path / "mine", "--seconds", "3")
    assert done.returncode == 1
    assert "precious.txt" in done.stderr
    assert "choose another -o" in done.stderr
    assert precious.read_text() == "years of work"


@pytest.mark.slow
def test_a_truth_that_does_not_fit_is_refused(demo: tuple[Path, Path, str], tmp_path: Path) -> None:
    out, truth, _ = demo
    shutil.copytree(truth / "labels", tmp_path / "labels")
    victim = sorted((tmp_path / "labels").iterdir())[4]
    np.fromfile(victim, "<u4")[:-1].tofile(victim)
    for says, change in (
        (f"{victim.stem}.label: found", None),
        ("no truth for 1 of 30 scans", victim.unlink),
    ):
        if change is not None:
            change()
        done = gnss_sem_map("evaluate", out, "--truth", tmp_path)
        assert done.returncode == 1
        assert says in done.stderr
    done = gnss_sem_map("evaluate", out, "--truth", out / "map")
    assert done.returncode == 1
    assert "no .label files" in done.stderr
    assert done.stderr.count("\n") == 1
