"""Interactive viewer: the map as one web page that works offline and without libraries."""

from __future__ import annotations

import base64
import gzip
import html
import json
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
from numpy.typing import NDArray

from factor_graphs.trajectory import Trajectory
from gnss_sem_map.errors import DataError
from gnss_sem_map.export.raster import NO_VOXELS
from gnss_sem_map.files.atomic import replacing
from gnss_sem_map.labels.label_set import LabelSet
from gnss_sem_map.voxels.semantic_map import SemanticMap, State
from gnss_sem_map.voxels.voxel_map import pack

AXIS_BYTES = 3
"""A zigzag difference of 21-bit voxel indices fits 22 bits."""


@dataclass(frozen=True, eq=False)
class _Voxels:
    """The voxels of the page, one row per voxel."""

    size_m: float
    indices: NDArray[np.int64]
    labels: NDArray[np.uint8]
    """Class index; the number of classes stands for no label."""
    confidence: NDArray[np.uint8]
    """0 to 255."""
    states: NDArray[np.uint8]

    def __getitem__(self, rows: NDArray[Any]) -> _Voxels:
        return _Voxels(
            self.size_m, self.indices[rows], self.labels[rows], self.confidence[rows], self.states[rows]
        )


def write_viewer(
    semantic_map: SemanticMap,
    trajectory: Trajectory | None,
    path: Path | str,
    title: str = "Semantic map",
    most_voxels: int = 3_000_000,
) -> None:
    """Write the map as one HTML file that works from file://, some 2 MB per million voxels.

    Classes, the track, removed and unlabelled voxels are layers to switch; colours show class, height, confidence
    or where the class comes from; a click tells what a voxel is. Above `most_voxels` the unlabelled voxels are left
    out; if that is not enough, voxels are joined by 2 x 2 x 2 until they fit, the most hit one giving the label. The
    page says so. Raises DataError for an empty map or when the file cannot be written.
    """
    label_set = semantic_map.voxels.label_set
    voxels, remark = _within(most_voxels, semantic_map)
    voxels = voxels[np.argsort(_morton(voxels.indices), kind="stable")]
    about = f"{len(voxels.indices):,} voxels of {voxels.size_m:g} m{remark}"
    meta = _meta(voxels, label_set, trajectory) | {"about": about}
    assets = resources.files("gnss_sem_map.export") / "assets"
    page = Template((assets / "viewer.html").read_text("utf-8")).substitute(
        title=html.escape(title),
        meta=json.dumps(meta, separators=(",", ":")).replace("<", "\\u003c"),  # no </script> inside
        voxels=base64.b64encode(gzip.compress(_planes(voxels), 6, mtime=0)).decode("ascii"),
        script="\n".join((assets / name).read_text("utf-8") for name in ("viewer_shaders.js", "viewer.js")),
    )
    with replacing(path) as file:
        file.write(page.encode("utf-8"))


def _within(most_voxels: int, semantic_map: SemanticMap) -> tuple[_Voxels, str]:
    """The voxels to show, and a note about those left out."""
    unlabelled = semantic_map.labels < 0
    remark = ""
    rows = np.arange(len(semantic_map))
    if len(rows) > most_voxels and semantic_map.shown.any():
        rows = np.flatnonzero(~unlabelled)
        remark = ", without the unlabelled ones"
    if not len(rows):
        raise DataError(NO_VOXELS)
    rows = rows[np.argsort(-semantic_map.voxels.hits[rows].astype(np.int64), kind="stable")]
    indices = semantic_map.voxels.indices[rows].astype(np.int64)
    size_m = semantic_map.voxels.voxel_size_m
    while len(rows) > most_voxels:
        indices, size_m = indices >> 1, 2 * size_m
        first = np.sort(np.unique(pack(indices), return_index=True)[1])  # still the most hit first
        rows, indices = rows[first], indices[first]
    if size_m > semantic_map.voxels.voxel_size_m:
        remark += f", joined from {semantic_map.voxels.voxel_size_m:g} m"
    labels = np.where(unlabelled, len(semantic_map.voxels.label_set.names), semantic_map.labels)[rows]
    confidence = np.rint(255 * semantic_map.confidence[rows]).astype(np.uint8)
    return _Voxels(size_m, indices, labels.astype(np.uint8), confidence, semantic_map.states[rows]), remark


def _morton(indices: NDArray[np.int64]) -> NDArray[np.uint64]:
    """Z-order (Morton order) of voxels (v, 3): neighbours in space are mostly neighbours in the file."""
    code = np.zeros(len(indices), np.uint64)
    for axis, values in enumerate((indices - indices.min(axis=0)).astype(np.uint64).T):
        for bit in range(21):
            code |= ((values >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return code


def _planes(voxels: _Voxels) -> bytes:
    """Byte planes, as the decoder of the page expects them: similar bytes side by side compress well."""
    differences = np.diff(
        voxels.indices - voxels.indices.min(axis=0), axis=0, prepend=np.zeros((1, 3), np.int64)
    )
    zigzag = (differences << 1) ^ (differences >> 63)
    planes = [(zigzag[:, axis] >> (8 * byte)) & 0xFF for axis in range(3) for byte in range(AXIS_BYTES)]
    planes += [voxels.labels, voxels.confidence, voxels.states]
    return np.stack(planes).astype(np.uint8).tobytes()


def _meta(voxels: _Voxels, label_set: LabelSet, trajectory: Trajectory | None) -> dict[str, Any]:
    """Metadata for the page; lengths are in voxels from `origin`, the lowest index."""
    origin = voxels.indices.min(axis=0)
    positions = np.empty((0, 3)) if trajectory is None else trajectory.positions
    track = (positions / voxels.size_m - origin).round(2)
    shown = voxels.states != State.REMOVED
    counts = np.bincount(voxels.labels[shown], minlength=len(label_set.names) + 1).tolist()
    low, high = np.percentile(voxels.indices[:, 2] - origin[2], [2, 98])
    framed = shown & (voxels.labels < len(label_set.names))
    framed = framed if framed.any() else shown if shown.any() else ~shown
    low_corner, high_corner = np.percentile(voxels.indices[framed] - origin, [2, 98], axis=0)
    return {
        "voxel_m": voxels.size_m,
        "count": len(voxels.indices),
        "unlabelled": counts[-1],
        "removed": int(np.count_nonzero(~shown)),
        "origin": origin.tolist(),
        "heights": [float(low), float(max(high, low + 1))],
        "view": {
            "target": ((low_corner + high_corner) / 2).tolist(),
            "distance": float(max(40.0, 0.9 * (high_corner - low_corner)[:2].max())),
        },
        "track": track.tolist(),
        "classes": [
            {"name": name, "colour": colour, "count": count}
            for name, colour, count in zip(
                label_set.names, label_set.colours.tolist(), counts[:-1], strict=True
            )
        ],
    }
