"""Two maps of the same place in one frame, added: what both drives saw counts twice as much.

Voxels are moved by their centres, through the Earth: east, north and up differ from origin to origin. A moved voxel
lands in the one that holds its centre, so geometry shifts by up to half a voxel along each axis; evidence and hits are
carried over whole. In its own frame a map is added exactly.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from factor_graphs.geodesy import LocalFrame
from gnss_sem_map import tiles
from gnss_sem_map.errors import DataError
from gnss_sem_map.labels import LabelSet
from gnss_sem_map.voxel_kernels import EVIDENCE_LIMIT, HITS_LIMIT
from gnss_sem_map.voxel_map import State, VoxelMap, keys_of


def merge(
    first: VoxelMap, second: VoxelMap, first_frame: LocalFrame | None, second_frame: LocalFrame | None
) -> VoxelMap:
    """Both maps in the frame of the first.

    Raises DataError for another voxel size or class set, and for maps of which one is not georeferenced: nothing says
    then how they lie to each other.
    """
    return first + into_frame(second, _known(second_frame), _known(first_frame))


def merge_runs(
    first: Path, second: Path, label_set: LabelSet | None = None
) -> tuple[VoxelMap, VoxelMap, LocalFrame]:
    """What stands and what was removed in two run folders, merged in the frame of the first; that frame.

    Raises DataError for a folder without maps, a damaged one, and maps that do not fit together.
    """
    frames = [_known(tiles.read_frame(run / "map")) for run in (first, second)]
    static, removed = [], []
    for run in (first, second):
        refined = tiles.read(run / "refined", label_set)  # map/ holds what moved as well
        gone = refined.states == State.REMOVED
        static.append(refined.voxels[~gone])
        removed.append(refined.voxels[gone])
    stands = merge(static[0], static[1], frames[0], frames[1])
    return stands, merge(removed[0], removed[1], frames[0], frames[1]), frames[0]


def _known(frame: LocalFrame | None) -> LocalFrame:
    if frame is None:
        raise DataError(
            "cannot merge a map without a georeference: its poses are in a frame of their own; give drives with GNSS"
        )
    return frame


def into_frame(voxels: VoxelMap, source: LocalFrame, target: LocalFrame) -> VoxelMap:
    """The map of one frame in another; evidence of voxels that land in the same one is added.

    Raises DataError when a sum overflows, or the frames lie farther apart than voxels reach.
    """
    if source == target:
        return voxels
    p_target = target.to_map(*source.to_geodetic(voxels.centres))
    keys, places = np.unique(keys_of(p_target, voxels.voxel_size_m), return_inverse=True)
    evidence = np.zeros((len(keys), voxels.evidence.shape[1]), np.int64)
    hits = np.zeros(len(keys), np.int64)
    np.add.at(evidence, places, voxels.evidence)
    np.add.at(hits, places, voxels.hits)
    if (evidence < -EVIDENCE_LIMIT).any() or (hits > HITS_LIMIT).any():
        raise DataError("cannot merge these maps: a voxel's evidence would overflow 32 bits")
    return VoxelMap(
        voxels.voxel_size_m, voxels.label_set, keys, evidence.astype(np.int32), hits.astype(np.uint32)
    )
