"""All settings of a run: one frozen model per stage, YAML in and out, `a.b=c` on the command line."""

from __future__ import annotations

import difflib
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Literal, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from gnss_sem_map.dynamics.motion_state import MotionSettings
from gnss_sem_map.errors import ConfigError
from gnss_sem_map.files.structured import not_finite, parse_yaml, read_yaml
from gnss_sem_map.files.untrusted import shown
from gnss_sem_map.geometric_classifier.training import GeometricClassifierSettings
from gnss_sem_map.refinement.steps import RefinementSettings
from gnss_sem_map.scans.lidar_odometry import TrajectorySettings
from gnss_sem_map.scans.projection import LabellingSettings
from gnss_sem_map.sensor_log.conventions import SensorConventions
from gnss_sem_map.voxels.voxel_map import MappingSettings

Model = TypeVar("Model", bound=BaseModel)


PAPER: dict[str, float | bool] = {
    "labelling.probability_floor": 0.01,
    "refinement.discount.exponent": 1.0,
    "refinement.geometric_prior.enabled": False,
    "refinement.systematic_error.rate": 0.0,
    "refinement.potts_mrf.enabled": False,
    "geometric_classifier.enabled": False,
    "refinement.decision.temperature": 1.0,
    "refinement.kerbs.enabled": False,
}
"""What `fusion: paper` sets. The floor is the least that keeps one observation from deciding for ever."""


RETIRED = (("refinement", "unobserved"), ("refinement", "levels"))
"""Settings of runs of earlier versions, which have no effect any more."""
FILES = (("calibration",), ("classes",), ("geometric_classifier", "model"), ("delivery", "geoid"))
"""Settings that name a file; classes without an ending are a shipped set."""


class Nav2Settings(BaseModel):
    """What the robot of `--format nav2` can do."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    robot_height_m: float = Field(
        1.5, gt=0, le=10, description="What is higher over the ground is no obstacle: branches, bridges."
    )
    step_m: float = Field(
        0.08, ge=0, description="Highest step that it climbs, and what is lower is no obstacle: kerbs are."
    )
    slope_deg: float = Field(10.0, gt=0, le=45, description="Steepest ground that it drives on.")
    cell_m: float | None = Field(
        None, gt=0, description="Edge of a cell, a multiple of the voxels'; null: theirs."
    )

    @model_validator(mode="after")
    def _fits_under_itself(self) -> Nav2Settings:
        if self.step_m >= self.robot_height_m:
            raise ValueError(
                f"step_m is {self.step_m:g} and robot_height_m {self.robot_height_m:g}; expected a lower step"
            )
        return self


class TerrainSettings(BaseModel):
    """How far from where it was seen the ground is known."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    farthest_m: float = Field(
        3.0, gt=0, le=50, description="Ground farther from where ground was seen is unknown."
    )


class DeliverySettings(BaseModel):
    """Coordinates and labels of the files that a map is exported to; the map itself stays as it is."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    crs: int | None = Field(
        None, description="EPSG code of a projected CRS in metres; null: UTM (WGS 84) at the map's origin."
    )
    geoid: Path | None = Field(
        None,
        description="Grid of geoid heights as PROJ reads it (.tif, .gtx): heights are orthometric; null: they are"
        " above the WGS 84 ellipsoid.",
    )
    min_confidence: float = Field(
        0.0, ge=0, le=1, description="Voxels whose label is less sure than this are written as unlabelled."
    )
    nav2: Nav2Settings = Field(Nav2Settings(), description="The robot of `export --format nav2`.")
    terrain: TerrainSettings = Field(
        TerrainSettings(), description="The ground of `export --format terrain` and `nav2`."
    )


class Settings(BaseModel):
    """Everything that can be chosen about a run; each part stands beside the stage that it drives."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    classes: str = Field("urban", description="Class set of the map: a shipped one, or a YAML file.")
    calibration: Path | None = Field(
        None, description="Confusion model of the segmentation network: a file of `gnss-sem-map calibrate`."
    )
    fusion: Literal["evidence", "paper"] = Field(
        "evidence",
        description="`paper`: evidence by eq. 6, without discount, geometric prior and neighbours; a setting"
        " that contradicts it is an error. All rules of the paper: examples/paper.yaml.",
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
    dynamics: MotionSettings = Field(
        default_factory=MotionSettings, description="Moving objects, found before mapping."
    )
    refinement: RefinementSettings = Field(
        default_factory=RefinementSettings, description="Batch refinement, step by step."
    )
    geometric_classifier: GeometricClassifierSettings = Field(
        GeometricClassifierSettings(),
        description="Classes by shape and intensity, where no camera looked, and beside what it saw.",
    )
    delivery: DeliverySettings = Field(
        DeliverySettings(), description="Coordinates and least confidence of exported files."
    )

    @model_validator(mode="before")
    @classmethod
    def _as_in_the_paper(cls, content: Any) -> Any:
        if not isinstance(content, dict) or content.get("fusion") != "paper":
            return content
        content = _plain(content)
        for path, value in PAPER.items():
            *sections, name = path.split(".")
            section = content
            for part in sections:
                section = section.setdefault(part, {})
                if not isinstance(section, dict):
                    return content  # refused when the sections are looked at
            if section.setdefault(name, value) != value:
                raise ValueError(
                    f"fusion: paper sets {path} to {value}, found {section[name]}; leave out one of them"
                )
        return content

    @property
    def files(self) -> list[Path]:
        """The files that are named."""
        classes = Path(self.classes) if Path(self.classes).suffix else None
        named = self.calibration, classes, self.geometric_classifier.model, self.delivery.geoid
        return [file for file in named if file is not None]

    def changed(self, *overrides: str) -> Settings:
        """These settings with some `section.name=value` changed; raises ConfigError."""
        return parse(Settings, overrides, self.model_dump(mode="json"))

    def to_yaml(self) -> str:
        """These settings as a file that `load` reads back, each under its description."""
        return "".join(f"{line}\n" for line in _described(self))


def _plain(content: Any) -> Any:
    """A copy in which models are what was set of them."""
    if isinstance(content, BaseModel):
        content = content.model_dump(exclude_unset=True)
    return {key: _plain(value) for key, value in content.items()} if isinstance(content, dict) else content


def load(
    file: Path | None = None, overrides: Iterable[str] = (), leave_out: Iterable[tuple[str, str]] = ()
) -> Settings:
    """Settings from a YAML file and `a.b=c` overrides; raises ConfigError, with the nearest key, for an unknown one.

    Files that the file names are found from its folder, those of the overrides from the working folder. `leave_out`:
    sections and names that the file may still have, of earlier versions.
    """
    content = _read(file) if file is not None else {}
    for section, name in leave_out:
        if isinstance(content.get(section), dict):
            content[section].pop(name, None)
    if file is not None:
        _find_files(content, file.parent)
    for override in overrides:
        _apply(content, override)
    _find_files(content, Path.cwd())  # a worker may have another working folder
    return parse(Settings, (), content, str(file) if file else "--set")


def of_run(file: Path) -> Settings:
    """The settings of a finished run, maybe of an earlier version; raises ConfigError."""
    return load(file, leave_out=RETIRED)


def _find_files(content: dict[str, Any], folder: Path) -> None:
    """Make the names of files in settings absolute: they are found from a folder."""
    for *sections, name in FILES:
        section: Any = content
        for part in sections:
            section = section.get(part) if isinstance(section, dict) else None
        said = section.get(name) if isinstance(section, dict) else None
        if isinstance(said, str) and (Path(said).suffix or name != "classes"):
            section[name] = str(folder.absolute() / said)


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
