"""A finished run with other labels: what a run with those labels makes, where it was."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_runs import files, run
from street import Street

from gnss_sem_map import Run
from gnss_sem_map.runs.classifier_fitting import fit_classifier
from gnss_sem_map.voxels.semantic_map import State


def test_relabelled_it_is_what_a_run_with_those_labels_makes(
    finished: Run, small_drive: Street, tmp_path: Path
) -> None:
    bare = run(small_drive.drive, tmp_path / "bare", write_labels=True, force=True)
    again = bare.relabel(f"labels:{small_drive.labels}", tmp_path / "again")
    for name in ("map", "refined", "labels", "removed", "evidence/moved"):
        assert files(again.folder / name) == files(finished.folder / name), name
    assert again.about["inputs"]["segmenter"] == finished.about["inputs"]["segmenter"]


@pytest.mark.slow
def test_relabelled_it_says_what_a_run_with_those_labels_says_of_them(
    small_drive: Street, tmp_path: Path
) -> None:
    labels = shutil.copytree(small_drive.labels, tmp_path / small_drive.drive.name)
    sorted(labels.iterdir())[3].unlink()
    spec = f"labels:{tmp_path}/{{drive}}"
    bare = run(small_drive.drive, tmp_path / "bare", force=True)
    again = bare.relabel(spec, tmp_path / "again")
    once = run(small_drive.drive, tmp_path / "once", spec, force=True)
    for name in ("skips", "inputs"):
        assert again.about[name] == once.about[name], name
    assert not any("geometry only" in said for said in again.about["warnings"])


@pytest.mark.slow
def test_class_names_that_nobody_knows_are_said_once(small_drive: Street, tmp_path: Path) -> None:
    labels = shutil.copytree(small_drive.labels, tmp_path / "labels")
    for path in labels.iterdir():
        with np.load(path) as content:
            names = ["blimp" if name == "other" else name for name in content["class_names"].tolist()]
            np.savez_compressed(path, probabilities=content["probabilities"], class_names=np.array(names))
    once = run(small_drive.drive, tmp_path / "once", f"labels:{labels}", force=True)
    again = run(small_drive.drive, tmp_path / "bare", force=True).relabel(
        f"labels:{labels}", tmp_path / "again"
    )
    for made in (once, again):
        said = [warning for warning in made.about["warnings"] if "blimp" in warning]
        assert len(said) == 1
        assert "1 of 6 class names are unknown and count as other: blimp" in said[0]
    assert files(again.folder / "map") == files(once.folder / "map")


@pytest.mark.slow
def test_it_warns_of_what_the_classifier_leaves_without_a_class_and_of_nothing_else(
    finished: Run, small_drive: Street, tmp_path: Path
) -> None:
    """Without labels a map has no class, but with the classifier of another drive it has."""
    bare, file = run(small_drive.drive, tmp_path / "bare", force=True), tmp_path / "classifier.npz"
    file.write_bytes(fit_classifier([finished.folder])[0].to_bytes())
    named = bare.settings.changed(f"geometric_classifier.model={file}")
    classified = bare.refine(named, tmp_path / "classified")
    assert (bare.map().states == State.UNOBSERVED).all()
    assert (classified.map().states == State.INFERRED).mean() > 0.9
    said = {out.folder.name: " ".join(out.about["warnings"]) for out in (bare, classified)}
    assert "no segmenter: the map shows geometry only; a classifier of drives with labels" in said["bare"]
    assert "no segmenter: all classes are those of the geometric classifier" in said["classified"]
    assert "geometry only" not in said["classified"]
    assert classified.refine(bare.settings, tmp_path / "back").about["warnings"] == bare.about["warnings"]


@pytest.mark.slow
def test_relabelled_it_stays_where_it_was(finished: Run, small_drive: Street, tmp_path: Path) -> None:
    assert finished.frame is not None
    origin = replace(finished.frame, lat_deg=finished.frame.lat_deg + 0.001)
    labels = f"labels:{small_drive.labels}"
    there = run(small_drive.drive, tmp_path / "there", labels, origin=origin, force=True)
    again = there.relabel(labels, tmp_path / "again")
    assert again.frame == origin
    for name in ("map.laz", "map.gpkg", "objects.parquet"):
        assert (again.folder / name).read_bytes() == (there.folder / name).read_bytes(), name
