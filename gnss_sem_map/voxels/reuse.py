"""From what tiles are made: those that an earlier map made from the same need not be made again."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any

from gnss_sem_map.files.untrusted import read_bytes
from gnss_sem_map.voxels.map_json import files_of, tile_of
from gnss_sem_map.voxels.tile_files import Tile

VERSION = version("gnss-sem-map")


def digest(content: Any) -> str:
    """Digest of what decides a tile, which is JSON, and of this version: another one may make another tile of it."""
    return hashlib.sha256(json.dumps([VERSION, content], sort_keys=True).encode()).hexdigest()


@dataclass(frozen=True, eq=False)
class Reuse:
    """From what the tiles of a map are made; those that an earlier map made from the same need not be made again."""

    made_from: Mapping[Tile, str]
    """Digest of all that decides a tile."""
    earlier: Path | None = None
    """Folder of the earlier map."""
    said: dict[Tile, Any] = field(default_factory=dict)
    """What `map.json` is to keep of a tile beside it: JSON, there before the tile is written."""

    def about(self, tile: Tile) -> dict[str, Any]:
        """What `map.json` says of a tile that is made now."""
        known = {"made_from": self.made_from[tile]}
        return known | ({"said": self.said[tile]} if tile in self.said else {})

    @cached_property
    def same(self) -> dict[Tile, dict[str, Any]]:
        """What the earlier map says of the tiles that stay, whose files are whole; none where there is no such map."""
        earlier, found = self.earlier, {}
        if earlier is None:
            return {}
        for name, about in files_of(earlier).items():
            tile = tile_of(name)
            if (
                about.get("made_from") == self.made_from.get(tile, 0)
                and _checksum(earlier / name) == about["sha256"]
            ):
                found[tile] = about
        return found


def _checksum(path: Path) -> str:
    return hashlib.sha256(read_bytes(path)).hexdigest()
