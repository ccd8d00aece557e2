"""The command that measures the noise of an IMU: `imu-noise`."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gnss_sem_map.cli.options import Config, Format, Json, Set, settings_of

if TYPE_CHECKING:
    from factor_graphs.allan_deviation import AxisNoise

FIELDS = ("noise_density", "", "bias_walk")
"""Of `ImuNoise`, with the sensor before them; a bias instability is none."""


def imu_noise(
    log: Annotated[
        Path,
        typer.Argument(
            help="A log of the IMU at rest, best for an hour: any drive, or a folder with imu.csv."
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option("-o", "--out", help="New folder for imu_noise.yaml and the plot.", show_default=False),
    ] = None,
    config: Config = None,
    set_: Set = None,
    drive_format: Format = None,
    as_json: Json = False,
) -> None:
    """Measure the noise of an IMU at rest by its Allan deviation, as YAML for log.yaml."""
    from importlib.util import find_spec

    from gnss_sem_map.errors import DataError, how_to_install

    if find_spec("allantools") is None:
        raise DataError(f"imu-noise needs allantools; {how_to_install('allan')}")
    from factor_graphs.allan_deviation import noise_of
    from factor_graphs.allan_plot import write_allan_plot
    from factor_graphs.at_rest import span_at_rest
    from gnss_sem_map.datasets import read_imu
    from gnss_sem_map.files.atomic import adding_folder, replacing
    from gnss_sem_map.files.untrusted import shown

    samples, conventions = read_imu(log, drive_format)
    imu = settings_of(config, set_).sensors.over(conventions).imu_in_ours(samples)
    rest = span_at_rest(imu)
    start, end = rest.stamps[[0, -1]] - imu.stamps[0]
    rate = (len(rest) - 1) / (end - start)
    of = f"of {imu.stamps[-1] - imu.stamps[0]:.1f} s, {rate:.1f} Hz"
    used = f"{' '.join(shown(log.name).split())}: at rest from {start:.1f} to {end:.1f} s {of}"
    axes = noise_of(rest)
    snippet = _yaml(axes, used)
    if out is not None:
        with adding_folder(out) as folder:
            (folder / "imu_noise.yaml").write_text(snippet, "utf-8")
            with replacing(folder / "allan_deviation.png") as file:
                write_allan_plot(axes, used, file)
    if as_json:
        typer.echo(
            json.dumps({"span_s": [start, end], "rate_hz": rate, "axes": [_as_dict(axis) for axis in axes]})
        )
        return
    typer.echo(
        "\n".join([used, *_table(axes), "", "for log.yaml:" if out is None else f"in {out}:", "", snippet])
    )


def _worst(axes: list[AxisNoise]) -> Iterator[tuple[str, int, str, float, str]]:
    """Sensor, place, name and value of every number of the worst axis, and it in words: in both units, or why not."""
    from factor_graphs.allan_deviation import NAMES, UNITS, worst

    for sensor, names in NAMES.items():
        found = zip(names, *worst(axes, sensor), *UNITS[sensor], strict=True)
        for k, (name, number, why, si, unit, scale) in enumerate(found):
            said = f"{number * scale:.3g} {unit} = {number:.3g} {si}"
            yield sensor, k, name, number, f"not measured: {why}" if why else said


def _table(axes: list[AxisNoise]) -> list[str]:
    """A line per number: its axes on the scale of data sheets, and the worst one."""
    from factor_graphs.allan_deviation import UNITS

    lines = [f"{axis.name} {axis.why[0]}" for axis in axes if not len(axis.taus)]
    for sensor, k, name, _, said in _worst(axes):
        values = [axis.numbers[k] * UNITS[sensor][2][k] for axis in axes if axis.sensor == sensor]
        each = "  ".join(
            f"{axis} {value:.3g}".replace("nan", "-") for axis, value in zip("xyz", values, strict=True)
        )
        lines.append(f"{name:<24} {each}  worst {said}")
    return lines


def _yaml(axes: list[AxisNoise], used: str) -> str:
    """The section `imu_noise` of log.yaml, of the worst axes; what was not measured is a comment."""
    lines = [f"# {used}; in rig.yaml of a bag this is imu: {{noise: ...}}", "imu_noise:"]
    for sensor, k, name, number, said in _worst(axes):
        is_set = FIELDS[k] and number == number
        key = f"{sensor}_{FIELDS[k]}: {number:.3e}  #" if is_set else f"# {sensor},"
        lines.append(f"  {key} {name}: {said}")
    return "\n".join(lines) + "\n"


def _as_dict(axis: AxisNoise) -> dict[str, Any]:
    names = ("noise_density", "bias_instability", "bias_walk")
    numbers = {name: None if n != n else n for name, n in zip(names, axis.numbers.tolist(), strict=True)}
    not_measured = {name: why for name, why in zip(names, axis.why, strict=True) if why}
    curve = {"taus_s": axis.taus.tolist(), "deviations": axis.deviations.tolist()}
    return {"axis": axis.name, "sensor": axis.sensor, **numbers, "not_measured": not_measured, **curve}
