"""Tiles that need not be made again: each says from what it was made.

They come from an earlier map, or from a work folder, where `save` puts them while a map is made:

x_y.parquet    the tile
x_y.json       its record: what `map.json` will say of it, and what is known beside it
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from gnss_sem_map.errors import DataError
from gnss_sem_map.files.atomic import unfinished
from gnss_sem_map.files.untrusted import is_file, read_bytes
from gnss_sem_map.voxels.map_json import files_of, is_about_a_tile, name_of, tile_of
from gnss_sem_map.voxels.semantic_map import SemanticMap
from gnss_sem_map.voxels.tile_files import Tile, describe, encode

VERSION = version("gnss-sem-map")


@dataclass(frozen=True, eq=False)
class Made:
    """A tile that is made."""

    file: Path
    about: dict[str, Any]
    """What `map.json` says of it."""
    beside: Any = None
    """What else was found when it was made, JSON; None for a tile of an earlier map."""


def digest(content: Any) -> str:
    """Digest of what decides a tile, which is JSON, and of this version: another one may make another tile of it."""
    return hashlib.sha256(json.dumps([VERSION, content], sort_keys=True).encode()).hexdigest()


def of_map(folder: Path | None, made_from: Mapping[Tile, str]) -> dict[Tile, Made]:
    """The whole tiles of an earlier map that were made from the same, by `digest`; none where there is no such map."""
    if folder is None:
        return {}
    known = {tile_of(name): Made(folder / name, about) for name, about in files_of(folder).items()}
    return _same(known, made_from)


def of_work(folder: Path, made_from: Mapping[Tile, str]) -> dict[Tile, Made]:
    """The whole tiles in a work folder that were made from the same, by `digest`."""
    known = {}
    there = {path.name for path in folder.iterdir()}  # NFS remembers for a while that a file was not there
    for tile in made_from:
        path = _record_of(tile, folder)
        record = read_record(path) if path.name in there else None
        if record is not None and is_about_a_tile(record.get("about")):
            known[tile] = Made(folder / name_of(tile), record["about"], record.get("beside"))
    return _same(known, made_from)


def save(tile: Tile, piece: SemanticMap, about: Mapping[str, Any], beside: Any, folder: Path) -> None:
    """Save a tile for `of_work`, with what `map.json` is to say of it and what is known beside; raises DataError."""
    content = encode(piece)
    _write(folder / name_of(tile), content)
    record = {"about": {**describe(piece, content), **about}, "beside": beside}
    write_record(record, _record_of(tile, folder))


def write_record(content: dict[str, Any], path: Path) -> None:
    """Write what a task found; raises DataError when the disk is full."""
    _write(path, json.dumps(content).encode())


def read_record(path: Path) -> dict[str, Any] | None:
    """What a task found; None where there is no record, or a damaged one."""
    try:
        content = json.loads(read_bytes(path)) if is_file(path) else None
    except (DataError, ValueError):
        return None
    return content if isinstance(content, dict) else None


def _same(known: Mapping[Tile, Made], made_from: Mapping[Tile, str]) -> dict[Tile, Made]:
    return {
        tile: made
        for tile, made in known.items()
        if tile in made_from and made.about.get("made_from") == made_from[tile] and _is_whole(made)
    }


def _is_whole(made: Made) -> bool:
    try:
        return bool(hashlib.sha256(read_bytes(made.file)).hexdigest() == made.about["sha256"])
    except DataError:
        return False


def _record_of(tile: Tile, folder: Path) -> Path:
    return (folder / name_of(tile)).with_suffix(".json")


def _write(path: Path, content: bytes) -> None:
    # no fsync: what a crash of the machine cuts short is found by its checksum, and made again
    beside = unfinished(path)
    try:
        beside.write_bytes(content)
        beside.replace(path)
    except OSError as error:
        raise DataError(
            f"{path}: cannot be written ({error.strerror}); free the disk and try again"
        ) from None
