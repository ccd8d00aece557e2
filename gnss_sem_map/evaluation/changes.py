"""What changed from one session to the next: voxels that stand in one and that the other one sees through.

A voxel that is only missing proves nothing: it may have been hidden, or too far away. So the keyframe scans of the
other session must see through its place, again and again, while its own session hits it: what that one sees through as
well is the trail of somebody who walked. Voxels that changed are grouped to objects. Ground is left out, which grazing
rays pass through.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from gnss_sem_map.dynamics.range_images import FARTHEST_M
from gnss_sem_map.dynamics.visibility import WIDE_RATIO, hits_and_misses
from gnss_sem_map.mapping.raw_map import RawMap
from gnss_sem_map.voxels.dbscan import dbscan
from gnss_sem_map.voxels.tiles import joined_voxels
from gnss_sem_map.voxels.voxel_map import VoxelMap, pack, unpack

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


class ChangeSettings(BaseModel):
    """When a voxel has changed, and which of them are an object."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    least_misses: int = Field(
        3, ge=1, description="Least number of keyframe scans that see through the place,"
    )
    misses_per_hit: float = Field(
        3.0,
        gt=0,
        description="and least ratio of them to those that hit it; in its own session, of hits to misses.",
    )
    farthest_m: float = Field(
        40.0, gt=0, le=FARTHEST_M, description="Scans farther than this are no evidence."
    )
    least_points: int = Field(
        2, ge=1, description="A voxel with fewer points is no more than part of an object."
    )
    over_ground_m: float = Field(0.3, ge=0, description="Voxels that are not so far above the lowest stay.")
    together_m: float = Field(
        0.36, gt=0, description="Changed voxels that are nearer are of one object: those of 0.2 m that touch."
    )
    least_voxels: int = Field(12, ge=1, description="Fewer voxels with so many points are no object.")
    least_size_m: float = Field(0.5, ge=0, description="Nor is what is smaller in every direction.")


@dataclass(frozen=True, eq=False)
class ChangedObject:
    """Something that stands in one session and not in the other one, as an upright box in the map frame."""

    appeared: bool
    """Whether it stands in the later session."""
    label: int
    """The class of most of its voxels; -1 without labels."""
    centre: Array
    """(3,) m"""
    yaw: float
    """Of its length, rad from east."""
    size: Array
    """(3,) m: length, width, height."""
    voxels: VoxelMap
    misses: float
    """Median of the keyframe scans that see through its voxels."""
    hits: float
    """Likewise, that hit them."""


def changes_between(
    before: RawMap, after: RawMap, settings: ChangeSettings | None = None
) -> list[ChangedObject]:
    """What vanished, then what appeared; both drives are in one frame, bound to each other. Raises DataError."""
    settings = settings or ChangeSettings()
    return [
        thing
        for appeared, here, there in ((False, before, after), (True, after, before))
        for thing in _objects(here, there, appeared, settings)
    ]


def _objects(
    here: RawMap, there: RawMap, appeared: bool, settings: ChangeSettings
) -> Iterator[ChangedObject]:
    parts = [found for tile in here.fused.tiles for found in _changed(here, there, tile, settings)]
    if not parts:
        return
    size_m = here.fused.voxel_size_m
    order = np.argsort(np.concatenate([part.keys for part, _ in parts]))
    counts = np.concatenate([of_part for _, of_part in parts], axis=1)[:, order]
    voxels = joined_voxels([part for part, _ in parts], size_m, here.fused.label_set)
    clusters = dbscan(voxels.indices, settings.together_m / size_m, 1)
    for cluster in range(clusters.max() + 1):
        rows = np.flatnonzero(clusters == cluster)
        if np.sum(voxels.hits[rows] >= settings.least_points) < settings.least_voxels:
            continue
        thing = _object(voxels[rows], counts[:, rows], appeared)
        if thing.size.max() >= settings.least_size_m:
            yield thing


def _changed(
    here: RawMap, there: RawMap, tile: tuple[int, int], settings: ChangeSettings
) -> Iterator[tuple[VoxelMap, NDArray[np.int32]]]:
    """The voxels of a tile that changed, and how often the other session hit and missed them (2, v)."""
    voxels = here.around((tile,), 0.0)
    some = np.flatnonzero(_over_ground(voxels, settings))
    margin_m = here.fused.voxel_size_m
    some = some[~_is_beside(voxels.keys[some], there.around((tile,), margin_m).keys)]
    counts = _counted(voxels.centres[some], there, settings)
    free = (counts[1] >= settings.least_misses) & (counts[1] > settings.misses_per_hit * counts[0])
    some, counts = some[free], counts[:, free]
    hits, misses = _counted(voxels.centres[some], here, settings)
    stands = hits >= settings.misses_per_hit * misses
    if stands.any():
        yield voxels[some[stands]], counts[:, stands]


def _counted(places: Array, session: RawMap, settings: ChangeSettings) -> NDArray[np.int32]:
    """How many keyframe scans of a session hit the places, and how many see through them (2, v)."""
    counts = np.zeros((2, len(places)), np.int32)
    if not len(places):
        return counts
    keyframes = session.evidence.keyframes_near(places, settings.farthest_m)
    for part in keyframes.parts() if keyframes is not None else ():
        counts += hits_and_misses(places, part, settings.farthest_m, WIDE_RATIO)
    return counts


def _over_ground(voxels: VoxelMap, settings: ChangeSettings) -> Mask:
    """Which voxels stand over the lowest one of the columns around them, a metre wide."""
    size_m = voxels.voxel_size_m
    columns = np.floor_divide(voxels.indices[:, :2], round(1.0 / size_m))
    _, column = np.unique(columns, axis=0, return_inverse=True)
    lowest = np.full(column.max(initial=-1) + 1, np.inf)
    np.minimum.at(lowest, column, voxels.centres[:, 2])
    return np.asarray(voxels.centres[:, 2] - lowest[column] >= settings.over_ground_m)


def _is_beside(keys: NDArray[np.int64], others: NDArray[np.int64]) -> Mask:
    """Which voxels are among others, or touch one of them."""
    found = np.zeros(len(keys), np.bool_)
    for x in (-1, 0, 1):
        for y in (-1, 0, 1):
            for z in (-1, 0, 1):
                found |= np.isin(pack(unpack(keys) + np.array([x, y, z])), others, assume_unique=True)
    return found


def _object(voxels: VoxelMap, counts: NDArray[np.int32], appeared: bool) -> ChangedObject:
    known = voxels.labels[voxels.labels >= 0]
    centre, yaw, size = _box(voxels)
    hits, misses = np.median(counts, axis=1)
    label = int(np.bincount(known).argmax()) if len(known) else -1
    return ChangedObject(appeared, label, centre, yaw, size, voxels, float(misses), float(hits))


def _box(voxels: VoxelMap) -> tuple[Array, float, Array]:
    """The upright box around voxels: centre, yaw, size; of all directions, that of the least area."""
    places = voxels.centres
    yaws = np.radians(np.arange(0.0, 90.0, 2.0))
    c, s = np.cos(yaws), np.sin(yaws)
    along = places[:, :1] * c + places[:, 1:2] * s
    across = places[:, 1:2] * c - places[:, :1] * s
    length, width = (np.ptp(axis, axis=0) + voxels.voxel_size_m for axis in (along, across))
    best = int((length * width).argmin())
    u, v = ((axis[:, best].max() + axis[:, best].min()) / 2 for axis in (along, across))
    low, high = places[:, 2].min(), places[:, 2].max()
    centre = np.array([u * c[best] - v * s[best], u * s[best] + v * c[best], (low + high) / 2])
    size = np.array([length[best], width[best], high - low + voxels.voxel_size_m])
    if size[0] >= size[1]:
        return centre, float(yaws[best]), size
    return centre, float(yaws[best] + np.pi / 2), size[[1, 0, 2]]
