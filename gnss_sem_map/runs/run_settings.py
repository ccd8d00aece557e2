"""The settings of a run in its folder, with the files that they name beside the geoid: a run can be moved."""

from __future__ import annotations

from pathlib import Path

from gnss_sem_map import config
from gnss_sem_map.config import Settings
from gnss_sem_map.errors import ConfigError
from gnss_sem_map.files.atomic import replacing
from gnss_sem_map.files.untrusted import read_bytes
from gnss_sem_map.labels.label_set import SHIPPED_CLASS_SETS

SETTINGS = "config.yaml"
MODEL = "geometric_classifier.npz"
COPIES = ("calibration.yaml", "classes.yaml", MODEL)
"""Files that settings name, each by the name of its setting."""


def write_settings(folder: Path, settings: Settings) -> None:
    """Write config.yaml, and copies of the files that it names, but for the geoid; raises ConfigError, OSError."""
    for setting, file in _named(settings).items():
        _copy(file, folder / f"{setting}.yaml")
        settings = settings.model_copy(update={setting: type(getattr(settings, setting))(f"{setting}.yaml")})
    if (model := settings.geometric_classifier.model) is not None:
        _copy(model, folder / MODEL)
        settings = _with_model(settings, Path(MODEL))
    (folder / SETTINGS).write_text(settings.to_yaml(), "utf-8")


def _copy(file: Path, to: Path) -> None:
    content = read_bytes(file, error=ConfigError)
    with replacing(to) as copy:  # it may be a second name of the file that was read
        copy.write(content)


def _with_model(settings: Settings, model: Path | bytes) -> Settings:
    chosen = settings.geometric_classifier.model_copy(update={"model": model})
    return settings.model_copy(update={"geometric_classifier": chosen})


def read_settings(folder: Path) -> Settings:
    """The settings of a run; raises ConfigError."""
    return config.load(folder / SETTINGS)


def differing(one: Settings, other: Settings) -> list[str]:
    """Names of the settings that differ, wherever the files are that they name; raises ConfigError."""
    one, other = _with_content(one), _with_content(other)
    return [name for name in Settings.model_fields if getattr(one, name) != getattr(other, name)]


def _with_content(settings: Settings) -> Settings:
    contents = {name: read_bytes(file, error=ConfigError) for name, file in _named(settings).items()}
    if (model := settings.geometric_classifier.model) is not None:
        settings = _with_model(settings, read_bytes(model, error=ConfigError))
    return settings.model_copy(update=contents)


def _named(settings: Settings) -> dict[str, Path]:
    """The files of a class set and of a calibration that settings name; a shipped class set is none."""
    files = {} if settings.calibration is None else {"calibration": settings.calibration}
    return files if settings.classes in SHIPPED_CLASS_SETS else files | {"classes": Path(settings.classes)}
