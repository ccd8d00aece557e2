"""The map for robots that navigate with Nav2: an occupancy grid and a costmap, as nav2_map_server reads them.

Source: nav2_map_server, map_io (modes `trinary` and `raw`). Cells are parallel to the axes of the map frame.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.config import Nav2Settings
from gnss_sem_map.errors import ConfigError, DataError
from gnss_sem_map.export.exported import NO_VOXELS, Exported
from gnss_sem_map.export.ground import WINDOW, Ground, ground_of
from gnss_sem_map.files.atomic import adding_folder
from gnss_sem_map.labels.roles import Role

OCCUPIED, UNKNOWN = 100, 255
"""Costs of a free cell are less."""
PIXELS = np.full(256, 254, np.uint8)
"""Of the occupancy grid, by cost."""
PIXELS[OCCUPIED], PIXELS[UNKNOWN] = 0, 205
OTHER_GROUND_COST = 50
"""Least cost of ground that is neither road nor sidewalk, such as a lawn."""
HOLLOW_M = 0.4
"""Nobody drives through a vehicle, though the LiDAR sees the ground under it, and through its windows no roof."""
DRIVEN_M, PASSED = 0.75, 99
"""Nothing stands within half the width of a small vehicle of where the vehicle of the map itself drove."""
SLOPE_OVER_M = 0.5
"""The slope at a place is that from so far behind to so far ahead of it."""
ON_GROUND, HIDES_GROUND = (Role.VEHICLE, Role.PERSON), (Role.BUILDING, Role.POLE)
"""Roles of what always reaches down to the ground, and of what does where that is not seen under it."""


def write_nav2(exported: Exported, folder: Path) -> None:
    """Write `map.yaml` and `map.pgm` (free, occupied, unknown), `costmap.yaml` and `costmap.pgm` (costs from 0 to 99 of
    free cells, by class, slope and step; 100 occupied, 255 unknown) into a new folder.

    A cell is occupied where something stands in the height of the robot over the local ground, where the ground is too
    steep or has too high a step, and under a vehicle or building whose foot is not seen; it is free where the ground
    was seen else. Raises ConfigError for a cell size that does not fit the voxels, and DataError for a map without
    ground.
    """
    size, settings = exported.map.voxel_size_m, exported.nav2
    per_cell = _voxels_per_cell(settings, size)
    extent = exported.extent
    if not extent.count:
        raise DataError(NO_VOXELS)
    west, south = (extent.low[:2] // per_cell).tolist()
    columns, rows = (extent.high[:2] // per_cell + 1 - (west, south)).tolist()
    step, has_ground = max(1, WINDOW // per_cell), False
    with adding_folder(folder) as inside:
        for name in ("map", "costmap"):
            (inside / f"{name}.yaml").write_text(_yaml(name, exported, per_cell * size, west, south), "utf-8")
        with (inside / "map.pgm").open("wb") as grid, (inside / "costmap.pgm").open("wb") as costmap:
            for file in (grid, costmap):
                file.write(f"P5\n{columns} {rows}\n255\n".encode())
            for end in range(rows, 0, -step):
                first = max(end - step, 0)
                strip = np.empty((end - first, columns), np.uint8)
                for x in range(0, columns, step):
                    shape = min(step, columns - x), end - first
                    costs = _costs(exported, (west + x, south + first), shape, per_cell)
                    strip[:, x : x + shape[0]] = costs.T[::-1]
                has_ground |= bool((strip < OCCUPIED).any())
                grid.write(PIXELS[strip].tobytes())
                costmap.write(strip.tobytes())
        if not has_ground:
            raise DataError(
                f"{exported.title}: found no ground that a robot could drive on, which Nav2 needs; see delivery.nav2"
            )


def _voxels_per_cell(settings: Nav2Settings, size: float) -> int:
    cell_m = settings.cell_m or size
    per_cell = max(1, round(cell_m / size))
    if abs(per_cell * size - cell_m) > 1e-6 * cell_m:
        raise ConfigError(
            f"delivery.nav2.cell_m: found {cell_m:g} m, expected a multiple of the map's voxels of {size:g} m"
        )
    return per_cell


def _yaml(name: str, exported: Exported, cell_m: float, west: int, south: int) -> str:
    frame, mode = exported.map.frame, "trinary" if name == "map" else "raw"
    where = "" if frame is None else (
        f"; its origin is at {frame.lat_deg:.10f}, {frame.lon_deg:.10f} deg, {frame.alt_m:.4f} m (WGS 84)"
    )  # fmt: skip
    return (
        f"# frame of the map of gnss-sem-map: x east, y north, m{where}\n"
        f"image: {name}.pgm\nmode: {mode}\nresolution: {cell_m:.10g}\n"
        f"origin: [{west * cell_m:.10g}, {south * cell_m:.10g}, 0.0]\n"
        "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )


def _costs(
    exported: Exported, low: tuple[int, int], shape: tuple[int, int], per_cell: int
) -> NDArray[np.uint8]:
    """Costs of `shape` cells from `low` on."""
    size = exported.map.voxel_size_m
    reach, hollow = max(1, round(SLOPE_OVER_M / size)), round(HOLLOW_M / size)
    edge = 2 + max(reach, 2 * hollow)
    ground = ground_of(
        exported,
        (low[0] * per_cell - edge, low[1] * per_cell - edge),
        (shape[0] * per_cell + 2 * edge, shape[1] * per_cell + 2 * edge),
    )
    costs = _of_columns(ground, exported.nav2, size, reach, hollow)[edge:-edge, edge:-edge]
    driven = _driven(exported, (low[0] * per_cell, low[1] * per_cell), costs.shape)
    costs = np.where(driven & (costs == OCCUPIED), PASSED, costs)
    in_cells = costs.reshape(shape[0], per_cell, shape[1], per_cell)
    return np.asarray(in_cells.max(axis=(1, 3)).astype(np.uint8))  # -1, which is unknown, becomes 255


def _driven(exported: Exported, low: tuple[int, int], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Which columns the vehicle drove over."""
    size, found = exported.map.voxel_size_m, np.zeros(shape, np.uint8)
    wide = 2 * round(DRIVEN_M / size) + 1
    for track in exported.tracks:
        columns = np.floor(track.positions[:, :2] / size).astype(np.int64) - low
        near = np.all((columns >= -wide) & (columns < np.array(shape) + wide), axis=1)
        for i in np.flatnonzero(near[1:] & near[:-1]).tolist():
            cv2.line(found, columns[i, ::-1].tolist(), columns[i + 1, ::-1].tolist(), 1, wide)
    return np.asarray(found > 0, np.bool_)


def _of_columns(
    ground: Ground, settings: Nav2Settings, size: float, reach: int, hollow: int
) -> NDArray[np.int16]:
    """Cost of every column, -1 where it is unknown; wrong near the edge."""
    labels, label_set = ground.standing.labels, ground.standing.voxels.label_set
    costs = np.full(ground.seen.size, -1, np.int16)
    costs[ground.seen.ravel()] = OTHER_GROUND_COST
    is_way = ~ground.over & np.isin(labels, label_set.having(Role.ROAD, Role.SIDEWALK))
    is_way &= ground.seen.ravel()[ground.columns]
    costs[ground.columns[is_way]] = 0
    steepest = np.tan(np.radians(settings.slope_deg))
    slope, step = _slopes(ground.heights, size, reach)
    highest_step = max(settings.step_m, 2 * size * steepest)
    ratio = np.fmax(slope / steepest, step / highest_step).ravel()
    known = np.flatnonzero((costs >= 0) & np.isfinite(ratio))
    worst = np.where(ratio[known] > 1, OCCUPIED, 99 * ratio[known]).astype(np.int16)
    costs[known] = np.maximum(costs[known], worst)
    in_the_way = (ground.above > settings.step_m) & (ground.above < settings.robot_height_m)
    below = np.isin(labels, label_set.having(*HIDES_GROUND)) & ~ground.seen.ravel()[ground.columns]
    costs[ground.columns[ground.over & (in_the_way | below)]] = OCCUPIED
    bodies = np.zeros(costs.size, np.uint8)
    is_body = ground.over & np.isin(labels, label_set.having(*ON_GROUND)) & (ground.above > settings.step_m)
    bodies[ground.columns[is_body]] = 1
    around = np.ones((2 * hollow + 1, 2 * hollow + 1), np.uint8)
    closed = cv2.morphologyEx(bodies.reshape(ground.seen.shape), cv2.MORPH_CLOSE, around)
    costs[closed.ravel() > 0] = OCCUPIED
    return costs.reshape(ground.seen.shape)


def _slopes(
    heights: NDArray[np.float32], size: float, reach: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Slope (rise over run) of every column, and the rise from the column before it to that behind it, at edges."""
    slope, step = np.zeros_like(heights), np.zeros_like(heights)
    for axis in (0, 1):
        rise = np.roll(heights, -reach, axis) - np.roll(heights, reach, axis)
        slope = np.hypot(slope, rise / np.float32(2 * reach * size))
        across = np.abs(np.roll(heights, -1, axis) - np.roll(heights, 1, axis))
        before, behind = np.roll(across, 1, axis), np.roll(across, -1, axis)
        is_edge = (across > before) & (across >= behind)  # and not beside one
        step = np.where(is_edge, np.fmax(step, across), step)
    return slope, step
