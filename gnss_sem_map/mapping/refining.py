"""Refinement of a map on disk, block by block: figures of the whole map first, then every block with its halo.

Both are tasks: they read the raw map, and save what they find in a folder, tile by tile. What a block is refined from
has a digest. A block that was refined from the same is taken over, from an earlier map or from an interrupted call: so
a drive that is added to a large map touches the blocks around it only. The first tile of a block says what was found of
the block.
"""

from __future__ import annotations

import base64
import hashlib
import io
import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, lru_cache, partial, reduce
from operator import add
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np

from gnss_sem_map.config import Settings
from gnss_sem_map.dynamics.visibility import origins_of
from gnss_sem_map.files.memo import recall, remember
from gnss_sem_map.geometric_classifier import features
from gnss_sem_map.labels import sensor_model
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.labels.sensor_model import LabelCalibration
from gnss_sem_map.mapping import evidence
from gnss_sem_map.mapping.classifying import drives_of, geometric_evidence
from gnss_sem_map.mapping.raw_map import MAP, RawMap, open_raw
from gnss_sem_map.mapping.tile_tasks import block_of, folder_of_tiles, make_tiles, on_blocks
from gnss_sem_map.process.execution import Executor, InProcess, path_of
from gnss_sem_map.process.memory import release_memory
from gnss_sem_map.process.run_stats import Progress, silent
from gnss_sem_map.refinement import crumbs, free_space, kerb_points
from gnss_sem_map.refinement.by_block import (
    geometry_halo_m,
    halo_m,
    refine_block,
    sums_halo_m,
    sums_of,
)
from gnss_sem_map.refinement.figures import Figures, Sums, figures_of
from gnss_sem_map.refinement.kerb_points import Kerbs
from gnss_sem_map.refinement.state import Evidence
from gnss_sem_map.refinement.steps import RefinementReport, RefinementSettings
from gnss_sem_map.voxels import tiles
from gnss_sem_map.voxels.blocks import Block, blocks_of, bounds_of, tiles_around
from gnss_sem_map.voxels.map_json import files_of, name_of
from gnss_sem_map.voxels.reuse import Made, digest, of_map, of_work, save
from gnss_sem_map.voxels.tile_files import TILE_BITS, Tile
from gnss_sem_map.voxels.tiles import places_around
from gnss_sem_map.voxels.voxel_map import VoxelMap, limits_of

REFINED = "refined"


@dataclass(frozen=True, eq=False)
class Refined:
    """What a refinement says beside its map."""

    report: RefinementReport
    kerbs: Kerbs | None
    """Voxels of the refined map whose points are classified one by one; not of the tiles of an earlier map."""


def refine_map(
    raw: RawMap,
    run: Path,
    settings: Settings,
    progress: Progress = silent,
    earlier: Path | None = None,
    *,
    executor: Executor | None = None,
    work: Path | None = None,
) -> Refined:
    """Write `refined/` of a run folder from its raw map; one block and its halo are in memory at a time.

    Blocks are tasks of `executor`, by default in this process. Of an `earlier` run, which may be the same before a
    change, blocks that were refined from the same are taken, and so are those that an interrupted call left in the
    folder `work`. Raises DataError.
    """
    try:
        with folder_of_tiles(work, run, REFINED) as made_in:
            return _Refinement(
                raw, run, settings, progress, earlier, executor or InProcess(), made_in
            ).write()
    finally:
        _inputs.cache_clear()


@dataclass(frozen=True, eq=False)
class _Refinement:
    """One refinement of a map on disk."""

    raw: RawMap
    run: Path
    settings: Settings
    progress: Progress
    earlier: Path | None
    executor: Executor
    made_in: Path
    call: str = field(default_factory=lambda: uuid4().hex)
    """Sets its tasks apart from those of another call, which may have changed the files."""

    def write(self) -> Refined:
        fused = self.raw.fused
        around = self._digests()
        sums = self._sums(around)
        figures = figures_of(reduce(add, sums.values()))
        made_from = self._made_from(around, figures)
        said = {block: {"around": around[block], "sums": sums[block].to_json()} for block in sums}
        made = self._made(made_from, said)
        new = {
            block: {"made_from": made_from[block], "said": said[block]}
            for block in self._blocks
            if block[0] not in made
        }
        made |= make_tiles(
            REFINE_BLOCKS, (*self._shared, asdict(figures)), new, self._voxels, self.executor, self.made_in,
            partial(self.progress, "refinement"),
        )  # fmt: skip
        pieces = [(tile, made[tile]) for tile in fused.tiles]
        tiles.write_tiles(pieces, self.run / REFINED, fused.frame, fused.voxel_size_m, fused.label_set)
        of_blocks = [made[block[0]] for block in self._blocks]
        reports = [RefinementReport.from_json(one.about["said"]["report"]) for one in of_blocks]
        kerbs = [_kerbs(one.beside) for one in of_blocks if one.beside is not None]
        return Refined(RefinementReport.joined(reports), kerb_points.joined(kerbs) if kerbs else None)

    @property
    def _shared(self) -> tuple[Any, ...]:
        """What all tasks are told."""
        return str(self.run), self.settings.model_dump_json(), self.call, str(self.made_in)

    @cached_property
    def _blocks(self) -> list[Block]:
        return blocks_of(self._voxels)

    @cached_property
    def _voxels(self) -> dict[Tile, int]:
        files = files_of(self.run / MAP)
        return {tile: files[name_of(tile)]["voxels"] for tile in self.raw.fused.tiles}

    def _digests(self) -> dict[Block, str]:
        """Digest of the settings, and of the raw map in and around each block."""
        moved = self.run / evidence.FOLDER / evidence.MOVED
        files = files_of(self.run / MAP), files_of(moved)
        sums = [{name: about["sha256"] for name, about in of_layer.items()} for of_layer in files]
        voxel_size_m = self.raw.fused.voxel_size_m
        halo = halo_m(self.settings.refinement, voxel_size_m)
        label_set = self.raw.fused.label_set.about()  # whatever the name of its file
        said = [self.settings.refinement.model_dump_json(), label_set, halo]
        model = opened_sensor_model(self.settings)
        of_all = [said, None if model is None else repr(model.to_yaml())]
        found = {}
        for block in self._blocks:
            near = [name_of(tile) for tile in self._tiles_within(block, halo)]
            found[block] = digest(
                [*of_all, block, [[of_layer.get(name) for name in near] for of_layer in sums]]
            )
        return found

    def _classifier_digests(self) -> dict[Block, list[str]]:
        """What the classifiers of the drives in and around each block are made from."""
        if not self.settings.geometric_classifier.enabled:
            return {block: [] for block in self._blocks}
        size = self.raw.fused.voxel_size_m
        halo = geometry_halo_m(self.settings.refinement, size) + features.reach_m(size)
        drives = [
            (set(files_of(drive.folder / MAP)), drive.digest) for drive in drives_of(self.run, self.settings)
        ]
        found = {}
        for block in self._blocks:
            near = {name_of(tile) for tile in self._tiles_within(block, halo)}
            found[block] = sorted(made_from for tiles, made_from in drives if tiles & near)
        return found

    def _tiles_within(self, block: Block, halo_m: float) -> Iterator[Tile]:
        edge_m = self.raw.fused.voxel_size_m * (1 << TILE_BITS)
        return tiles_around(block, math.ceil(halo_m / edge_m))

    def _sums(self, around: Mapping[Block, str]) -> dict[Block, Sums]:
        """What every block adds to the figures of the map."""
        earlier = files_of(None if self.earlier is None else self.earlier / REFINED)
        known = {}
        for block in self._blocks:
            in_map = earlier.get(name_of(block[0]), {}).get("said")
            saved = recall(_sums_file(block, self.made_in), around[block])
            for said in (in_map, None if saved is None else saved.about):
                try:
                    if isinstance(said, dict) and said["around"] == around[block]:
                        known[block] = Sums.from_json(said["sums"])
                except (KeyError, TypeError, ValueError):
                    continue  # there is none that can be read
        new = {block: around[block] for block in self._blocks if block not in known}
        found = on_blocks(
            MEASURE_BLOCKS, self._shared, new, self._voxels, self.executor, partial(self.progress, "figures")
        )
        for block, sums in found:
            known[block] = Sums.from_json(sums)
        return {block: known[block] for block in self._blocks}

    def _made_from(self, around: Mapping[Block, str], figures: Figures) -> dict[Block, str]:
        """Digest of all that decides each block."""
        classifiers = self._classifier_digests()
        poses = np.concatenate([np.empty((0, 4, 4)), *self.raw.evidence.poses.values()])
        images = np.concatenate([np.empty((0, 32), np.uint8), *self.raw.evidence.image_digests.values()])
        at = origins_of(poses)[:, :2]
        edge = self.raw.fused.voxel_size_m * (1 << TILE_BITS)
        steps = self.settings.refinement
        reach = steps.free_space.farthest_m + _moved_reach_m(steps, self.raw.fused.voxel_size_m)
        found = {}
        for block in self._blocks:
            first, last = bounds_of(block)
            low, high = np.array(first) * edge, (np.array(last) + 1) * edge
            near = ((at > low - reach) & (at < high + reach)).all(axis=1)
            # to 1 um: poses that were saved as quaternions come back with other last bits; + 0.0 makes -0.0 a 0.0
            keyframes = hashlib.sha256((poses[near].round(6) + 0.0).tobytes())
            keyframes.update(images[near].tobytes())
            found[block] = digest([around[block], asdict(figures), keyframes.hexdigest(), classifiers[block]])
        return found

    def _made(self, made_from: Mapping[Block, str], said: Mapping[Block, Any]) -> dict[Tile, Made]:
        """The tiles of blocks that stay; one that is not whole, or without a report to be read, is refined again."""
        of_tiles = {tile: made_from[block] for block in self._blocks for tile in block}
        earlier = of_map(None if self.earlier is None else self.earlier / REFINED, of_tiles)
        there = earlier | of_work(self.made_in, of_tiles)
        found: dict[Tile, Made] = {}
        for block in self._blocks:
            if not all(tile in there for tile in block):
                continue
            of_block = {tile: there[tile] for tile in block}
            first = of_block[block[0]]
            try:
                report = RefinementReport.from_json(first.about["said"]["report"])
            except (KeyError, TypeError, ValueError):
                continue
            about = first.about | {"said": said[block] | {"report": report.to_json()}}
            found |= of_block | {block[0]: replace(first, about=about)}
        return found


class _Inputs:
    """What tasks read of a run; several tasks of one call share the tiles that are in memory."""

    def __init__(self, run: str, settings: str) -> None:
        opened = Settings.model_validate_json(settings)
        self.steps, self.model = opened.refinement, opened_sensor_model(opened)
        self.raw = open_raw(Path(run), open_label_set(opened.classes))
        self.halo = halo_m(self.steps, self.raw.fused.voxel_size_m)
        self.sums_halo = sums_halo_m(self.steps, self.raw.fused.voxel_size_m)
        self.drives = drives_of(Path(run), opened) if opened.geometric_classifier.enabled else []

    def beside(self, block: Block, around: VoxelMap) -> Evidence:
        """What is known beside the voxels `around` a block, those of its halo and maybe more."""
        margin = _moved_reach_m(self.steps, around.voxel_size_m)
        moved, keyframes = self.raw.evidence.moved.around(block, margin), None
        indices = np.concatenate([around.indices[places_around(around, block, margin)], moved.indices])
        if len(indices) and self.steps.free_space.enabled:
            box = (np.stack(limits_of(indices)) + 0.5) * moved.voxel_size_m
            keyframes = self.raw.evidence.keyframes_near(box, self.steps.free_space.farthest_m)
        geometry = None
        if self.steps.geometric_labels.enabled:
            margin = geometry_halo_m(self.steps, around.voxel_size_m)
            geometry = geometric_evidence(self.drives, block, margin)
        return Evidence(moved, self.model, keyframes, geometry)


@lru_cache(1)
def _inputs(run: str, settings: str, call: str) -> _Inputs:
    return _Inputs(run, settings)


OfBlocks = list[tuple[list[list[int]], Any]]
"""Blocks with what a task is told of each, JSON."""


def measure_blocks(
    run: str, settings: str, call: str, made_in: str, of_blocks: OfBlocks
) -> list[dict[str, int]]:
    """Sums of blocks, saved with the digest of what is around each: a task."""
    inputs = _inputs(run, settings, call)
    return [_measure(block_of(block), inputs, around, Path(made_in)) for block, around in of_blocks]


def _measure(block: Block, inputs: _Inputs, around: str, made_in: Path) -> dict[str, int]:
    around_block = inputs.raw.around(block, inputs.sums_halo)
    beside = Evidence(inputs.raw.evidence.moved.around(block, 0), inputs.model)
    sums = sums_of(block, around_block, beside, inputs.steps).to_json()
    remember(_sums_file(block, made_in), around, {"around": around, "sums": sums}, {})
    return sums


def refine_blocks(
    run: str, settings: str, call: str, made_in: str, figures: dict[str, Any], of_blocks: OfBlocks
) -> list[None]:
    """Refine blocks, and save their tiles with what `map.json` is to say of them and their report: a task."""
    inputs = _inputs(run, settings, call)
    for block, about in of_blocks:
        _refine(block_of(block), inputs, Figures(**figures), about, Path(made_in))
        release_memory()  # a large block leaves 300 MB in pieces
    return [None] * len(of_blocks)


def _refine(block: Block, inputs: _Inputs, figures: Figures, about: dict[str, Any], made_in: Path) -> None:
    around = [inputs.raw.around(block, inputs.halo)]
    beside = inputs.beside(block, around[0])
    release_memory()  # 110 MB of tiles that were read and cut
    state, report = refine_block(block, around.pop(), beside, inputs.steps, figures)
    assert state.decided is not None
    # the raw map has them: here they would take a fifth of the bytes
    decided = replace(state.decided, voxels=replace(state.decided.voxels, heights=None, of_images=None))
    said, made_from = about["said"] | {"report": report.to_json()}, {"made_from": about["made_from"]}
    for tile in block:
        piece, is_first = decided[places_around(decided.voxels, (tile,), 0)], tile == block[0]
        of_block = (made_from | {"said": said}, _packed(state.kerbs)) if is_first else (made_from, None)
        save(tile, piece, *of_block, made_in)


def _moved_reach_m(steps: RefinementSettings, voxel_size_m: float) -> float:
    """How far around a block the points that moved are read, m."""
    return free_space.reach_m(steps.free_space, voxel_size_m) + crumbs.reach_m(steps.crumbs, voxel_size_m)


MEASURE_BLOCKS, REFINE_BLOCKS = path_of(measure_blocks), path_of(refine_blocks)


def _sums_file(block: Block, made_in: Path) -> Path:
    return (made_in / name_of(block[0])).with_suffix(".sums.npz")


def _packed(kerbs: Kerbs | None) -> dict[str, Any] | None:
    """Kerbs as JSON."""
    if kerbs is None:
        return None
    file = io.BytesIO()
    np.savez_compressed(file, keys=kerbs.keys, leaning=kerbs.leaning, known=kerbs.known, levels=kerbs.levels)
    arrays = base64.b64encode(file.getvalue()).decode()
    return {"voxel_size_m": kerbs.voxel_size_m, "classes": list(kerbs.classes), "arrays": arrays}


def _kerbs(packed: Any) -> Kerbs:
    road, sidewalk = packed["classes"]
    with np.load(io.BytesIO(base64.b64decode(packed["arrays"])), allow_pickle=False) as arrays:
        return Kerbs(packed["voxel_size_m"], (road, sidewalk), **arrays)


def opened_sensor_model(settings: Settings) -> LabelCalibration | None:
    """The sensor model that the settings name; raises DataError if it is of other classes."""
    return sensor_model.opened(settings.calibration, open_label_set(settings.classes))
