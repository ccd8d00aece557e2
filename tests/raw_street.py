"""A long street as the raw map of a run folder, for what refines or adds maps on disk."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from long_street import keyframes, street

from factor_graphs.geodesy import LocalFrame
from gnss_sem_map.config import Settings
from gnss_sem_map.mapping import evidence
from gnss_sem_map.voxels import tiles
from gnss_sem_map.voxels.blocks import Block
from gnss_sem_map.voxels.semantic_map import SemanticMap
from gnss_sem_map.voxels.voxel_map import VoxelMap

FRAME = LocalFrame(49.011, 8.423, 112.0)
VOXELS = street()
MOVED = VOXELS[np.flatnonzero(VOXELS.centres[:, 0] > 350.0)[::9]]
"""Of the fourth tile and those after it."""
EVERY = [(x, 0) for x in range(7)]
BLOCKS: list[Block] = [((0, 0),), ((1, 0), (2, 0)), ((3, 0), (4, 0)), ((5, 0), (6, 0))]
"""The tiles that are refined together."""
SETTINGS = Settings().changed("geometric_classifier.enabled=false")
"""Without a classifier, which is of a whole drive: what changes anywhere in the drive would change every block."""


def write_raw(
    run: Path,
    voxels: VoxelMap = VOXELS,
    scans: bool = False,
    moved: VoxelMap = MOVED,
    frame: LocalFrame = FRAME,
) -> Path:
    """The raw map of a run folder, and its evidence, with or without keyframe scans between x = 325 and 350 m."""
    tiles.write(SemanticMap.of(voxels), run / "map", frame)
    tiles.write(SemanticMap.of(moved), run / "evidence" / "moved", frame)
    file = io.BytesIO()
    evidence.write_keyframes(keyframes(), file)
    evidence.write([], [file.getvalue()] if scans else [], run)
    return run


def content(folder: Path) -> dict[str, bytes]:
    """The files of a folder."""
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}
