"""The map before refinement, and the evidence beside it, on disk: written and read tile by tile."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from operator import add
from pathlib import Path

from factor_graphs.geodesy import LocalFrame
from gnss_sem_map.errors import DataError
from gnss_sem_map.files.untrusted import is_folder
from gnss_sem_map.labels.label_set import LabelSet
from gnss_sem_map.mapping import evidence
from gnss_sem_map.mapping.checkpoints import KEYFRAMES, MOVING_POINTS, REMOVED, STATIC, ChunkStore
from gnss_sem_map.mapping.evidence import RunEvidence
from gnss_sem_map.voxels import tiles
from gnss_sem_map.voxels.map_json import files_of, name_of
from gnss_sem_map.voxels.reuse import Reuse, digest
from gnss_sem_map.voxels.semantic_map import SemanticMap
from gnss_sem_map.voxels.tile_files import Tile
from gnss_sem_map.voxels.tiles import TiledMap
from gnss_sem_map.voxels.voxel_map import VoxelMap

MAP, DRIVES = "map", "drives"


@dataclass(frozen=True, eq=False)
class RawMap:
    """The fused map of a run, and its evidence; `open_raw` makes it."""

    fused: TiledMap
    """All points."""
    evidence: RunEvidence

    def static(self, tile: Tile, margin_m: float) -> VoxelMap:
        """The voxels of a tile and of a margin around it, without the points that moved; raises DataError."""
        everything = self.fused.around(tile, margin_m).voxels
        try:
            return everything - self.evidence.moved.around(tile, margin_m).voxels
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
    drives: Sequence[Path], run: Path, frame: LocalFrame, label_set: LabelSet, earlier: Path | None = None
) -> None:
    """Write the sum of the raw maps of drives in one frame; tiles of an `earlier` run that stay are taken from there.

    Raises DataError where the maps do not fit, OSError.
    """
    for place in (Path(MAP), Path(evidence.FOLDER, evidence.MOVED)):
        maps = [
            tiles.open_map(drive / place, label_set, held=0) for drive in drives
        ]  # each tile is read once
        sizes = {one.voxel_size_m for one in maps}
        if len(sizes) > 1 or {one.frame for one in maps} != {frame}:
            raise DataError(
                f"{run}: its drives have voxels of {sorted(sizes)} m, or another frame; map them again"
            )
        (run / place).parent.mkdir(exist_ok=True)
        files = [files_of(drive / place) for drive in drives]
        every = sorted({tile for one in maps for tile in one.tiles})
        made_from = {}
        for tile in every:
            parts = [of_drive.get(name_of(tile)) for of_drive in files]
            made_from[tile] = digest([part["sha256"] for part in parts if part is not None])
        reuse = Reuse(made_from, None if earlier is None else earlier / place)
        changed = [tile for tile in every if tile not in reuse.same]
        tiles.write_tiles(_summed(maps, changed), run / place, frame, maps[0].voxel_size_m, label_set, reuse)


def _summed(maps: Sequence[TiledMap], chosen: Sequence[Tile]) -> Iterator[tuple[Tile, SemanticMap]]:
    for tile in chosen:
        parts = [one.read_tile(tile).voxels for one in maps if tile in one.tiles]
        yield tile, SemanticMap.of(reduce(add, parts))
