"""A finished run is an object: its map is read by box, refined again and exported."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from html import unescape
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pyogrio
import pytest
from small_runs import files, run
from street import Street
from typer.testing import CliRunner

from gnss_sem_map import Run, Settings
from gnss_sem_map.cli import app
from gnss_sem_map.cli.options import delivered_in
from gnss_sem_map.config import DeliverySettings
from gnss_sem_map.errors import ConfigError, DataError
from gnss_sem_map.files.output_folder import locked, new_folder
from gnss_sem_map.files.ownership import MARKER, amend
from gnss_sem_map.files.run_json import read_run
from gnss_sem_map.mapping import point_labels
from gnss_sem_map.mapping.evidence import read_moving_points, write_moving_points
from gnss_sem_map.mapping.point_labels import label_points
from gnss_sem_map.refinement.steps import STEPS, RefinementReport, RefinementSettings
from gnss_sem_map.runs import calibrating, pipeline
from gnss_sem_map.runs.about import about_map
from gnss_sem_map.runs.point_label_files import LabelledDrive, write_point_labels
from gnss_sem_map.voxels import tiles
from gnss_sem_map.voxels.semantic_map import State

EXAMPLES = Path(__file__).parents[2] / "examples"


def rows_of(page: str) -> dict[str, list[str]]:
    """First cell of every row of a report -> the others."""
    rows = (
        re.findall(r"<t[dh][^>]*>(.*?)</t[dh]>", row, re.S) for row in re.findall(r"<tr.*?</tr>", page, re.S)
    )
    return {unescape(name): [unescape(cell) for cell in others] for name, *others in filter(None, rows)}


def printed_by(
    notebook: str, words: str, known: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> list[str]:
    """What a cell of a notebook prints, from the line on that has these words."""
    cells = json.loads((EXAMPLES / notebook).read_text("utf-8"))["cells"]
    [code] = [text for text in ("".join(cell["source"]) for cell in cells) if words in text]
    exec(code[code.index(words) :], known)
    return capsys.readouterr().out.splitlines()


def test_the_report_tells_of_everything_that_lies_beside_it(finished: Run) -> None:
    rows = rows_of((finished.folder / "report.html").read_text("utf-8"))
    told = {re.sub("<.*?>", "", name).rstrip("/") for name in rows}
    there = {path.name for path in finished.folder.iterdir() if not path.name.startswith(".")}
    assert there - told == {"report.html"}


@pytest.mark.slow
def test_notebooks_say_the_same_figures_as_the_report(
    finished: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    all_moved = with_refinement(finished.settings, vehicles={"method": "paper", "largest_parked_voxels": 1})
    finished = finished.refine(all_moved, tmp_path / "out")
    assert (finished.map().states == State.REMOVED).sum() > 10, "which is what may be counted by mistake"
    rows = rows_of((finished.folder / "report.html").read_text("utf-8"))
    known = {"finished": finished, "urban": finished.label_set}
    counts = printed_by("02_build_a_semantic_map.ipynb", "refined = finished.map()", known, capsys)
    assert len(counts) == len(finished.label_set.names)
    for name, count, _ in map(str.split, counts):
        assert rows[name.rstrip(":")][1] == f"{int(count):,}", "voxels, refined"
    words, known = 'for step in runs["evidence"]', {"runs": {"evidence": finished}}
    lines = printed_by("03_refine_and_evaluate.ipynb", words, known, capsys)
    steps = dict(re.findall(r"^(\w+): (\d+) voxels", "\n".join(lines), re.M))
    assert len(steps) == len(STEPS)
    for name, changed in steps.items():
        assert rows[name][0] == f"{int(changed):,}"


def with_refinement(settings: Settings, **sections: dict[str, object]) -> Settings:
    changed = settings.refinement.model_dump() | {
        name: settings.refinement.model_dump()[name] | values for name, values in sections.items()
    }
    return settings.model_copy(update={"refinement": RefinementSettings.model_validate(changed)})


def test_refined_again_with_the_same_settings_it_is_the_same_to_the_byte(
    finished: Run, tmp_path: Path
) -> None:
    again = Run.open(finished.folder).refine(finished.settings, tmp_path / "again")
    assert files(again.folder) == files(finished.folder)
    about, before = again.about, finished.about
    assert about["map"] == before["map"]
    assert about["inputs"] == before["inputs"]


def test_refined_with_another_setting_it_is_what_a_run_with_that_setting_makes(
    finished: Run, small_drive: Street, tmp_path: Path
) -> None:
    other = with_refinement(finished.settings, potts_mrf={"enabled": False}, kerbs={"enabled": False})
    again = finished.refine(other, tmp_path / "again")
    anew = run(
        small_drive.drive,
        tmp_path / "anew",
        f"labels:{small_drive.labels}",
        other,
        write_labels=True,
        force=True,
    )
    assert files(again.folder / "refined") == files(anew.folder / "refined")
    assert files(again.folder / "labels") == files(anew.folder / "labels")
    assert files(again.folder / "refined") != files(finished.folder / "refined")


@pytest.mark.slow
def test_refining_needs_no_drive_where_there_are_no_point_labels_and_works_in_place(
    finished: Run, tmp_path: Path
) -> None:
    folder = tmp_path / "run"
    finished.refine(finished.settings, folder)
    alone = Run.open(folder)
    for name in ("labels", "labels_raw", "confidence", "looks", "removed"):
        shutil.rmtree(folder / name)
    other = with_refinement(alone.settings, count_grid={"enabled": False})
    again = alone.refine(other)
    assert again.folder == folder
    assert again.settings == other
    assert not (folder / "labels").exists()


def test_what_is_more_than_refinement_is_refused(finished: Run) -> None:
    other = finished.settings.model_copy(
        update={"mapping": finished.settings.mapping.model_copy(update={"voxel_size_m": 0.4})}
    )
    with pytest.raises(ConfigError, match="mapping"):
        finished.refine(other)


def test_a_box_holds_what_lies_in_it(finished: Run) -> None:
    whole = finished.map()
    low, high = np.array([0.0, -3.0, -5.0]), np.array([8.0, 6.0, 5.0])
    part = finished.map(box=(low, high))
    inside = ((whole.voxels.centres >= low) & (whole.voxels.centres <= high)).all(axis=1)
    assert 0 < inside.sum() < len(whole)
    np.testing.assert_array_equal(part.voxels.keys, whole.voxels.keys[inside])
    np.testing.assert_array_equal(whole[inside].labels, part.labels)


def test_it_is_written_into_nothing_that_is_read(finished: Run, small_drive: Street) -> None:
    labels = f"labels:{small_drive.labels}"
    for write, place in (
        (lambda out: finished.relabel(labels, out), small_drive.drive),
        (lambda out: finished.relabel(labels, out), small_drive.labels),
        (lambda out: finished.refine(finished.settings, out), small_drive.drive),
    ):
        with pytest.raises(DataError, match=rf"out: lies in {place}.*, which is read; choose an -o outside"):
            write(place / "out")


def test_it_is_exported_again_and_nothing_of_others_is_written_over(finished: Run, tmp_path: Path) -> None:
    [laz] = finished.export(["laz"], tmp_path / "files")
    assert len(laspy.read(laz).points) == len(laspy.read(finished.folder / "map.laz").points)
    with pytest.raises(DataError, match="exists"):
        finished.export(["laz"], tmp_path / "files")
    with pytest.raises(ConfigError, match="viewer"):
        finished.export(["las"], tmp_path / "files")
    (tmp_path / "wrong.gtx").write_bytes(b"no grid")
    for delivery in (DeliverySettings(geoid=tmp_path / "wrong.gtx"), DeliverySettings(crs=2056)):
        with pytest.raises(ConfigError, match=r"delivery\."):
            finished.export(["laz"], tmp_path / "new" / "files", delivery)
    assert not (tmp_path / "new").exists()
    out = Run.open(shutil.copytree(finished.folder, tmp_path / "out"))
    before = (out.folder / "map.ply").read_bytes()
    [ply] = out.export(["ply"])
    assert ply.read_bytes() == before


def test_it_is_exported_neither_into_itself_nor_while_another_command_writes_it(
    finished: Run, tmp_path: Path
) -> None:
    out = Run.open(shutil.copytree(finished.folder, tmp_path / "out"))
    with pytest.raises(DataError, match=r"inside: lies in .*, which is read; choose an -o outside$"):
        out.export(["laz"], out.folder / "inside")
    with (
        locked(out.folder),
        pytest.raises(DataError, match=r"gnss-sem-map writes it now .*; wait for it"),
    ):
        out.export(["laz"])


def replaced(out: Path, **files: str) -> None:
    """As another command replaces a run, with the same one but for some `files`."""
    with new_folder(out) as folder:
        shutil.copytree(out, folder, dirs_exist_ok=True, ignore=shutil.ignore_patterns(MARKER))
        for name, text in files.items():
            (folder / f"{name}.yaml").write_text(text)


@pytest.mark.parametrize(
    "command",
    ["export", *(pytest.param(name, marks=pytest.mark.slow) for name in ("refine", "relabel", "calibrate"))],
)
def test_a_run_that_another_command_replaces_while_it_is_read_is_no_source(
    command: str, finished: Run, small_drive: Street, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else the map of one run and the trajectory of another would be written as one, without a word."""
    out, to = Run.open(shutil.copytree(finished.folder, tmp_path / "out")), tmp_path / "to"
    times = []

    def another(*_: object) -> None:
        if not times:
            times.append(replaced(out.folder))

    def beside(original: Callable[..., object]) -> Callable[..., object]:
        return lambda *words, **named: (another(), original(*words, **named))[1]

    for module, name in ((pipeline, "refine"), (calibrating, "open_segmenter")):
        monkeypatch.setattr(module, name, beside(getattr(module, name)))
    commands: dict[str, Callable[[], object]] = {
        "refine": lambda: out.refine(out.settings, to),
        "relabel": lambda: out.relabel(f"labels:{small_drive.labels}", to),
        "export": lambda: out.export(["ply", "laz"], to, progress=another),
        "calibrate": lambda: calibrating.calibrate([(out.folder, small_drive.labels)]),
    }
    with pytest.raises(DataError, match=r"out: was replaced by another command while it was read; run this"):
        commands[command]()
    assert [path.name for path in tmp_path.iterdir()] == ["out"] + ["to"] * (command == "export")


def test_a_run_is_refined_as_it_is_and_not_as_it_was_when_it_was_opened(
    finished: Run, tmp_path: Path
) -> None:
    out = Run.open(shutil.copytree(finished.folder, tmp_path / "out"))
    before = out.settings
    replaced(out.folder, config=before.changed("mapping.voxel_size_m=0.4").to_yaml())
    with pytest.raises(ConfigError, match="mapping differ from those of the run"):
        out.refine(before, tmp_path / "to")


def test_a_folder_without_a_map_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no run folder"):
        Run.open(tmp_path)


def test_points_of_other_have_its_id_and_run_json_counts_its_voxels(finished: Run, tmp_path: Path) -> None:
    other = len(finished.label_set.names)
    refined = finished.map()
    labels = np.where(refined.states == State.INFERRED, np.int8(other), refined.labels)
    for name in ("map", "evidence"):
        shutil.copytree(finished.folder / name, tmp_path / name)
    tiles.write(replace(refined, labels=labels), tmp_path / "refined", finished.frame)
    drive = LabelledDrive(tmp_path, finished.drive(), finished.trajectory, finished.folder / "labels_raw")
    write_point_labels(tmp_path, [drive], None, finished.settings)
    raw, after = (
        np.concatenate([np.fromfile(file, "<u4") for file in sorted(folder.glob("*.label"))])
        for folder in (finished.folder / "labels_raw", tmp_path / "labels")
    )
    assert (after == 99).sum() > 100
    assert (raw[after == 99] == 0).all(), "no image shows them"
    counted = about_map(tmp_path, RefinementReport(()))["labelled"]
    assert counted["refined"]["other"] == (labels == other).sum()
    assert counted["raw"]["other"] == 0


def test_less_sure_labels_are_left_out_of_a_file_in_a_folder_of_its_own(
    finished: Run, tmp_path: Path
) -> None:
    cut = DeliverySettings(min_confidence=0.9)
    with pytest.raises(ConfigError, match="need a folder of their own"):
        finished.export(["laz"], delivery=cut)
    [file] = finished.export(["laz"], tmp_path / "sure", cut)
    whole, sure = laspy.read(finished.folder / "map.laz"), laspy.read(file)
    kept = np.asarray(whole["confidence"]) >= np.float32(0.9)
    assert 0 < kept.sum() < len(kept)
    np.testing.assert_array_equal(sure["sem_label"], np.where(kept, whole["sem_label"], 0))
    np.testing.assert_array_equal(sure["hits"], whole["hits"])


@pytest.mark.parametrize("wrong", ["1.5", "-0.1", "nan"])
def test_a_least_confidence_beyond_0_to_1_is_one_line(wrong: str, finished: Run) -> None:
    with pytest.raises(
        ConfigError, match=r"^delivery: min_confidence: .*(less|greater) than|finite"
    ) as error:
        delivered_in(finished.settings, None, None, float(wrong))
    assert "\n" not in str(error.value)


def test_a_moved_point_that_a_scan_lacks_is_an_error(finished: Run, tmp_path: Path) -> None:
    log, maps = finished.drive(), [tiles.open_map(finished.folder / name) for name in ("map", "refined")]
    moved = tmp_path / "0.npz"
    write_moving_points({log.scans[0].number: np.array([10**6])}, moved)
    with pytest.raises(DataError, match="make the run again"):
        list(label_points(log, finished.trajectory, maps, finished.settings, [moved]))


def test_moving_points_are_read_as_scans_need_them_though_one_was_skipped(
    finished: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A scan that is in no file must not make all files be read at once."""
    log, maps = finished.drive(), [tiles.open_map(finished.folder / "refined")]
    numbers, paths, read = [scan.number for scan in log.scans], [], list[Path]()
    for start in range(0, len(numbers), 2):
        paths.append(tmp_path / f"{start // 2}.npz")
        kept = [number for number in numbers[start : start + 2] if number != numbers[0]]
        write_moving_points({number: np.array([0]) for number in kept}, paths[-1])

    def reading(path: Path) -> dict[int, Any]:
        read.append(path)
        return read_moving_points(path)

    monkeypatch.setattr(point_labels, "SCANS_AT_ONCE", 2)
    monkeypatch.setattr(point_labels, "read_moving_points", reading)
    found = []
    for scan, (labels,) in label_points(log, finished.trajectory, maps, finished.settings, paths):
        found.append(scan.number)
        assert len(read) == numbers.index(scan.number) // 2 + 1
        assert labels.removed.any() == (scan.number != numbers[0])
    assert found == numbers
    assert len(paths) >= 3


@pytest.mark.slow
def test_the_coordinates_of_all_files_change_together_and_the_map_stays(
    finished: Run, tmp_path: Path
) -> None:
    """In place nothing is written in other coordinates than those that config.yaml says.

    DHDN is known to some metres only, without a grid of it: that is a warning as long as files are in it.
    """
    delivery = finished.settings.changed("delivery.crs=25832").delivery
    with pytest.raises(ConfigError, match="need a folder of their own"):
        finished.export(["laz"], delivery=delivery)
    old_datum = finished.refine(finished.settings.changed("delivery.crs=31467"), tmp_path / "dhdn")
    assert old_datum.about["warnings"] == [*finished.about["warnings"], old_datum.about["delivery"]["doubt"]]
    again = old_datum.refine(finished.settings.changed("delivery.crs=25832"), tmp_path / "etrs89")
    assert again.about["warnings"] == finished.about["warnings"]
    assert files(again.folder / "refined") == files(finished.folder / "refined")
    assert again.about["delivery"]["epsg"] == 25832
    assert finished.about["delivery"]["heights"] == "above the WGS 84 ellipsoid"
    for name in ("map.laz", "removed.laz"):
        assert laspy.read(again.folder / name).header.parse_crs().to_epsg() == 25832
        assert laspy.read(finished.folder / name).header.parse_crs().to_epsg() == 32632
    assert pyogrio.read_info(again.folder / "map.gpkg", layer="road")["crs"] == "EPSG:25832"
    [copc] = again.export(["copc"])
    assert copc == again.folder / "map.copc.laz"
    assert len(laspy.read(copc).points) == len(laspy.read(again.folder / "map.laz").points)
    with pytest.raises(ConfigError, match=r"EPSG:27700 is for"):
        finished.refine(finished.settings.changed("delivery.crs=27700"), tmp_path / "elsewhere")


def test_an_error_of_the_report_is_blamed_on_run_json_only_where_somebody_changed_it(
    small_drive: Street, finished: Run, tmp_path: Path
) -> None:
    out = shutil.copytree(finished.folder, tmp_path / "out")
    truth = tmp_path / "truth"
    shutil.copytree(out / "labels", truth)
    wrong = json.dumps(read_run(out) | {"warnings": 5}).encode()
    amend(out, "run.json", wrong)  # as if we had written it so
    words = ["evaluate", str(out), "--truth", str(truth)]
    assert isinstance(CliRunner().invoke(app, words).exception, TypeError)
    (out / "run.json").write_bytes(wrong + b" ")
    with pytest.raises(DataError, match=r"run.json: damaged \(TypeError"):
        CliRunner().invoke(app, words, catch_exceptions=False)
