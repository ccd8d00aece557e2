"""Refinement of a map on disk, tile by tile: figures of the whole map first, then every tile with its halo.

What a tile is refined from has a digest. A tile that an earlier map refined from the same is taken from there: so a
drive that is added to a large map touches the tiles around it only.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from functools import reduce
from operator import add
from pathlib import Path

import numpy as np

from gnss_sem_map.config import Settings
from gnss_sem_map.labels import sensor_model
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.labels.sensor_model import LabelCalibration
from gnss_sem_map.mapping import evidence
from gnss_sem_map.mapping.raw_map import MAP, RawMap
from gnss_sem_map.refinement import kerb_points
from gnss_sem_map.refinement.by_tile import halo_m, refine_tile, sums_of
from gnss_sem_map.refinement.figures import Figures, Sums, figures_of
from gnss_sem_map.refinement.kerb_points import Kerbs
from gnss_sem_map.refinement.state import Evidence, MapState
from gnss_sem_map.refinement.steps import RefinementReport
from gnss_sem_map.run_stats import Progress, silent
from gnss_sem_map.voxels import tiles
from gnss_sem_map.voxels.map_json import files_of, name_of
from gnss_sem_map.voxels.reuse import Reuse, digest
from gnss_sem_map.voxels.semantic_map import SemanticMap
from gnss_sem_map.voxels.tile_files import TILE_BITS, Tile

REFINED = "refined"


@dataclass(frozen=True, eq=False)
class Refined:
    """What a refinement says beside its map."""

    report: RefinementReport
    kerbs: Kerbs | None
    """Voxels of the refined map whose points are classified one by one; of the tiles that were refined now."""


def refine_map(
    raw: RawMap, run: Path, settings: Settings, progress: Progress = silent, earlier: Path | None = None
) -> Refined:
    """Write `refined/` of a run folder from its raw map; one tile and its halo are in memory at a time.

    Of an `earlier` run, which may be the same before a change, tiles that were refined from the same are taken. Raises
    DataError.
    """
    return _Refinement(raw, run, settings, progress, earlier).write()


class _Refinement:
    """One refinement of a map on disk."""

    def __init__(
        self, raw: RawMap, run: Path, settings: Settings, progress: Progress, earlier: Path | None
    ) -> None:
        self._raw, self._run, self._settings, self._progress = raw, run, settings, progress
        self._earlier = None if earlier is None else earlier / REFINED
        self._model = opened_sensor_model(settings)
        self._halo = halo_m(settings.refinement, raw.fused.voxel_size_m)
        self._tiles: list[Tile] = list(raw.fused.tiles) or [(0, 0)]

    def write(self) -> Refined:
        fused = self._raw.fused
        around = self._digests()
        sums = self._sums(around)
        figures = figures_of(reduce(add, sums.values()))
        reuse = Reuse(self._made_from(around, figures), self._earlier)
        for tile, of_tile in sums.items():
            reuse.said[tile] = {"around": around[tile], "sums": of_tile.to_json()}
        known = _reports(reuse)
        for tile, report in known.items():
            reuse.said[tile]["report"] = report.to_json()
        reports, kerbs = dict(known), []

        def refined(tile: Tile) -> tuple[MapState, RefinementReport]:
            voxels = self._raw.static(tile, self._halo)
            return refine_tile(tile, voxels, self._evidence(tile), self._settings.refinement, figures)

        def pieces() -> Iterator[tuple[Tile, SemanticMap]]:
            changed = [tile for tile in self._tiles if tile not in known]
            for done, tile in enumerate(changed, 1):
                state, report = refined(tile)
                reports[tile] = report
                reuse.said[tile]["report"] = report.to_json()
                kerbs.extend([state.kerbs] if state.kerbs is not None else [])
                self._progress("refinement", done, len(changed))
                assert state.decided is not None
                if fused.tiles:
                    yield tile, state.decided

        tiles.write_tiles(
            pieces(), self._run / REFINED, fused.frame, fused.voxel_size_m, fused.label_set, reuse
        )
        of_all = reduce(add, (reports[tile] for tile in self._tiles))
        return Refined(of_all, kerb_points.joined(kerbs) if kerbs else None)

    def _digests(self) -> dict[Tile, str]:
        """Digest of the settings, and of the raw map in and around each tile."""
        moved = self._run / evidence.FOLDER / evidence.MOVED
        files = files_of(self._run / MAP), files_of(moved)
        sums = [{name: about["sha256"] for name, about in of_layer.items()} for of_layer in files]
        said = [self._settings.refinement.model_dump_json(), self._settings.classes, self._halo]
        model = None if self._model is None else repr(self._model.to_yaml())
        reach = range(-self._tiles_in_halo, self._tiles_in_halo + 1)
        found = {}
        for x, y in self._tiles:
            near = [name_of((x + i, y + j)) for i in reach for j in reach]
            around = [[of_layer.get(name) for name in near] for of_layer in sums]
            found[x, y] = digest([said, model, around])
        return found

    @property
    def _tiles_in_halo(self) -> int:
        return int(np.ceil(self._halo / (self._raw.fused.voxel_size_m * (1 << TILE_BITS))))

    def _sums(self, around: dict[Tile, str]) -> dict[Tile, Sums]:
        """What every tile adds to the figures of the map."""
        known, earlier = {}, files_of(self._earlier)
        for tile in self._tiles:
            try:
                said = earlier[name_of(tile)]["said"]
                if said["around"] == around[tile]:
                    known[tile] = Sums.from_json(said["sums"])
            except (KeyError, TypeError, ValueError):
                continue  # there is none, or none that can be read
        new = [tile for tile in self._tiles if tile not in known]

        def measured(tile: Tile) -> Sums:
            beside, steps = Evidence(sensor_model=self._model), self._settings.refinement
            return sums_of(tile, self._raw.static(tile, self._halo), beside, steps)

        for done, tile in enumerate(new, 1):
            known[tile] = measured(tile)
            self._progress("figures", done, len(new))
        return {tile: known[tile] for tile in self._tiles}

    def _made_from(self, around: dict[Tile, str], figures: Figures) -> dict[Tile, str]:
        """Digest of all that decides each tile."""
        poses = np.concatenate([np.empty((0, 4, 4)), *self._raw.evidence.poses.values()])
        at = -np.einsum("kji,kj->ki", poses[:, :3, :3], poses[:, :3, 3])[:, :2]
        edge = self._raw.fused.voxel_size_m * (1 << TILE_BITS)
        reach = self._settings.refinement.free_space.farthest_m
        found = {}
        for tile in self._tiles:
            low = np.array(tile) * edge
            near = poses[((at > low - reach) & (at < low + edge + reach)).all(axis=1)]
            # to 1 um: poses that were saved as quaternions come back with other last bits; + 0.0 makes -0.0 a 0.0
            keyframes = hashlib.sha256((near.round(6) + 0.0).tobytes()).hexdigest()
            found[tile] = digest([around[tile], asdict(figures), keyframes])
        return found

    def _evidence(self, tile: Tile) -> Evidence:
        found, free_space = self._raw.evidence, self._settings.refinement.free_space
        beside = Evidence(found.moved.around(tile, 0).voxels, self._model)
        own = self._raw.static(tile, 0)
        if not len(own) or not free_space.enabled:
            return beside
        return replace(beside, keyframes=found.keyframes_near(own.centres, free_space.farthest_m))


def _reports(reuse: Reuse) -> dict[Tile, RefinementReport]:
    """The reports of the tiles that stay; a tile without a readable one is refined again."""
    found = {}
    for tile, about in list(reuse.same.items()):
        try:
            found[tile] = RefinementReport.from_json(about["said"]["report"])
        except (KeyError, TypeError, ValueError):
            del reuse.same[tile]
    return found


def opened_sensor_model(settings: Settings) -> LabelCalibration | None:
    """The sensor model that the settings name; raises DataError if it is of other classes."""
    return sensor_model.opened(settings.calibration, open_label_set(settings.classes))
