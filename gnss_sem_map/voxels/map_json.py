"""The description of a map folder, `map.json`: its origin, classes and voxel size, and the checksum of every tile."""

from __future__ import annotations

import re
from pathlib import Path
from reprlib import repr as brief
from typing import Any

from factor_graphs.geodesy import LocalFrame
from gnss_sem_map.errors import DataError, one_line
from gnss_sem_map.files.structured import read_json
from gnss_sem_map.files.untrusted import is_file, shown
from gnss_sem_map.labels.label_set import LabelSet
from gnss_sem_map.voxels.semantic_map import Reason, State
from gnss_sem_map.voxels.tile_files import Tile

MAP_JSON = "map.json"
FORMAT = 2
NAME = re.compile(r"(-?\d{1,6})_(-?\d{1,6})\.parquet", re.ASCII)


def name_of(tile: Tile) -> str:
    """File of a tile."""
    return f"{tile[0]}_{tile[1]}.parquet"


def tile_of(name: str) -> Tile:
    """The tile of a file; raises DataError for a file that is none."""
    match = NAME.fullmatch(name)
    if match is None:
        raise DataError(
            f"{MAP_JSON}: found tile {brief(name)}, expected a name like 3_-4.parquet; make the map again"
        )
    return int(match[1]), int(match[2])


def describe(
    voxel_size_m: float,
    label_set: LabelSet,
    frame: LocalFrame | None,
    files: dict[str, dict[str, Any]],
) -> dict[str, Any]:
    """The content of `map.json`; `files` are the tiles, each with its voxels, points and checksum."""
    origin = None
    if frame is not None:
        origin = {"lat_deg": frame.lat_deg, "lon_deg": frame.lon_deg, "alt_m": frame.alt_m}
    return {
        "format": FORMAT,
        "voxel_size_m": voxel_size_m,
        "classes": list(label_set.names),
        "class_set": label_set.about(),
        "states": {state.name.lower(): int(state) for state in State},
        "reasons": {reason.name.lower(): int(reason) for reason in Reason},
        "origin": origin,
        "axes": "east, north, up at the origin, m" if frame else "x, y, z of the drive's own poses, m",
        "utm_epsg": None if frame is None else frame.utm_epsg,
        "tiles": len(files),
        "voxels": sum(file["voxels"] for file in files.values()),
        "points": sum(file["points"] for file in files.values()),
        "evidence_unit": "2^-10 nat",
        "height_unit": "1/256 of a voxel's edge",
        "key": "x 9 bits, y 9 bits (inside the tile), z 14 bits (+ 8192), in voxels",
        "files": files,
    }


def read_description(path: Path) -> dict[str, Any]:
    """The content of a `map.json`; raises DataError where it is missing, damaged or of another format."""
    if not is_file(path):
        raise DataError(f"{shown(path)}: no map here; expected the folder of a map")
    about = read_json(path)
    if about.get("format") != FORMAT:
        raise DataError(
            f"{shown(path)}: found format {brief(about.get('format'))}, expected {FORMAT}; make the map again"
        )
    damaged = [name for name, is_right in (
        ("voxel_size_m", _is_size(about.get("voxel_size_m"))),
        ("classes", _is_list_of_words(about.get("classes"))),
        ("files", _is_table_of_files(about.get("files"))),
    ) if not is_right]  # fmt: skip
    if damaged:
        raise DataError(f"{shown(path)}: damaged, missing {damaged}; make the map again")
    for name in about["files"]:
        tile_of(name)
    return about


def files_of(folder: Path | None) -> dict[str, dict[str, Any]]:
    """What `map.json` of a folder says of its files; nothing where there is no map, or a damaged one."""
    if folder is None:
        return {}
    try:
        files: dict[str, dict[str, Any]] = read_description(folder / MAP_JSON)["files"]
    except DataError:
        return {}
    return {name: about for name, about in files.items() if is_file(folder / name)}


def read_frame(folder: Path) -> LocalFrame | None:
    """The local frame of a map; None for one in its drive's own poses. Raises DataError."""
    origin = read_description(folder / MAP_JSON).get("origin")
    try:
        return (
            None if origin is None else LocalFrame(**{name: float(value) for name, value in origin.items()})
        )
    except (TypeError, ValueError, AttributeError) as error:
        raise DataError(
            f"{shown(folder / 'map.json')}: found origin {brief(origin)}, expected lat_deg, lon_deg, alt_m"
            f" ({one_line(error)})"
        ) from None


def _is_size(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and 1e-3 <= value <= 1e3


def _is_list_of_words(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(word, str) for word in value)


def _is_table_of_files(value: Any) -> bool:
    return isinstance(value, dict) and all(map(is_about_a_tile, value.values()))


def is_about_a_tile(value: Any) -> bool:
    """Whether this is what `map.json` says of a tile."""
    numbers = ("voxels", "points")
    return (
        isinstance(value, dict)
        and all(type(value.get(name)) is int for name in numbers)
        and isinstance(value.get("sha256"), str)
    )
