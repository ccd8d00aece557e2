"""The map before refinement, and the evidence beside it, on disk: written and read tile by tile."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from operator import add
from pathlib import Path
from typing import Any

from factor_graphs.geodesy import LocalFrame
from gnss_sem_map.errors import DataError
from gnss_sem_map.files.untrusted import is_folder
from gnss_sem_map.files.work_folder import DRIVES
from gnss_sem_map.labels.label_set import LabelSet, open_label_set
from gnss_sem_map.mapping import evidence
from gnss_sem_map.mapping.checkpoints import KEYFRAMES, MOVING_POINTS, REMOVED, STATIC, ChunkStore
from gnss_sem_map.mapping.evidence import RunEvidence
from gnss_sem_map.mapping.execution import Executor, InProcess
from gnss_sem_map.mapping.tile_tasks import folder_of_tiles, on_tiles
from gnss_sem_map.voxels import tiles
from gnss_sem_map.voxels.map_json import files_of, tile_of
from gnss_sem_map.voxels.reuse import digest, of_map, of_work, save
from gnss_sem_map.voxels.semantic_map import SemanticMap
from gnss_sem_map.voxels.tile_files import Tile
from gnss_sem_map.voxels.tiles import TiledMap
from gnss_sem_map.voxels.voxel_map import VoxelMap

MAP = "map"


@dataclass(frozen=True, eq=False)
class RawMap:
    """The fused map of a run, and its evidence; `open_raw` makes it."""

    fused: TiledMap
    """All points."""
    evidence: RunEvidence

    def around(self, tile: Tile, margin_m: float) -> tuple[VoxelMap, VoxelMap]:
        """The voxels of a tile and of a margin around it: static points, and those that moved; raises DataError."""
        everything = self.fused.around(tile, margin_m)
        moved = self.evidence.moved.around(tile, margin_m)
        try:
            return everything - moved, moved
        except DataError:
            raise DataError("map/ and evidence/ are not of one run; make the run again") from None


def open_raw(run: Path, label_set: LabelSet) -> RawMap:
    """The raw map of a run folder, also of several drives; raises DataError if something is missing or damaged."""
    found = evidence.read(run, label_set)
    drives = sorted((run / DRIVES).iterdir()) if is_folder(run / DRIVES) else []
    keyframes = [path for drive in drives for path in evidence.read(drive, label_set).keyframes]
    found = replace(found, keyframes=[*found.keyframes, *keyframes])
    return RawMap(tiles.open_map(run / MAP, label_set), found)


def write_raw(store: ChunkStore, run: Path, frame: LocalFrame | None) -> None:
    """Write `map/` and `evidence/` of a run folder from the chunks of a drive; raises DataError, OSError."""

    def fused() -> Iterator[tuple[Tile, SemanticMap]]:
        for tile in store.tiles():
            yield tile, SemanticMap.of(store.tile(STATIC, tile) + store.tile(REMOVED, tile))

    def moved() -> Iterator[tuple[Tile, SemanticMap]]:
        for tile in store.tiles():
            removed = store.tile(REMOVED, tile)
            if len(removed):
                yield tile, SemanticMap.of(removed)

    tiles.write_tiles(fused(), run / MAP, frame, store.voxel_size_m, store.label_set)
    (run / evidence.FOLDER).mkdir()
    moved_to = run / evidence.FOLDER / evidence.MOVED
    tiles.write_tiles(moved(), moved_to, frame, store.voxel_size_m, store.label_set)
    evidence.write(store.contents(MOVING_POINTS), store.contents(KEYFRAMES), run)


def write_sum(
    drives: Sequence[Path],
    run: Path,
    frame: LocalFrame,
    classes: str = "urban",
    earlier: Path | None = None,
    *,
    executor: Executor | None = None,
    work: Path | None = None,
) -> None:
    """Write the sum of the raw maps of drives in one frame; tiles of an `earlier` run that stay are taken from there.

    Tiles are tasks of `executor`, by default in this process; those that an interrupted call left in `work` are taken
    from there. Raises DataError where the maps do not fit, OSError.
    """
    label_set = open_label_set(classes)
    for place in (Path(MAP), Path(evidence.FOLDER, evidence.MOVED)):
        folders = [drive / place for drive in drives]
        maps = [tiles.open_map(folder, label_set, held=0) for folder in folders]
        sizes = {one.voxel_size_m for one in maps}
        if len(sizes) > 1 or {one.frame for one in maps} != {frame}:
            raise DataError(
                f"{run}: its drives have voxels of {sorted(sizes)} m, or another frame; map them again"
            )
        (run / place).parent.mkdir(exist_ok=True)
        made_from, voxels = _parts(folders)
        with folder_of_tiles(work, run, place.name) as made_in:
            made = of_map(earlier and earlier / place, made_from) | of_work(made_in, made_from)
            new = {tile: known for tile, known in made_from.items() if tile not in made}
            shared = [str(folder) for folder in folders], classes, str(made_in)
            for _ in on_tiles(SUM_TILES, shared, new, voxels, executor or InProcess()):
                pass
            made |= of_work(made_in, new)
            tiles.write_tiles(sorted(made.items()), run / place, frame, maps[0].voxel_size_m, label_set)


def sum_tiles(
    folders: list[str], classes: str, made_in: str, of_tiles: list[tuple[int, int, str]]
) -> list[None]:
    """Save the sums of tiles of several maps, each with the digest of what it is made from: a task."""
    maps = [tiles.open_map(Path(folder), open_label_set(classes), held=0) for folder in folders]
    for x, y, made_from in of_tiles:
        parts = [one.read_tile((x, y)).voxels for one in maps if (x, y) in one.tiles]
        save((x, y), SemanticMap.of(reduce(add, parts)), {"made_from": made_from}, None, Path(made_in))
    return [None] * len(of_tiles)


SUM_TILES = f"{sum_tiles.__module__}:{sum_tiles.__name__}"


def _parts(folders: Sequence[Path]) -> tuple[dict[Tile, str], dict[Tile, int]]:
    """Of every tile the digest of the files that it is summed from, and their number of voxels."""
    parts: dict[Tile, list[dict[str, Any]]] = {}
    for folder in folders:
        for name, about in files_of(folder).items():
            parts.setdefault(tile_of(name), []).append(about)
    made_from = {tile: digest([about["sha256"] for about in parts[tile]]) for tile in sorted(parts)}
    return made_from, {tile: sum(about["voxels"] for about in parts[tile]) for tile in parts}
