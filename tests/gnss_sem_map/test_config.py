"""One set of settings, in a file or on the command line; nothing unknown passes."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from pydantic import BaseModel

from gnss_sem_map import config
from gnss_sem_map.errors import ConfigError
from gnss_sem_map.files.structured import parse_yaml


def sections(model: type[BaseModel]) -> Iterator[type[BaseModel]]:
    """A model and those of all sections in it."""
    yield model
    for field in model.model_fields.values():
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            yield from sections(field.annotation)


def test_what_is_printed_reads_back_as_the_same_settings(tmp_path: Path) -> None:
    settings = config.load(overrides=["mapping.voxel_size_m=0.3", "labelling.probability_floor=0.1"])
    file = tmp_path / "config.yaml"
    file.write_text(settings.to_yaml())
    assert config.load(file) == settings
    assert settings.mapping.voxel_size_m == 0.3


@pytest.mark.parametrize(
    "classes", ["urban", 'a: #b\'s "c" yaml', "x" * 200 + " y" * 100, "two\n\nlines ", "\u0085é"]
)
def test_any_text_reads_back(classes: str, tmp_path: Path) -> None:
    file = tmp_path / "config.yaml"
    file.write_text(config.Settings(classes=classes).to_yaml(), "utf-8")
    assert config.load(file).classes == classes


def test_every_setting_is_printed_under_its_description(tmp_path: Path) -> None:
    printed = config.load().to_yaml()
    (tmp_path / "config.yaml").write_text(printed, "utf-8")
    assert config.load(tmp_path / "config.yaml") == config.load()
    lines, above = [line.strip() for line in printed.splitlines()], {}
    comment: list[str] = []
    for line in lines:
        if line.startswith("# "):
            comment.append(line.removeprefix("# "))
        else:
            name, colon, _ = line.partition(":")
            if colon:
                above.setdefault(name, []).append(" ".join(comment))
            comment = []
    count = 0
    for model in sections(config.Settings):
        for name, field in model.model_fields.items():
            assert " ".join(str(field.description).split()) in above[name], f"{model.__name__}.{name}"
            count += 1
    assert sum(len(found) for found in above.values()) == count


@pytest.mark.parametrize(
    "text",
    ["classes: urban\nclasses: vehicles\n", "a: {b: 1, c: 2, b: 3}", '"b": 1\nb: 1\n', "- a\n- {1: 2, 1: 3}"],
)
def test_a_key_that_is_there_twice_is_refused(text: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"found the key '\w+' twice, again in line \d"):
        parse_yaml(text)
    file = tmp_path / "config.yaml"
    file.write_text(text)
    with pytest.raises(ConfigError, match=r"config\.yaml: not YAML \(found the key '\w+' twice"):
        config.load(file)


def test_merged_keys_may_be_replaced() -> None:
    assert parse_yaml("a: &a {b: 1}\nc: &c {<<: *a, b: 2}\nd: {<<: *c, b: 3}")["d"] == {"b": 3}


def test_a_time_of_day_is_text() -> None:
    assert parse_yaml("[12:30:45, 190:20:30.15, -1:30, 12, 0.5]") == [
        "12:30:45",
        "190:20:30.15",
        "-1:30",
        12,
        0.5,
    ]


def test_the_command_line_wins_over_the_file(tmp_path: Path) -> None:
    file = tmp_path / "config.yaml"
    file.write_text("mapping: {voxel_size_m: 0.5, farthest_m: 60}\n")
    settings = config.load(file, ["mapping.voxel_size_m=0.25"])
    assert (settings.mapping.voxel_size_m, settings.mapping.farthest_m) == (0.25, 60)


def test_files_that_a_file_names_lie_beside_it_and_others_where_we_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "there").mkdir()
    monkeypatch.chdir(tmp_path)
    file = Path("there/settings.yaml")
    file.write_text("classes: my.yaml\ncalibration: cal.yaml\ndelivery: {geoid: ../grid.tif}\n")
    settings = config.load(file, ["calibration=other.yaml"])
    found = [tmp_path / "other.yaml", tmp_path / "there/my.yaml", tmp_path / "there/../grid.tif"]
    assert settings.files == found
    assert config.load(None, ["classes=urban"]).files == []


def test_off_and_false_switch_off(tmp_path: Path) -> None:
    settings = config.load(overrides=["refinement.vehicles.enabled=off", "trajectory.robust=false"])
    assert settings.refinement.vehicles.enabled is False
    assert settings.trajectory.robust is False
    (tmp_path / "config.yaml").write_text("refinement: {vehicles: {enabled: off}}\n")
    assert config.load(tmp_path / "config.yaml").refinement.vehicles.enabled is False


def test_an_empty_file_means_the_defaults(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text("")
    assert config.load(tmp_path / "config.yaml") == config.load()


@pytest.mark.parametrize(
    ("override", "says"),
    [
        ("mapping.voxel_sise_m=0.2", "unknown setting 'mapping.voxel_sise_m'; did you mean 'voxel_size_m'"),
        ("maping.voxel_size_m=0.2", "unknown setting 'maping'; did you mean 'mapping'"),
        ("mapping.voxel_size_m=0", "mapping.voxel_size_m: .*greater than 0.01"),
        ("mapping.voxel_size_m=-1", "mapping.voxel_size_m"),
        ("mapping.voxel_size_m=wide", "mapping.voxel_size_m: .*number"),
        ("mapping.voxel_size_m.x=1", "mapping.voxel_size_m: .*number"),
        ("mapping", "expected section.name=value"),
        ("dynamics.farthest_m=651", "dynamics.farthest_m: .*less than or equal to 650"),
        ("dynamics.farthest_object_m=651", "dynamics.farthest_object_m: .*less than or equal to 650"),
        ("refinement.free_space.farthest_m=651", "free_space.farthest_m: .*less than or equal to 650"),
        ("classes.x=1", "classes: .*string"),
    ],
)
def test_what_is_not_understood_is_refused_in_one_line(override: str, says: str) -> None:
    with pytest.raises(ConfigError, match=says) as error:
        config.load(overrides=[override])
    assert "\n" not in str(error.value)


def test_a_file_that_is_no_settings_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "config.yaml"
    for content, says in (("- a\n", "expected sections"), ("a: [\n", "not YAML")):
        file.write_text(content)
        with pytest.raises(ConfigError, match=says):
            config.load(file)
    with pytest.raises(ConfigError, match="cannot read"):
        config.load(tmp_path / "absent.yaml")


def test_every_setting_says_what_it_is() -> None:
    undescribed = [
        f"{model.__name__}.{name}"
        for model in sections(config.Settings)
        for name, field in model.model_fields.items()
        if not field.description
    ]
    assert undescribed == []
