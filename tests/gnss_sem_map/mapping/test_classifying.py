"""Runs with a geometric classifier: what is inferred, what stays as it was, and what is said where there is none."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace
from pathlib import Path

import damage
import numpy as np
import pytest
import street_drives
from classifiers import URBAN, random_classifier
from numpy.typing import NDArray
from street import Street
from street_drives import Drives
from typer.testing import CliRunner

from gnss_sem_map import Run, Settings, run
from gnss_sem_map.cli import app
from gnss_sem_map.errors import DataError
from gnss_sem_map.mapping import classifying
from gnss_sem_map.mapping.classifying import FILE, DriveClassifier
from gnss_sem_map.runs.many_drives import HowMapped, add_drive, run_drives
from gnss_sem_map.voxels import blocks
from gnss_sem_map.voxels.semantic_map import SemanticMap, State

pytestmark = pytest.mark.integration
CLASSIFIER = Path("evidence", FILE)


def refined(out: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in (out / "refined").iterdir()}


def tiles_of(out: Path) -> dict[str, bytes]:
    return {name: content for name, content in refined(out).items() if name != "map.json"}


def inferred(of: SemanticMap) -> NDArray[np.bool_]:
    return np.asarray(of.states == State.INFERRED)


@pytest.fixture(scope="module")
def street_run(small_drive: Street, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """The small street, with intensities that tell its classes apart; read only."""
    drive = with_intensities(
        small_drive, tmp_path_factory.mktemp("drive") / small_drive.drive.parent.name, 0.2
    )
    out = tmp_path_factory.mktemp("run") / "out"
    return run(drive, out, f"labels:{small_drive.labels}", force=True)


def with_intensities(small: Street, folder: Path, unit: float) -> Path:
    """The drive with an intensity of every point of `unit` times one of five numbers that follow from its class."""
    shutil.copytree(small.drive.parent, folder)
    drive = folder / small.drive.name
    for k in small.frames:
        file = drive / f"velodyne_points/data/{k:010d}.bin"
        rows = np.fromfile(file, "<f4").reshape(-1, 4)
        noise = np.random.default_rng(k).integers(0, 2, len(rows))
        rows[:, 3] = np.float32(unit) * np.float32(0.8) * (1 + small.scan_classes[k] + noise)
        rows.tofile(file)
    return drive


@pytest.fixture(scope="module")
def plain_run(small_drive: Street, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """The small street, whose points all have one intensity; read only."""
    out = tmp_path_factory.mktemp("run") / "out"
    return run(small_drive.drive, out, f"labels:{small_drive.labels}", force=True)


@pytest.fixture(scope="module")
def model(street_run: Run, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file of `fit-classifier`."""
    file = tmp_path_factory.mktemp("model") / "street.npz"
    done = CliRunner().invoke(app, ["fit-classifier", str(street_run.folder), "-o", str(file)])
    assert done.exit_code == 0, done.output
    assert done.output.endswith(f"fitted to 1 drives; now use --set geometric_classifier.model={file}\n")
    return file


def test_voxels_that_no_image_shows_get_the_class_they_have(street_run: Run) -> None:
    found = street_run.map()
    chosen = inferred(found)
    assert chosen.sum() > 5000
    assert not found.voxels.observed[chosen].any()
    y, z = np.abs(found.voxels.centres[:, 1]), found.voxels.centres[:, 2]
    place = {"building": (y > 7.9) & (z > 0.6), "road": (y < 3.5) & (z < 0.2)}
    for name, where in place.items():
        right = found.labels[chosen & where] == URBAN.index(name)
        assert len(right) > 300
        assert right.mean() > 0.95, name
    assert ((found.confidence > 0) == (found.labels >= 0)).all()


@pytest.mark.slow
def test_a_run_refined_again_with_the_same_settings_is_the_same(street_run: Run, tmp_path: Path) -> None:
    again = street_run.refine(street_run.settings, tmp_path / "again")
    assert refined(again.folder) == refined(street_run.folder)
    assert (again.folder / CLASSIFIER).read_bytes() == (street_run.folder / CLASSIFIER).read_bytes()


@pytest.mark.slow
def test_switched_off_and_on_again(street_run: Run, tmp_path: Path) -> None:
    out = Path(shutil.copytree(street_run.folder, tmp_path / "out"))
    for value in ("false", "true"):
        done = CliRunner().invoke(app, ["refine", str(out), "--set", f"geometric_classifier.enabled={value}"])
        assert done.exit_code == 0, done.output
        found = Run.open(out).map()
        if value == "false":
            assert not inferred(found).any()
            assert set(np.unique(found.labels)) <= set(range(-1, 5))
            assert (found.labels[~found.voxels.observed & (found.states != State.REMOVED)] == -1).all()
    assert refined(out) == refined(street_run.folder)


@pytest.mark.slow
def test_a_damaged_classifier_is_made_again(street_run: Run, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(street_run.folder, tmp_path / "copy"))
    damage.halved(copy / CLASSIFIER)
    out = Run.open(copy).refine(street_run.settings, tmp_path / "out").folder
    assert (out / CLASSIFIER).read_bytes() == (street_run.folder / CLASSIFIER).read_bytes()
    assert refined(out) == refined(street_run.folder)


@pytest.mark.slow
def test_a_named_classifier_is_used_in_place_of_the_own_one(
    street_run: Run, model: Path, tmp_path: Path
) -> None:
    out, other = tmp_path / "out", tmp_path / "other.npz"
    other.write_bytes(random_classifier(1).to_bytes())
    found = {}
    for file in (model, other):
        words = ["refine", str(street_run.folder), "-o", str(out / file.stem), "--set"]
        done = CliRunner().invoke(app, [*words, f"geometric_classifier.model={file}"])
        assert done.exit_code == 0, done.output
        found[file] = tiles_of(out / file.stem)
    # of one drive, both learn the same from the same rows
    a, b = (Run.open(folder).map() for folder in (street_run.folder, out / model.stem))
    np.testing.assert_array_equal(a.labels, b.labels)
    np.testing.assert_array_equal(a.confidence, b.confidence)
    assert found[other] != found[model]
    other.unlink()
    moved = Run.open(Path(shutil.move(out / "other", tmp_path / "delivered")))
    again = moved.refine(moved.settings, tmp_path / "again")
    assert tiles_of(again.folder) == found[other], "the run has its own copy"


@pytest.mark.slow
def test_without_labels_of_images_a_named_classifier_gives_all_classes(
    street_run: Run, model: Path, tmp_path: Path
) -> None:
    drive = Path(street_run.about["inputs"]["drive"])
    bare = run(drive, tmp_path / "bare", force=True)
    assert not (bare.map().labels >= 0).any()
    (said,) = [line for line in bare.about["warnings"] if "classifier" in line]
    assert said.startswith("no segmenter: the map shows geometry only; ")
    assert "--set geometric_classifier.model=FILE of `gnss-sem-map fit-classifier`" in said
    settings = Settings().changed(f"geometric_classifier.model={model}")
    named = bare.refine(settings, tmp_path / "named")
    found = named.map()
    standing = found.states != State.REMOVED
    assert (found.states[standing] == State.INFERRED).all()
    assert len(np.unique(found.labels[standing])) > 3
    assert [line for line in named.about["warnings"] if "classifier" in line] == [
        "no segmenter: all classes are those of the geometric classifier"
    ]
    made = run(drive, tmp_path / "made", settings=settings, force=True)
    assert refined(made.folder) == refined(named.folder)


@pytest.mark.slow
def test_a_classifier_of_intensities_is_left_out_where_there_are_none(
    plain_run: Run, street_run: Run, model: Path, tmp_path: Path
) -> None:
    with_model = plain_run.settings.changed(f"geometric_classifier.model={model}")
    without = plain_run.settings.changed("geometric_classifier.enabled=false")
    a, b = (plain_run.refine(one, tmp_path / str(k)) for k, one in enumerate((with_model, without)))
    assert tiles_of(a.folder).keys() == tiles_of(b.folder).keys()
    for name in ("labels", "states", "confidence"):
        np.testing.assert_array_equal(getattr(a.map(), name), getattr(b.map(), name))
    says = "its scans have no intensities, as those that street.npz was fitted to: only what images show has a class"
    new = [line for line in a.about["warnings"] if line not in plain_run.about["warnings"]]
    assert new == [says]
    own = a.refine(plain_run.settings)
    assert own.about["warnings"] == plain_run.about["warnings"], "what is no longer true is not said"
    assert refined(own.folder) == refined(plain_run.folder)


@pytest.mark.slow
@pytest.mark.parametrize("size_m", [3.0, 0.2])
def test_too_few_labels_and_one_class_are_said_and_all_else_is_as_without(
    size_m: float, small_drive: Street, tmp_path: Path
) -> None:
    """Large voxels are few; and of the others all are road."""
    folder = tmp_path / "labels"
    shutil.copytree(small_drive.labels, folder)
    for file in folder.iterdir() if size_m == 0.2 else ():
        with np.load(file) as content:
            arrays = dict(content)
        arrays["probabilities"][:] = [255, 0, 0, 0, 0, 0]
        np.savez_compressed(file, **arrays)
    made = {}
    for enabled in ("true", "false"):
        settings = Settings().changed(
            f"geometric_classifier.enabled={enabled}", f"mapping.voxel_size_m={size_m}"
        )
        out = tmp_path / enabled
        made[enabled] = run(small_drive.drive, out, f"labels:{folder}", settings, force=True, frames="0:6")
    whole, without = made["true"], made["false"]
    (said,) = [line for line in whole.about["warnings"] if line not in without.about["warnings"]]
    why = (
        r"images label \d+ voxels, too few to learn from"
        if size_m == 3
        else "images know one class only, so there is nothing to learn"
    )
    assert re.fullmatch(f"{why}: only what images show has a class", said)
    for name in ("labels", "states", "confidence"):
        np.testing.assert_array_equal(getattr(whole.map(), name), getattr(without.map(), name))


@pytest.mark.slow
@pytest.mark.parametrize("unit", [0.1, 0.01])
def test_intensities_of_another_scale_have_the_same_ranks_as_far_as_they_are_told_apart(
    unit: float, street_run: Run, small_drive: Street, tmp_path: Path
) -> None:
    """Levels of intensity are whole numbers up to 255: as long as no two become one, all files of the map are equal."""
    drive = with_intensities(small_drive, tmp_path / "drive", unit)
    scaled = run(drive, tmp_path / "out", f"labels:{small_drive.labels}", force=True)
    a, b = street_run.map(), scaled.map()
    if unit == 0.1:
        assert (scaled.folder / CLASSIFIER).read_bytes() == (street_run.folder / CLASSIFIER).read_bytes()
        assert refined(scaled.folder) == refined(street_run.folder)
    else:
        assert (a.labels == b.labels).mean() > 0.97


def test_rows_and_evidence_do_not_depend_on_how_the_map_is_cut(
    street_run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = DriveClassifier(street_run.folder, street_run.settings)
    of_blocks = blocks.blocks_of(dict.fromkeys(whole._raw.fused.tiles, 0))
    rows, said = whole.rows(), [whole.geometric_evidence(block, 0) for block in of_blocks]
    monkeypatch.setattr(blocks, "MOST_VOXELS", -1)
    of_tiles = blocks.blocks_of(dict.fromkeys(whole._raw.fused.tiles, 0))
    assert len(of_tiles) > len(of_blocks)
    monkeypatch.setattr(classifying, "blocks_of", lambda voxels: list(reversed(of_tiles)))
    again = DriveClassifier(street_run.folder, street_run.settings)
    found = again.rows()
    for name in ("order", "classes", "weights", "features"):
        np.testing.assert_array_equal(getattr(found, name), getattr(rows, name))
    parts = [again.geometric_evidence(tile, 0) for tile in of_tiles]
    order_a, order_b = (
        np.argsort(np.concatenate([one.keys for one in each if one])) for each in (said, parts)
    )
    sums_a, sums_b = (np.concatenate([one.sums for one in each if one]) for each in (said, parts))
    np.testing.assert_array_equal(sums_a[order_a], sums_b[order_b])


@pytest.mark.parametrize("wrong", ["classes", "voxels", "bytes"])
def test_a_classifier_that_does_not_fit_is_refused_before_the_work(
    wrong: str, small_drive: Street, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "model.npz"
    of = random_classifier(size_m=0.1 if wrong == "voxels" else 0.2)
    of = replace(of, names=("road", "lawn", *of.names[2:])) if wrong == "classes" else of
    file.write_bytes(b"no" if wrong == "bytes" else of.to_bytes())
    settings = Settings().changed(f"geometric_classifier.model={file}")
    monkeypatch.setattr("gnss_sem_map.runs.drive_tasks.first_trajectory", None)
    with pytest.raises(DataError, match=r"model\.npz: (is of|cannot be used)") as refused:
        run(small_drive.drive, tmp_path / "out", f"labels:{small_drive.labels}", settings, force=True)
    assert "\n" not in str(refused.value)
    assert not (tmp_path / "out").exists()


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> Drives:
    """Two drives of one street."""
    return street_drives.write(tmp_path_factory.mktemp("drives"), ("a", "b"))


@pytest.fixture(scope="module")
def both(drives: Drives, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Their map, made by one process; read only."""
    out = tmp_path_factory.mktemp("both") / "out"
    run_drives(list(drives.by_name.values()), out, Settings(), HowMapped(drives.labels, force=True))
    assert inferred(Run.open(out).map()).sum() > 1000
    return out


@pytest.mark.slow
def test_two_processes_make_the_same_map(drives: Drives, both: Path, tmp_path: Path) -> None:
    places, how = list(drives.by_name.values()), HowMapped(drives.labels, force=True)
    run_drives(places, tmp_path / "out", Settings(), how, workers=2)
    assert refined(tmp_path / "out") == refined(both)
    for name in "ab":
        of_drive = Path("drives", name) / CLASSIFIER
        assert (tmp_path / "out" / of_drive).read_bytes() == (both / of_drive).read_bytes()


@pytest.mark.slow
def test_an_added_drive_leaves_the_classifier_of_the_first_alone(
    drives: Drives, both: Path, tmp_path: Path
) -> None:
    out, how = tmp_path / "out", HowMapped(drives.labels, force=True)
    run_drives([drives.by_name["a"]], out, Settings(), how)
    first = (out / "drives/a" / CLASSIFIER).stat()
    add_drive(out, drives.by_name["b"], how)
    after = (out / "drives/a" / CLASSIFIER).stat()
    assert (after.st_ino, after.st_mtime_ns) == (first.st_ino, first.st_mtime_ns)
    assert refined(out) == refined(both)


@pytest.mark.slow
def test_drives_of_one_kind_make_one_classifier_and_others_are_refused(
    both: Path, street_run: Run, tmp_path: Path
) -> None:
    file = tmp_path / "both.npz"
    done = CliRunner().invoke(app, ["fit-classifier", str(both), "-o", str(file)])
    assert done.exit_code == 0, done.output
    assert "fitted to 2 drives" in done.output
    before = file.read_bytes()
    again = CliRunner().invoke(app, ["fit-classifier", str(both), "-o", str(file)])
    assert again.exit_code == 0
    assert file.read_bytes() == before
    note = tmp_path / "note.npz"
    np.savez(note, note=np.arange(3))
    kept = note.read_bytes()
    mixed = CliRunner().invoke(app, ["fit-classifier", str(both), str(street_run.folder), "-o", str(file)])
    wrong = CliRunner().invoke(app, ["fit-classifier", str(both), "-o", str(note)])
    for failed, says in ((mixed, "fit a classifier to drives of one kind"), (wrong, "choose another -o")):
        assert isinstance(failed.exception, DataError)
        assert says in str(failed.exception)
        assert "\n" not in str(failed.exception)
    assert note.read_bytes() == kept
    assert file.read_bytes() == before


@pytest.mark.slow
def test_runs_without_labels_teach_nothing(street_run: Run, tmp_path: Path) -> None:
    drive = Path(street_run.about["inputs"]["drive"])
    bare = run(drive, tmp_path / "bare", force=True, frames="0:6")
    failed = CliRunner().invoke(app, ["fit-classifier", str(bare.folder), "-o", str(tmp_path / "new.npz")])
    assert str(failed.exception) == (
        "fit-classifier: images label nothing; give runs that were made with --segmenter"
    )
    assert not (tmp_path / "new.npz").exists()
