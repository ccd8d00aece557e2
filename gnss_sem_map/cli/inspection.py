"""Command that looks into a bag: `inspect`."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Annotated

import typer

from gnss_sem_map.cli.console import print_topics
from gnss_sem_map.cli.options import Json


def inspect(
    bag: Annotated[Path, typer.Argument(help="A ROS 1 or ROS 2 bag: a file, or the folder of its files.")],
    out: Annotated[
        Path | None,
        typer.Option(
            "-o", "--out", help="Rig file to write; default: rig.yaml beside the bag.", show_default=False
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """List the topics of a bag, and write a rig.yaml to edit: which topic is which sensor."""
    from gnss_sem_map.datasets.ros.bag import Bag
    from gnss_sem_map.datasets.ros.contents import contents_of, suggested_rig
    from gnss_sem_map.datasets.ros.kinds import KINDS
    from gnss_sem_map.datasets.ros.rig import NAME, rig_file
    from gnss_sem_map.datasets.ros.roles import nothing_read
    from gnss_sem_map.files.atomic import replacing

    opened = Bag(bag)
    topics = contents_of(opened)
    file = out or rig_file(bag) or bag.absolute().parent / NAME
    is_read = any(topic.taken_for in KINDS and topic.messages for topic in topics)
    is_new = is_read and not os.path.lexists(file)
    if is_new:
        with replacing(file) as written:
            written.write(suggested_rig(opened, topics).encode())
    if as_json:
        typer.echo(
            json.dumps({"topics": [topic.as_dict() for topic in topics], "rig": str(file), "written": is_new})
        )
    else:
        print_topics(topics)
    if not is_read:
        raise nothing_read(opened)
    if as_json:
        return
    typer.echo(
        f"rig file        {file}: edit it, then run `gnss-sem-map check {bag}`"
        if is_new
        else f"rig file        {file} is there already and stays as it is; -o writes another one"
    )
