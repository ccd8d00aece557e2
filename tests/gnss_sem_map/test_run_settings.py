"""The files that settings name are part of a run: it needs the originals no longer, wherever the run goes."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from street import Street

from gnss_sem_map import Settings, config, run
from gnss_sem_map.errors import ConfigError
from gnss_sem_map.labels import label_set
from gnss_sem_map.runs.run_settings import differing, read_settings, write_settings
from gnss_sem_map.segmentation import DEMO_CALIBRATION

URBAN = Path(label_set.__file__).with_name("urban.yaml")


@pytest.fixture
def calibration(tmp_path: Path) -> Path:
    return Path(shutil.copyfile(DEMO_CALIBRATION, tmp_path / "confusion.yaml"))


def test_a_run_that_was_moved_is_refined_without_the_files_it_was_made_with(
    small_drive: Street, calibration: Path, tmp_path: Path
) -> None:
    classes = Path(shutil.copyfile(URBAN, tmp_path / "mine.yaml"))
    settings = Settings(calibration=calibration, classes=str(classes))
    made = run(small_drive.drive, tmp_path / "out", f"labels:{small_drive.labels}", settings)
    tiles = {path.name: path.read_bytes() for path in (made.folder / "refined").glob("*.parquet")}
    assert tiles
    calibration.unlink()
    classes.unlink()
    moved = type(made)(Path(shutil.move(made.folder, tmp_path / "delivered")))
    assert moved.settings.calibration == tmp_path / "delivered" / "calibration.yaml"
    assert moved.settings.classes == str(tmp_path / "delivered" / "classes.yaml")
    elsewhere = {"calibration": DEMO_CALIBRATION, "classes": str(URBAN)}
    again = moved.refine(settings.model_copy(update=elsewhere), tmp_path / "again")
    assert {path.name: path.read_bytes() for path in (again.folder / "refined").glob("*.parquet")} == tiles
    assert (again.folder / "config.yaml").read_bytes() == (moved.folder / "config.yaml").read_bytes()


def test_runs_from_copies_of_a_calibration_have_the_same_settings(calibration: Path, tmp_path: Path) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    for folder in (first, second):
        folder.mkdir()
    write_settings(first, Settings(calibration=calibration))
    write_settings(second, read_settings(first))
    assert [path.read_bytes() for path in sorted(first.iterdir())] == [
        path.read_bytes() for path in sorted(second.iterdir())
    ]
    assert differing(read_settings(second), Settings(calibration=calibration)) == []
    calibration.write_text("another")
    assert differing(read_settings(second), Settings(calibration=calibration)) == ["calibration"]
    assert differing(read_settings(second), Settings()) == ["calibration"]
    write_settings(second, read_settings(second))  # in place, from its own copy
    assert differing(read_settings(first), read_settings(second)) == []


def test_a_calibration_that_is_gone_is_named(calibration: Path, tmp_path: Path) -> None:
    calibration.unlink()
    with pytest.raises(ConfigError, match=r"confusion\.yaml"):
        write_settings(tmp_path, Settings(calibration=calibration))
    assert not (tmp_path / "config.yaml").exists()


def test_a_file_of_settings_names_a_calibration_from_where_it_lies_and_an_override_from_here(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "rig").mkdir()
    (tmp_path / "rig" / "settings.yaml").write_text("calibration: ../confusion.yaml\n")
    monkeypatch.chdir(tmp_path)
    found = config.load(Path("rig/settings.yaml")).calibration
    assert found is not None
    assert found.is_absolute()
    assert found.resolve() == tmp_path.resolve() / "confusion.yaml"
    assert config.load(overrides=["calibration=confusion.yaml"]).calibration == tmp_path / "confusion.yaml"
