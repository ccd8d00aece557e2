"""Evidence of a run besides its map: with it, a finished run is refined again without its scans."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from factor_graphs.geodesy import LocalFrame
from gnss_sem_map.dynamics.range_images import IMAGE_SHAPE
from gnss_sem_map.dynamics.visibility import KeyframeScans
from gnss_sem_map.errors import DataError
from gnss_sem_map.files.archives import Archive, open_archive
from gnss_sem_map.files.untrusted import MOST_BYTES, is_file, shown
from gnss_sem_map.labels.label_set import LabelSet
from gnss_sem_map.refinement.surface_heights import SurfaceHeights
from gnss_sem_map.voxels import tiles
from gnss_sem_map.voxels.semantic_map import SemanticMap
from gnss_sem_map.voxels.voxel_map import VoxelMap

FOLDER = "evidence"
MOVED, MOVING_POINTS, KEYFRAMES, HEIGHTS = (
    "moved",
    "moving_points.npz",
    "keyframes.npz",
    "surface_heights.npz",
)
MOST_KEYFRAME_BYTES = 100_000 * math.prod(IMAGE_SHAPE) * 2
"""Images of keyframe scans that are read: a drive of a hundred kilometres."""


@dataclass(frozen=True, eq=False)
class RunEvidence:
    """The evidence of a run that is not in its tiles."""

    moved: VoxelMap
    """The map of the moving points, which are not refined."""
    moving: Mapping[int, NDArray[np.int64]] = field(default_factory=dict)
    """Frame number -> indices of the moving points among the usable points of the scan."""
    keyframes: KeyframeScans | None = None
    """Scans for free-space evidence; None unless the poses come from LiDAR odometry."""
    surface_heights: SurfaceHeights | None = None
    """None if no step needs them."""


def write(evidence: RunEvidence, run: Path, frame: LocalFrame | None) -> None:
    """Write the folder `evidence/` of a run folder."""
    folder = run / FOLDER
    folder.mkdir()
    tiles.write(SemanticMap.of(evidence.moved), folder / MOVED, frame)
    write_moving_points(evidence.moving, folder / MOVING_POINTS)
    if evidence.keyframes is not None:
        write_keyframes(evidence.keyframes, folder / KEYFRAMES)
    if evidence.surface_heights is not None:
        heights = evidence.surface_heights
        np.savez_compressed(folder / HEIGHTS, keys=heights.keys, sums=heights.sums, counts=heights.counts)


def write_moving_points(moving: Mapping[int, NDArray[np.int64]], path: Path) -> None:
    """Write the indices of the moving points of every frame; raises OSError."""
    frames = sorted(moving)
    indices = [moving[number] for number in frames]
    np.savez_compressed(
        path,
        frames=np.array(frames, np.int64),
        counts=np.array([len(some) for some in indices], np.int64),
        places=np.concatenate([*indices, np.empty(0, np.int64)]).astype(np.int32),
    )


def write_keyframes(scans: KeyframeScans, path: Path) -> None:
    """Write range images and poses of keyframe scans; raises OSError."""
    np.savez_compressed(path, images=scans.images, T_lidar_map=scans.T_lidar_map)


def read(run: Path, label_set: LabelSet) -> RunEvidence:
    """Read the folder `evidence/` of a run folder; raises DataError if something is missing or damaged."""
    folder = run / FOLDER
    if not is_file(folder / MOVING_POINTS):
        raise DataError(
            f"{shown(run)}: found no {FOLDER}/ in it, which is needed to refine the map; make the run again"
        )
    return RunEvidence(
        tiles.read(folder / MOVED, label_set).voxels,
        read_moving_points(folder / MOVING_POINTS),
        read_keyframes(folder / KEYFRAMES) if is_file(folder / KEYFRAMES) else None,
        _heights(folder / HEIGHTS) if is_file(folder / HEIGHTS) else None,
    )


def read_moving_points(path: Path) -> dict[int, NDArray[np.int64]]:
    """The indices of the moving points of every frame; raises DataError."""
    with open_archive(path) as archive:
        frames, counts, places = (
            _array(archive, path, name, "iu", 1) for name in ("frames", "counts", "places")
        )
    if len(frames) != len(counts) or (counts < 0).any() or counts.sum() != len(places) or (places < 0).any():
        raise DataError(
            f"{shown(path)}: found counts or numbers that do not fit its {len(places)} points; make the run again"
        )
    parts = np.split(places.astype(np.int64), np.cumsum(counts)[:-1]) if len(frames) else []
    return dict(zip(frames.tolist(), parts, strict=True))


def read_keyframes(path: Path) -> KeyframeScans:
    """Range images and poses of keyframe scans; raises DataError."""
    with open_archive(path, MOST_KEYFRAME_BYTES) as archive:
        images = _array(archive, path, "images", "u", 3, MOST_KEYFRAME_BYTES)
        T = _array(archive, path, "T_lidar_map", "f", 3)
    is_image = images.dtype == np.uint16 and images.shape == (len(T), *IMAGE_SHAPE)
    if not is_image or T.shape[1:] != (4, 4) or not np.isfinite(T).all():
        raise DataError(
            f"{shown(path)}: found images {images.shape} and poses {T.shape}, expected {(len(T), *IMAGE_SHAPE)} and"
            f" {(len(T), 4, 4)}; make the run again"
        )
    return KeyframeScans(images, T.astype(np.float64))


def _heights(path: Path) -> SurfaceHeights:
    with open_archive(path) as archive:
        keys, counts = (_array(archive, path, name, "i", 1) for name in ("keys", "counts"))
        sums = _array(archive, path, "sums", "f", 1)
    if not len(keys) == len(sums) == len(counts) or (np.diff(keys) <= 0).any() or (counts < 1).any():
        raise DataError(f"{shown(path)}: found voxels out of order, or without points; make the run again")
    return SurfaceHeights(keys.astype(np.int64), sums.astype(np.float64), counts.astype(np.int64))


def _array(
    archive: Archive, path: Path, name: str, kinds: str, dimensions: int, most_bytes: int = MOST_BYTES
) -> NDArray[Any]:
    found = archive.array(name, most_bytes).read()
    if found.dtype.kind not in kinds or found.ndim != dimensions:
        raise DataError(f"{shown(path)}: {name} is {found.dtype} {found.shape}; make the run again")
    return found
