"""The map before refinement, and the evidence beside it, on disk: written and read tile by tile."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, reduce
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
from gnss_sem_map.mapping.tile_tasks import folder_of_tiles, make_tiles
from gnss_sem_map.process.execution import Executor, InProcess, path_of
from gnss_sem_map.process.memory import release_memory
from gnss_sem_map.voxels import attributes, tiles
from gnss_sem_map.voxels.attributes import ATTRIBUTES
from gnss_sem_map.voxels.blocks import Block
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

    def around(self, block: Block, margin_m: float) -> VoxelMap:
        """The voxels of a block and of a margin around it, without the points that moved; raises DataError."""
        found = replace(self.fused, read_voxels=self._static).around(block, margin_m)
        self._static.leave_room(len(found))
        return found

    @cached_property
    def _static(self) -> tiles.Recent[VoxelMap]:
        """Reads the voxels of a tile without the points that moved."""
        moved = self.evidence.moved

        def read(tile: Tile) -> VoxelMap:
            release_memory()  # a tile and those around it are read in a row
            everything = self.fused.read_voxels(tile)
            try:
                return everything - moved.around((tile,), 0)
            except DataError:
                raise DataError("map/ and evidence/ are not of one run; make the run again") from None

        return tiles.Recent(read)


def open_raw(run: Path, label_set: LabelSet) -> RawMap:
    """The raw map of a run folder, also of several drives; raises DataError if something is missing or damaged."""
    found = evidence.read(run, label_set)
    drives = sorted((run / DRIVES).iterdir()) if is_folder(run / DRIVES) else []
    keyframes = [path for drive in drives for path in evidence.read(drive, label_set).keyframes]
    found = replace(found, keyframes=[*found.keyframes, *keyframes])
    return RawMap(tiles.open_map(run / MAP, label_set, voxels_held=0), found)


def write_raw(store: ChunkStore, run: Path, frame: LocalFrame | None) -> None:
    """Write `map/`, `attributes/` and `evidence/` of a run folder of chunks of a drive; raises DataError, OSError."""

    def one_by_one() -> Iterator[Tile]:
        for tile in store.tiles():
            release_memory()  # of the tiles before: 100 MB in pieces
            yield tile

    def fused() -> Iterator[tuple[Tile, SemanticMap]]:
        for tile in one_by_one():
            yield tile, SemanticMap.of(store.tile(STATIC, tile) + store.tile(REMOVED, tile))

    def moved() -> Iterator[tuple[Tile, SemanticMap]]:
        for tile in one_by_one():
            removed = store.tile(REMOVED, tile)
            if len(removed):
                yield tile, SemanticMap.of(removed)

    tiles.write_tiles(fused(), run / MAP, frame, store.voxel_size_m, store.label_set)
    (run / evidence.FOLDER).mkdir()
    moved_to = run / evidence.FOLDER / evidence.MOVED
    tiles.write_tiles(moved(), moved_to, frame, store.voxel_size_m, store.label_set)
    attributes.write(((tile, store.attributes(tile)) for tile in one_by_one()), run / ATTRIBUTES)
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
        maps = [tiles.open_map(folder, label_set) for folder in folders]
        sizes = {one.voxel_size_m for one in maps}
        if len(sizes) > 1 or {one.frame for one in maps} != {frame}:
            raise DataError(
                f"{run}: its drives have voxels of {sorted(sizes)} m, or another frame; map them again"
            )
        (run / place).parent.mkdir(exist_ok=True)
        parts = _parts(folders)
        made_from = {
            tile: digest([about["sha256"] for about in parts[tile].values()]) for tile in sorted(parts)
        }
        voxels = {tile: sum(about["voxels"] for about in parts[tile].values()) for tile in parts}
        with folder_of_tiles(work, run, place.name) as made_in:
            made = of_map(earlier and earlier / place, made_from) | of_work(made_in, made_from)
            new: dict[Block, dict[str, Any]] = {
                (tile,): {"made_from": made_from[tile], "folders": list(parts[tile])}
                for tile in parts
                if tile not in made
            }
            shared = classes, str(made_in)
            made |= make_tiles(SUM_TILES, shared, new, voxels, executor or InProcess(), made_in)
            tiles.write_tiles(sorted(made.items()), run / place, frame, maps[0].voxel_size_m, label_set)


def sum_tiles(
    classes: str, made_in: str, of_tiles: list[tuple[list[list[int]], dict[str, Any]]]
) -> list[None]:
    """Save the sums of tiles, each with the digest of what it is made from: a task."""
    opened = cache(lambda folder: tiles.open_map(Path(folder), open_label_set(classes), voxels_held=0))
    for ((x, y),), of_tile in of_tiles:
        release_memory()  # of the tiles before
        parts = [opened(folder).read_voxels((x, y)) for folder in of_tile["folders"]]
        about = {"made_from": of_tile["made_from"]}
        save((x, y), SemanticMap.of(reduce(add, parts)), about, None, Path(made_in))
    return [None] * len(of_tiles)


SUM_TILES = path_of(sum_tiles)


def _parts(folders: Sequence[Path]) -> dict[Tile, dict[str, dict[str, Any]]]:
    """Tile -> folder of a map that has it -> what its `map.json` says of it."""
    parts: dict[Tile, dict[str, dict[str, Any]]] = {}
    for folder in folders:
        for name, about in files_of(folder).items():
            parts.setdefault(tile_of(name), {})[str(folder)] = about
    return parts
