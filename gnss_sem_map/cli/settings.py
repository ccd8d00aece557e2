"""The command that prints the settings: `config`."""

from __future__ import annotations

import typer

from gnss_sem_map.cli.options import Config, Set, settings_of


def config(config: Config = None, set_: Set = None) -> None:
    """Print all settings as YAML, with the values that a run would use."""
    typer.echo(settings_of(config, set_).to_yaml(), nl=False)
