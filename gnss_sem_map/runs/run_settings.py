"""The settings of a run in its folder, with copies of the files that they name: a run can be moved."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from gnss_sem_map import config
from gnss_sem_map.config import Settings
from gnss_sem_map.errors import ConfigError
from gnss_sem_map.files.atomic import replacing
from gnss_sem_map.files.untrusted import read_bytes
from gnss_sem_map.labels.label_set import SHIPPED_CLASS_SETS

SETTINGS = "config.yaml"
NAMED = {
    ("calibration",): "calibration.yaml",
    ("classes",): "classes.yaml",
    ("geometric_classifier", "model"): "classifier.npz",
}
"""Settings that name a file, and the name of its copy in a run."""
COPIES = tuple(NAMED.values())
Place = tuple[str, ...]


def write_settings(folder: Path, settings: Settings) -> None:
    """Write config.yaml, and copies of the files that it names; raises ConfigError, OSError."""
    for place, file in _named(settings).items():
        content, name = read_bytes(file, error=ConfigError), NAMED[place]
        with replacing(folder / name) as copy:  # it may be a second name of the file that was read
            copy.write(content)
        settings = _changed(settings, place, name if place == ("classes",) else Path(name))
    (folder / SETTINGS).write_text(settings.to_yaml(), "utf-8")


def read_settings(folder: Path) -> Settings:
    """The settings of a run; raises ConfigError."""
    return config.load(folder / SETTINGS)


def differing(one: Settings, other: Settings) -> list[str]:
    """Names of the settings that differ, wherever the files are that they name; raises ConfigError."""
    one, other = _with_content(one), _with_content(other)
    return [name for name in Settings.model_fields if getattr(one, name) != getattr(other, name)]


def _with_content(settings: Settings) -> Settings:
    for place, file in _named(settings).items():
        settings = _changed(settings, place, read_bytes(file, error=ConfigError))
    return settings


def _changed(settings: Settings, place: Place, value: Any) -> Settings:
    """The settings with another value at a place, which is not checked."""
    name, *inner = place
    if inner:
        value = getattr(settings, name).model_copy(update={inner[0]: value})
    return settings.model_copy(update={name: value})


def _named(settings: Settings) -> dict[Place, Path]:
    """The files that settings name; a shipped class set is none."""
    files = {
        ("calibration",): settings.calibration,
        ("classes",): None if settings.classes in SHIPPED_CLASS_SETS else Path(settings.classes),
        ("geometric_classifier", "model"): settings.geometric_classifier.model,
    }
    return {place: file for place, file in files.items() if file is not None}
