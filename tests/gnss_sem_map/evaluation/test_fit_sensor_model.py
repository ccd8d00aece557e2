"""A network that errs in a known way, on the small street: what it does is measured, and the map corrects it."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from chunks import build_maps
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.special import softmax
from street import NAMES, Street, write_table_log
from typer.testing import CliRunner

from gnss_sem_map.cli import app
from gnss_sem_map.config import Settings
from gnss_sem_map.datasets import open_drive
from gnss_sem_map.datasets.label_files import label_files
from gnss_sem_map.errors import ConfigError, DataError
from gnss_sem_map.evaluation.fit_sensor_model import fit_temperature, measure
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.labels.sensor_model import LabelCalibration, read
from gnss_sem_map.mapping.labelled_scans import Drive
from gnss_sem_map.process.run_stats import RunStats
from gnss_sem_map.runs.calibrating import calibrate, drive_and_map
from gnss_sem_map.runs.run_settings import write_settings
from gnss_sem_map.segmentation import Segmenter, open_segmenter
from gnss_sem_map.sensor_log import Image, Lidar
from gnss_sem_map.voxels import tiles
from gnss_sem_map.voxels.semantic_map import SemanticMap
from gnss_sem_map.voxels.voxel_map import VoxelMap

URBAN = open_label_set()
ROAD, SIDEWALK, VEHICLE, BUILDING, VEGETATION, OTHER = range(6)
RAW_IDS = np.array([40, 48, 10, 50, 70, 0], "<u4")


@dataclass(frozen=True)
class Confused:
    """A segmenter that gives, for each class of another one, always the same other answer."""

    honest: Segmenter
    answers: tuple[int, ...]
    class_names: tuple[str, ...] = NAMES

    def __call__(self, image: Image) -> NDArray[np.uint8]:
        true = self.honest(image).argmax(axis=2)
        confused = np.full((*true.shape, 6), 20, np.uint8)
        np.put_along_axis(confused, np.array(self.answers)[true][:, :, None], 155, axis=2)
        return confused


@pytest.fixture(scope="module")
def truth(small_drive: Street, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("truth") / "labels"
    folder.mkdir()
    for number in small_drive.frames:
        RAW_IDS[small_drive.scan_classes[number]].tofile(folder / f"{number:010d}.label")
    return folder


@pytest.fixture(scope="module")
def confused(small_drive: Street) -> Drive:
    """Buildings are called `other`, sidewalks road."""
    log = open_drive(small_drive.drive)
    honest = open_segmenter(f"labels:{small_drive.labels}", URBAN, sizes=log.calibration.image_sizes)
    assert log.reference is not None
    return Drive(log, log.reference, Confused(honest, (ROAD, ROAD, VEHICLE, OTHER, OTHER, OTHER)), Settings())


def mapped(drive: Drive) -> VoxelMap:
    return build_maps(drive, RunStats()).static


@pytest.fixture(scope="module")
def learnt(confused: Drive, truth: Path) -> LabelCalibration:
    street, counted = measure(confused, mapped(confused), label_files(truth))
    return LabelCalibration("urban", URBAN.names, (street,), fit_temperature(*counted))


def test_the_answers_that_were_counted_are_the_ones_that_were_given(
    confused: Drive, learnt: LabelCalibration, truth: Path
) -> None:
    """Those of the honest network, class by class under the name that the confused one gives them."""
    assert isinstance(confused.segmenter, Confused)
    names = confused.segmenter.answers
    honest = replace(confused, segmenter=confused.segmenter.honest)
    street, _ = measure(honest, mapped(honest), label_files(truth))
    expected = np.zeros((5, 6), np.int64)
    np.add.at(expected.T, np.array(names), street.answers.T)
    np.testing.assert_array_equal(learnt.drives[0].answers, expected)
    assert expected.sum() > 5000
    np.testing.assert_array_equal(learnt.drives[0].cells, street.cells)
    np.testing.assert_array_equal(street.cells.sum(axis=(1, 2)), street.answers.sum(axis=1))


def test_a_calibrated_map_knows_what_other_means(
    confused: Drive, learnt: LabelCalibration, tmp_path: Path
) -> None:
    """Where the network says `other`, a building was: the map says building, and did not before."""
    file = tmp_path / "calibration.yaml"
    file.write_text(learnt.to_yaml())
    plain = mapped(confused)
    better = mapped(replace(confused, settings=Settings(calibration=file)))
    np.testing.assert_array_equal(plain.keys, better.keys)
    wall = np.abs(plain.centres[:, 2] - 3.0) < 1.5  # three metres up there is nothing but wall
    seen = wall & better.observed
    assert seen.sum() > 50
    assert (better.labels[seen] == BUILDING).mean() > 0.9
    assert (plain.labels[seen] == BUILDING).mean() < 0.5


def test_a_map_made_with_a_file_of_another_class_set_is_an_error(
    confused: Drive, learnt: LabelCalibration, tmp_path: Path
) -> None:
    file = tmp_path / "calibration.yaml"
    file.write_text(learnt.to_yaml().replace("vegetation", "meadow"))
    with pytest.raises(ConfigError, match="meadow"):
        mapped(replace(confused, settings=Settings(calibration=file)))


@settings(max_examples=15, deadline=None)
@given(st.floats(0.7, 8.0), st.floats(0, 0.3), st.integers(0, 2**32 - 1))
def test_the_temperature_that_made_the_scores_too_sure_is_found_again(
    temperature: float, doubt: float, seed: int
) -> None:
    """Also where a known share of the truth has nothing to do with the scores."""
    rng = np.random.default_rng(seed)
    honest = rng.normal(0, 1.5, (20_000, 5))
    chances = softmax(honest, axis=1).cumsum(axis=1)
    true = (rng.random((20_000, 1)) > chances[:, :-1]).sum(axis=1)
    anything = rng.random(20_000) < doubt
    true[anything] = rng.integers(0, 5, anything.sum())
    doubts = np.full(20_000, doubt, np.float32)
    found = fit_temperature(true, (honest * temperature).astype(np.float32), doubts)
    assert abs(found / temperature - 1) < 0.1


def test_truth_of_another_drive_is_refused(confused: Drive, truth: Path, tmp_path: Path) -> None:
    voxels, files = mapped(confused), label_files(truth)
    first = sorted(files)[0]
    with pytest.raises(DataError, match="no truth for scan"):
        measure(confused, voxels, {name: path for name, path in files.items() if name != first})
    short = tmp_path / "short.label"
    short.write_bytes(b"\0" * 40)
    with pytest.raises(DataError, match="found 10 labels for"):
        measure(confused, voxels, files | {first: short})
    blank = {}
    for name, path in files.items():
        blank[name] = tmp_path / f"{name}.label"
        blank[name].write_bytes(b"\0" * path.stat().st_size)
    with pytest.raises(DataError, match="no point has both a pixel and a true class"):
        measure(confused, voxels, blank)


def test_truth_of_several_lidars_is_told_apart_by_their_names(confused: Drive, truth: Path) -> None:
    """Two LiDARs that see the same: the network errs twice as often."""
    log, voxels, files = confused.log, mapped(confused), label_files(truth)
    other = Lidar("right", log.calibration.T_imu_lidar, log.scans)
    both = replace(confused, log=replace(log, lidar="left", others=(other,)))
    one, _ = measure(confused, voxels, files)
    named = {f"{lidar}/{name}": path for lidar in ("left", "right") for name, path in files.items()}
    two, _ = measure(both, voxels, named)
    np.testing.assert_array_equal(two.answers, 2 * one.answers)
    with pytest.raises(DataError, match="no truth for scan right/"):
        measure(both, voxels, {name: path for name, path in named.items() if name.startswith("left")})


def test_scans_are_read_as_the_run_read_them(small_drive: Street, confused: Drive, tmp_path: Path) -> None:
    """Those of its frames, as late as its settings say, and in the format that it was told."""
    place, out = write_table_log(tmp_path, small_drive), tmp_path / "out"
    out.mkdir()
    inputs = {
        "drive": str(place), "segmenter": f"labels:{small_drive.labels}", "frames": "0:2", "drive_format": "table",
    }  # fmt: skip
    (out / "run.json").write_text(json.dumps({"inputs": inputs}))
    write_settings(out, Settings.model_validate({"sensors": {"lidar_time_offset_s": 0.5}}))
    confused.trajectory.save(out / "trajectory.parquet")
    voxels = mapped(confused)
    tiles.write(SemanticMap.of(voxels), out / "map", confused.log.frame)
    plain = [scan.stamp for scan in open_drive(place).scans]
    drive, found = drive_and_map(out, None, None)
    assert [scan.stamp for scan in drive.log.scans] == pytest.approx([stamp + 0.5 for stamp in plain[:2]])
    np.testing.assert_array_equal(found.keys, voxels.keys)
    (out / "run.json").write_text(json.dumps({"inputs": inputs | {"drive_format": "rosbag"}}))
    with pytest.raises(DataError):
        drive_and_map(out, None, None)
    (out / "run.json").write_text(json.dumps({"inputs": inputs | {"segmenter": "none"}}))
    with pytest.raises(DataError, match="made without labels"):
        drive_and_map(out, None, None)
    (out / "run.json").write_text(json.dumps({"inputs": inputs, "merged": ["a", "b"]}))
    with pytest.raises(DataError, match="was merged by a version before"):
        drive_and_map(out, None, None)


@pytest.mark.slow
def test_a_run_folder_and_its_truth_become_a_file_that_the_next_run_uses(
    small_drive: Street, truth: Path, tmp_path: Path
) -> None:
    def ask(*arguments: object) -> str:
        done = CliRunner().invoke(app, [str(argument) for argument in arguments])
        assert done.exit_code == 0, done.output
        return done.output

    segmenter = f"labels:{small_drive.labels}"
    ask("run", small_drive.drive, "--segmenter", segmenter, "-o", tmp_path / "a")
    said = ask("calibrate", tmp_path / "a", "--truth", truth, "-o", tmp_path / "calibration.yaml")
    assert "--set calibration=" in said
    found = read(tmp_path / "calibration.yaml", URBAN)
    assert found.drives[0].answers.trace() > 0.95 * found.drives[0].answers.sum()
    chosen = f"calibration={tmp_path / 'calibration.yaml'}"
    ask("run", small_drive.drive, "--segmenter", segmenter, "-o", tmp_path / "b", "--set", chosen)
    with pytest.raises(DataError, match="made with a calibration file"):
        calibrate([(tmp_path / "b", truth)])
    about = json.loads((tmp_path / "a" / "run.json").read_text())
    (tmp_path / "a" / "run.json").write_text(json.dumps(about | {"inputs": {}}))
    with pytest.raises(DataError, match="--drive and --segmenter"):
        calibrate([(tmp_path / "a", truth)])
    assert calibrate([(tmp_path / "a", truth)], small_drive.drive, segmenter).to_yaml() == found.to_yaml()
