"""The settings of a run in its folder, with the calibration that they name: a run can be moved, and mapped on."""

from __future__ import annotations

from pathlib import Path

from gnss_sem_map import config
from gnss_sem_map.config import Settings
from gnss_sem_map.errors import ConfigError
from gnss_sem_map.files.atomic import replacing
from gnss_sem_map.files.untrusted import read_bytes

SETTINGS, CALIBRATION = "config.yaml", "calibration.yaml"


def write_settings(folder: Path, settings: Settings) -> None:
    """Write config.yaml and, if it names a calibration, a copy beside it; raises ConfigError if that cannot be read."""
    if settings.calibration is not None:
        content = read_bytes(settings.calibration, error=ConfigError)
        with replacing(folder / CALIBRATION) as copy:  # it may be a second name of the file that was read
            copy.write(content)
        settings = settings.model_copy(update={"calibration": Path(CALIBRATION)})
    (folder / SETTINGS).write_text(settings.to_yaml(), "utf-8")


def read_settings(folder: Path) -> Settings:
    """The settings of a run; raises ConfigError."""
    return config.load(folder / SETTINGS)


def differing(one: Settings, other: Settings) -> list[str]:
    """Names of the settings that differ, wherever the calibration is that they name; raises ConfigError."""
    one, other = _with_content(one), _with_content(other)
    return [name for name in Settings.model_fields if getattr(one, name) != getattr(other, name)]


def _with_content(settings: Settings) -> Settings:
    file = settings.calibration
    return settings.model_copy(update={"calibration": file and read_bytes(file, error=ConfigError)})
