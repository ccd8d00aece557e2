"""All settings of a run: one frozen model per stage, YAML in and out, `a.b=c` on the command line."""

from __future__ import annotations

import difflib
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Literal, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from gnss_sem_map.conventions import SensorConventions
from gnss_sem_map.errors import ConfigError
from gnss_sem_map.files.structured import not_finite, parse_yaml, read_yaml
from gnss_sem_map.files.untrusted import shown
from gnss_sem_map.refinement import RefinementSettings
from gnss_sem_map.scans.lidar_odometry import TrajectorySettings
from gnss_sem_map.scans.projection import LabellingSettings
from gnss_sem_map.voxels.voxel_map import MappingSettings

Model = TypeVar("Model", bound=BaseModel)


EQUATION_6: dict[str, dict[str, Any]] = {
    "labelling": {"probability_floor": 0.01},
    "refinement": {
        "count_exponent": 1.0,
        "geometry": "off",
        "smoothing": "off",
        "levels": "off",
        "kerbs": "off",
        "systematic_errors": 0.0,
        "confidence_temperature": 1.0,
    },
}
"""What `fusion: paper` sets. The floor is the least that keeps one look from deciding for ever."""


class Settings(BaseModel):
    """Everything that can be chosen about a run; each part stands beside the stage that it drives."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    classes: str = Field("urban", description="Class set of the map: a shipped one, or a YAML file.")
    calibration: Path | None = Field(
        None, description="File of `gnss-sem-map calibrate`: what the network's answers are worth."
    )
    fusion: Literal["evidence", "paper"] = Field(
        "evidence",
        description="`paper` is eq. 6 to the letter: looks count in full, nothing but the images speaks."
        " It sets what is not set beside it.",
    )
    sensors: SensorConventions = Field(
        SensorConventions(),
        description="Axes, units and clocks of the sensors; wins over the drive's log.yaml.",
    )
    trajectory: TrajectorySettings = Field(
        default_factory=TrajectorySettings, description="GNSS and IMU smoothing, LiDAR odometry."
    )
    mapping: MappingSettings = Field(MappingSettings(), description="Points to voxels.")
    labelling: LabellingSettings = Field(LabellingSettings(), description="Pixels to points.")
    refinement: RefinementSettings = Field(
        default_factory=RefinementSettings, description="Batch refinement."
    )

    @model_validator(mode="before")
    @classmethod
    def _as_in_the_paper(cls, content: Any) -> Any:
        if not isinstance(content, dict) or content.get("fusion") != "paper":
            return content
        if any(isinstance(content.get(section, {}), BaseModel) for section in EQUATION_6):
            return content
        if not all(isinstance(content.get(section, {}), dict) for section in EQUATION_6):
            return content  # refused when the sections are looked at
        return content | {
            section: values | content.get(section, {}) for section, values in EQUATION_6.items()
        }

    def to_yaml(self) -> str:
        """These settings as a file that `load` reads back, each under its description."""
        return "".join(f"{line}\n" for line in _described(self))


def load(file: Path | None = None, overrides: Iterable[str] = ()) -> Settings:
    """Settings from a YAML file and `a.b=c` overrides; raises ConfigError, with the nearest key, for an unknown one."""
    content = _read(file) if file is not None else {}
    return parse(Settings, overrides, content, str(file) if file else "--set")


def parse(
    model: type[Model], overrides: Iterable[str], content: dict[str, Any] | None = None, where: str = "--set"
) -> Model:
    """Any settings from `a.b=c` overrides of what `content` already says; raises ConfigError."""
    content = content if content is not None else {}
    for override in overrides:
        _apply(content, override)
    place = not_finite(content)
    if place is not None:
        raise ConfigError(f"{where}: {place[:100]}: found a number that is not finite, expected a finite one")
    try:
        return model.model_validate(content)
    except ValidationError as error:
        raise ConfigError(_explain(error, model, where)) from None


def _described(section: BaseModel) -> Iterator[str]:
    """The lines of a section: every setting under its description as a comment, inner sections indented."""
    plain = section.model_dump(mode="json")
    for name, field in type(section).model_fields.items():
        yield from textwrap.wrap(field.description or "", 100, initial_indent="# ", subsequent_indent="# ")
        value = getattr(section, name)
        if isinstance(value, BaseModel):
            yield f"{name}:"
            yield from (f"  {line}" for line in _described(value))
        else:
            yield from yaml.safe_dump({name: plain[name]}, sort_keys=False).splitlines()


def _read(file: Path) -> dict[str, Any]:
    content = read_yaml(file, ConfigError)
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise ConfigError(
            f"{shown(file)}: found {type(content).__name__}, expected sections {sorted(Settings.model_fields)}"
        )
    return content


def _apply(content: dict[str, Any], override: str) -> None:
    key, equals, value = override.partition("=")
    if not equals or not key:
        raise ConfigError(f"--set {override[:200]!r}: expected section.name=value")
    *sections, name = key.split(".")
    for section in sections:
        content = content.setdefault(section, {})
        if not isinstance(content, dict):
            raise ConfigError(f"--set {override[:200]!r}: {section[:100]!r} is a value, not a section")
    try:
        content[name] = parse_yaml(value)
    except ValueError:
        raise ConfigError(f"--set {override[:200]!r}: the value is not YAML") from None


def _explain(error: ValidationError, root: type[BaseModel], where: str) -> str:
    first = error.errors()[0]
    place = ".".join(str(part) for part in first["loc"])[:100]
    if first["type"] == "extra_forbidden":
        known = _keys_beside(root, first["loc"])
        close = difflib.get_close_matches(str(first["loc"][-1]), known, n=1)
        hint = f"did you mean {close[0]!r}?" if close else f"known are {known}"
        return f"{where}: unknown setting {place!r}; {hint}"
    return f"{where}: {place}: {first['msg'][:200]} (found {repr(first['input'])[:100]})"


def _keys_beside(root: type[BaseModel], place: Sequence[int | str]) -> list[str]:
    """The keys that stand beside an unknown one: those of the innermost section."""
    model: Any = root
    for part in place[:-1]:
        if not (isinstance(model, type) and issubclass(model, BaseModel)):
            return []
        field = model.model_fields.get(str(part))
        model = None if field is None else field.annotation
    is_section = isinstance(model, type) and issubclass(model, BaseModel)
    return sorted(model.model_fields) if is_section else []
