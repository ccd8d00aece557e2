"""Merging of two maps of the same place: the second is brought into the frame of the first, and both are added.

Voxel centres are transformed through geodetic coordinates, because the axes of two local frames differ. Then the second
map is registered to the first, because both georeferences have errors. Evidence and hits of a voxel are added to the
voxel that holds its transformed centre, so geometry shifts by up to half a voxel along each axis. A map in the same
frame that is not registered is added exactly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from factor_graphs.geodesy import LocalFrame
from gnss_sem_map.errors import DataError
from gnss_sem_map.labels.label_set import LabelSet
from gnss_sem_map.mapping import evidence
from gnss_sem_map.mapping.map_alignment import MapMatch, NoMatch, match_maps
from gnss_sem_map.mapping.raw_map import MAP, open_raw
from gnss_sem_map.voxels import attributes, tiles
from gnss_sem_map.voxels.attributes import ATTRIBUTES, Attributes, combined, open_attributes
from gnss_sem_map.voxels.kernels import EVIDENCE_LIMIT, HEIGHT_UNITS, HITS_LIMIT, OF_IMAGES
from gnss_sem_map.voxels.map_json import read_frame
from gnss_sem_map.voxels.semantic_map import SemanticMap
from gnss_sem_map.voxels.tiles import indices_by_tile
from gnss_sem_map.voxels.voxel_map import VoxelMap, keys_of, unpack

PARKED = "vehicle"
"""Class that is left out of the registration: parked vehicles differ between drives."""


@dataclass(frozen=True, eq=False)
class Alignment:
    """How the second map was aligned to the first."""

    match: MapMatch | None
    """The registration; None if only the georeference was used."""
    reason: str
    """Why the registration failed; empty if it succeeded, or was not wanted."""
    overlap: tuple[float, float]
    """Share of the second's voxels that fall into a voxel of the first: by georeference, and as aligned."""


@dataclass(frozen=True, eq=False)
class MergedRuns:
    """Two runs as one."""

    static: VoxelMap
    """The map without moving points."""
    moved: VoxelMap
    """The map of the moving points."""
    keyframes: list[tuple[Path, NDArray[np.float64]]]
    """Files of keyframe scans of both runs, each with T_first_run (4, 4); none unless both runs have some."""
    attributes: Attributes | None
    """Of the voxels of both; None unless both are known."""
    frame: LocalFrame
    """Of the first run."""
    alignment: Alignment

    def write_raw(self, run: Path) -> None:
        """Write `map/`, `attributes/` and `evidence/` of a run folder, without moving points: they are of one drive."""
        tiles.write(SemanticMap.of(self.static + self.moved), run / MAP, self.frame)
        if self.attributes is not None:
            known, of_tiles = self.attributes, indices_by_tile(self.attributes.keys)
            attributes.write(((tile, known[rows]) for tile, rows in of_tiles), run / ATTRIBUTES)
        (run / evidence.FOLDER / evidence.KEYFRAMES).mkdir(parents=True)
        tiles.write(SemanticMap.of(self.moved), run / evidence.FOLDER / evidence.MOVED, self.frame)
        for number, (path, T_first_run) in enumerate(self.keyframes):
            scans = evidence.read_keyframes(path)
            moved = replace(scans, T_lidar_map=scans.T_lidar_map @ np.linalg.inv(T_first_run))
            evidence.write_keyframes(moved, run / evidence.FOLDER / evidence.KEYFRAMES / f"{number}.npz")


def merge(
    first: VoxelMap,
    second: VoxelMap,
    first_frame: LocalFrame | None,
    second_frame: LocalFrame | None,
    T: NDArray[np.float64] | None = None,
) -> VoxelMap:
    """Both maps in the frame of the first; `T` (4, 4) then moves the second in that frame.

    Raises DataError if voxel size or class set differ, or one of the maps is not georeferenced.
    """
    return first + into_frame(second, _known(second_frame), _known(first_frame), T)


def merge_runs(
    first: Path, second: Path, label_set: LabelSet | None = None, match: bool = True
) -> MergedRuns:
    """Maps and evidence of two run folders, in the frame of the first.

    With `match`, the second is registered to the first. Raises DataError for a folder without maps, a damaged one, and
    maps that do not fit together.
    """
    label_set = label_set or tiles.open_map(first / MAP).label_set
    frames = [_known(read_frame(run / MAP)) for run in (first, second)]
    known = [open_raw(run, label_set).evidence for run in (first, second)]
    moved = [one.moved.whole().voxels for one in known]
    static = [_without(run, label_set, part) for run, part in zip((first, second), moved, strict=True)]
    alignment = align(static[0], static[1], frames[0], frames[1], match)
    T = alignment.match.T_target_source if alignment.match else None
    by_georeference = frames[0].pose_of(frames[1])
    places = [np.eye(4), by_georeference if T is None else T @ by_georeference]
    keyframes = [
        (path, T_first) for one, T_first in zip(known, places, strict=True) for path in one.keyframes
    ]
    return MergedRuns(
        merge(static[0], static[1], frames[0], frames[1], T),
        merge(moved[0], moved[1], frames[0], frames[1], T),
        keyframes if all(one.keyframes for one in known) else [],
        _attributes(first, second, frames, T, static[0].voxel_size_m),
        frames[0],
        alignment,
    )


def _attributes(
    first: Path,
    second: Path,
    frames: Sequence[LocalFrame],
    T: NDArray[np.float64] | None,
    voxel_size_m: float,
) -> Attributes | None:
    """The attributes of both runs, in the frame of the first; `T` as in `merge`."""
    known = [open_attributes(run) for run in (first, second)]
    if known[0] is None or known[1] is None:
        return None
    own, other = known[0].whole(), known[1].whole()
    p_second = (unpack(other.keys) + np.float64(0.5)) * voxel_size_m
    p_first = _in_frame(p_second, frames[1], frames[0], T)  # as `into_frame` does, to the last bit
    return combined([own, replace(other, keys=keys_of(p_first, voxel_size_m))])


def _without(run: Path, label_set: LabelSet, moved: VoxelMap) -> VoxelMap:
    try:
        return tiles.read(run / MAP, label_set).voxels - moved
    except DataError:
        raise DataError(f"{run}: map/ and evidence/ are not of one run; make the run again") from None


def align(
    first: VoxelMap, second: VoxelMap, first_frame: LocalFrame, second_frame: LocalFrame, match: bool = True
) -> Alignment:
    """Align the second map to the first: register it with `match`, and keep that if the overlap grows."""
    p_second = _in_frame(second.centres, second_frame, first_frame)
    before = _overlap(first, p_second)
    if not match:
        return Alignment(None, "", (before, before))
    try:
        found = match_maps(first.centres[_is_static(first)], p_second[_is_static(second)])
        after = _overlap(first, _moved(p_second, found.T_target_source))
        if after <= before:
            raise NoMatch(f"{after:.0%} of the voxels would overlap, by georeference {before:.0%} do")
    except NoMatch as error:
        return Alignment(None, str(error), (before, before))
    return Alignment(found, "", (before, after))


def _is_static(voxels: VoxelMap) -> NDArray[np.bool_]:
    parked = [label for label, name in enumerate(voxels.label_set.names) if name == PARKED]
    return np.isin(voxels.labels, parked, invert=True)


def _overlap(voxels: VoxelMap, p_map: NDArray[np.float64]) -> float:
    """Share of the points (n, 3) m that lie in a voxel of the map."""
    if not len(p_map):
        return 0.0
    return float((voxels.indices_of(keys_of(p_map, voxels.voxel_size_m)) >= 0).mean())


def _known(frame: LocalFrame | None) -> LocalFrame:
    if frame is None:
        raise DataError(
            "cannot merge a map without a georeference, whose poses are in a local frame; give drives with GNSS"
        )
    return frame


def into_frame(
    voxels: VoxelMap, source: LocalFrame, target: LocalFrame, T: NDArray[np.float64] | None = None
) -> VoxelMap:
    """The map in another frame, then moved by `T` (4, 4); the evidence of voxels that fall into one is added.

    Raises DataError when a sum overflows, or the frames are too far apart for voxel keys.
    """
    if source == target and T is None:
        return voxels
    p_target = _in_frame(voxels.centres, source, target, T)
    keys, places = np.unique(keys_of(p_target, voxels.voxel_size_m), return_inverse=True)
    evidence = np.zeros((len(keys), voxels.evidence.shape[1]), np.int64)
    hits = np.zeros(len(keys), np.int64)
    np.add.at(evidence, places, voxels.evidence)
    np.add.at(hits, places, voxels.hits)
    if (evidence < -EVIDENCE_LIMIT).any() or (hits > HITS_LIMIT).any():
        raise DataError("cannot merge these maps: a voxel's evidence would overflow 32 bits")
    of_images = None
    if voxels.of_images is not None:
        of_images = np.zeros((len(keys), OF_IMAGES), np.int32)
        np.add.at(of_images, places, voxels.of_images)
    heights = None if voxels.heights is None else np.zeros(len(keys), np.int64)
    if heights is not None:
        np.add.at(heights, places, _moved_heights(voxels, p_target, keys[places]))
    return VoxelMap(
        voxels.voxel_size_m,
        voxels.label_set,
        keys,
        evidence.astype(np.int32),
        hits.astype(np.uint32),
        heights,
        of_images,
    )


def _moved_heights(
    voxels: VoxelMap, p_target: NDArray[np.float64], keys: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Sums of heights (v,) of voxels over the bottom of those (v,) that hold their moved centres.

    Points stay as high over the centre as they were: frames lean against each other by less than a degree.
    """
    over_centre = voxels.surface_heights - voxels.centres[:, 2]
    over_bottom = (p_target[:, 2] + over_centre) / voxels.voxel_size_m - unpack(keys)[:, 2]
    return np.asarray(np.rint(voxels.hits * (HEIGHT_UNITS * over_bottom - 0.5)), np.int64)


def _in_frame(
    p: NDArray[np.float64], source: LocalFrame, target: LocalFrame, T: NDArray[np.float64] | None = None
) -> NDArray[np.float64]:
    """Points (n, 3) m in another frame, then moved by `T` (4, 4)."""
    p_target = p if source == target else target.to_map(*source.to_geodetic(p))
    return p_target if T is None else _moved(p_target, T)


def _moved(p: NDArray[np.float64], T: NDArray[np.float64]) -> NDArray[np.float64]:
    return p @ T[:3, :3].T + T[:3, 3]
