"""Viewer pages: writing one, reading what it holds, and looking at a place of it."""

import base64
import json
import re
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from browsers import Browser

from factor_graphs.trajectory import Trajectory
from gnss_sem_map.export.viewer import write_viewer
from gnss_sem_map.labels.label_set import LabelSet
from gnss_sem_map.voxels.semantic_map import SemanticMap
from gnss_sem_map.voxels.tiles import in_memory


def part(page: str, name: str) -> str:
    (found,) = re.findall(rf'<script type="[a-z/]+" id="{name}">(.*?)</script>', page, flags=re.DOTALL)
    return str(found)


def decoded(page: str) -> tuple[dict[str, Any], np.ndarray, np.ndarray]:
    """Meta, indices (v, 3) in voxels of the page's level and label, confidence, state (v, 3), by the description in
    the page's script.
    """
    meta = json.loads(part(page, "meta"))
    listed = [node for node in meta["nodes"] if node[0] == meta["level"]]
    nodes = [unpacked(*each, meta) for each in zip(listed, part(page, "voxels").split("\n"), strict=True)]
    return meta, np.concatenate([cells for cells, _ in nodes]), np.concatenate([about for _, about in nodes])


def unpacked(listed: list[int], text: str, meta: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Indices (v, 3) and label, confidence, state (v, 3) of a node."""
    level, x, y, low, high, *quadrants = listed
    planes = np.frombuffer(zlib.decompress(base64.b64decode(text)), np.uint8).reshape(9, -1)
    assert planes.shape[1] == sum(quadrants)
    lower, upper = planes[:6].astype(np.int64).reshape(3, 2, -1).transpose(1, 0, 2)
    zigzag = lower | upper << 8
    cells = np.cumsum((zigzag >> 1) ^ -(zigzag & 1), axis=1).T + np.array([512 * x, 512 * y, low])
    assert cells[:, 2].max() == high
    return cells + (np.array(meta["origin"]) >> level), planes[6:].T


def written(tmp_path: Path, semantic_map: SemanticMap, track: Trajectory | None, **settings: Any) -> str:
    tracks = [] if track is None else [track]
    write_viewer(in_memory(semantic_map), tracks, tmp_path / "viewer.html", **settings)
    return (tmp_path / "viewer.html").read_text("utf-8")


def hostile(street: SemanticMap) -> SemanticMap:
    old = street.voxels.label_set
    names = (
        "</script><script>document.title='owned'</script>",
        "<img src=x onerror=alert(1)>",
        "a&b",
        '"',
        "$title",
    )
    spiteful = LabelSet("x", names, old.colours, old.semantic_kitti_ids, old.asprs_codes, {})
    return replace(street, voxels=replace(street.voxels, label_set=spiteful))


def look_at(browser: Browser, metres: tuple[float, float, float], distance_m: float) -> None:
    """Turn the camera to a place of the map, from so far away."""
    browser.run(
        f"camera.target = {list(metres)}.map((m, k) => m / meta.voxel_m - meta.origin[k]);"
        f"camera.distance = {distance_m} / meta.voxel_m;"
    )
