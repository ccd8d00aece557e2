"""The town with its traffic during a sweep, as arrays for ray casting."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from factor_graphs.simulation import Motion
from gnss_sem_map.simulation.compiled import Floats
from gnss_sem_map.simulation.raycast import CELL_M, THING_COLUMNS, Scene
from gnss_sem_map.simulation.town import Colour, Town

_MARGIN_M = 60.0


@dataclass(frozen=True, eq=False)
class Mover:
    """A moving object: model number, colour, exact motion (of the point on the ground below its centre)."""

    name: str
    model: int
    colour: Colour
    motion: Motion


class World:
    """A town, the exact motion of the recording vehicle, and everybody else who moves.

    Instances count from 1: first the parked vehicles in the town's order, then the movers.
    """

    def __init__(self, town: Town, ego: Motion, movers: list[Mover]) -> None:
        self.town, self.ego, self.movers = town, ego, movers
        vehicles = np.array([thing.is_vehicle for thing in town.things])
        numbers = np.where(vehicles, np.cumsum(vehicles), 0)
        self.instances = np.concatenate([numbers, numbers.max() + 1 + np.arange(len(movers))]).astype(
            np.int32
        )
        self._colours = np.array([t.colour for t in town.things] + [m.colour for m in movers])
        self._shapes = np.concatenate([model.shapes for model in town.models])
        self._still = self._rows(np.array([t.model for t in town.things]))
        self._still[:, [0, 1, 2, 3, 6, 7]] = [town.place(thing) for thing in town.things]
        self._moving = self._rows(np.array([m.model for m in movers], int))
        self._moving[:, 12] = 1.0
        self._still[:, 4], self._still[:, 5] = np.cos(self._still[:, 3]), np.sin(self._still[:, 3])
        self._poses: dict[float, Floats] = {}
        self._make_grid()

    def _rows(self, model: npt.NDArray[np.int64]) -> Floats:
        """Rows of `Scene.things` with what does not depend on where things are."""
        models = self.town.models
        first = np.concatenate([[0], np.cumsum([len(m.shapes) for m in models])])
        bounds = np.array([m.bounds for m in models])[model].reshape(-1, 6)
        rows = np.zeros((len(model), THING_COLUMNS))
        rows[:, 13:19] = bounds
        farthest = np.maximum(np.abs(bounds[:, :3]), np.abs(bounds[:, 3:]))
        rows[:, 19] = np.hypot(farthest[:, 0], farthest[:, 1])
        rows[:, 20], rows[:, 21] = first[model], first[model + 1]
        return rows

    def remember(self, stamps: Floats) -> None:
        """Work out the movers' poses at many stamps at once; `scene` would do it one stamp after the other."""
        poses = [mover.motion.poses(stamps) for mover in self.movers]
        if poses:
            self._poses.update(zip(stamps.tolist(), np.stack(poses, axis=1), strict=True))

    def scene(self, start: float, end: float) -> Scene:
        """The scene of a sweep from `start` to `end` (s); motion in between is linear."""
        moving = self._moving.copy()
        if self.movers:
            self._move(moving, *(self._poses_at(stamp) for stamp in (start, 0.5 * (start + end), end)))
        chain, links = self._chains(moving)
        return Scene(
            self.town.ground, np.concatenate([self._still, moving]), self._shapes, self._colours,
            self._corner, self._start, self._members, self._top, chain, links,
        )  # fmt: skip

    def _poses_at(self, stamp: float) -> Floats:
        """(movers, 4, 4)."""
        known = self._poses.get(float(stamp))
        return np.concatenate([m.motion.poses([stamp]) for m in self.movers]) if known is None else known

    def _move(self, rows: Floats, before: Floats, T: Floats, after: Floats) -> None:
        """Poses of the moving objects in the middle of the sweep, and their change from start to end."""
        yaw = np.unwrap([np.arctan2(t[:, 1, 0], t[:, 0, 0]) for t in (before, T, after)], axis=0)
        ground, (x, y, _) = self.town.ground, T[:, :3, 3].T
        xx, xy, yy = ground.curvature
        gx, gy = ground.slope[0] + xx * x + xy * y, ground.slope[1] + xy * x + yy * y
        c, s = np.cos(yaw[1]), np.sin(yaw[1])
        rows[:, :3], rows[:, 3], rows[:, 4], rows[:, 5] = T[:, :3, 3], yaw[1], c, s
        rows[:, 6], rows[:, 7] = c * gx + s * gy, c * gy - s * gx
        rows[:, 8:11], rows[:, 11] = after[:, :3, 3] - before[:, :3, 3], yaw[2] - yaw[0]
        rows[:, 19] += 0.5 * np.hypot(rows[:, 8], rows[:, 9])

    def _make_grid(self) -> None:
        """List the static things by the cells that they touch."""
        places = self._still[:, :2]
        self._corner = places.min(0) - _MARGIN_M
        nx, ny = np.ceil((places.max(0) + _MARGIN_M - self._corner) / CELL_M).astype(int)
        found = [_touched(row, self._corner, ny) for row in self._still]
        things = np.repeat(np.arange(len(found)), [len(cells) for cells in found])
        cells = np.concatenate(found)
        order = np.lexsort((things, cells))
        cells, things = cells[order], things[order]
        self._start = np.searchsorted(cells, np.arange(nx * ny + 1)).astype(np.int32)
        self._members = things.astype(np.int32)
        top = np.full(nx * ny, -np.inf)
        rows = self._still[things]
        np.maximum.at(top, cells, rows[:, 2] + rows[:, 18] + 0.05 * rows[:, 19])  # with room for the shear
        self._top = top.reshape(nx, ny)

    def _chains(self, moving: Floats) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int32]]:
        """For every cell the moving things that may touch it during the sweep, as linked lists."""
        chain, links = np.full(self._top.shape, -1, np.int32), []
        for k, row in enumerate(moving, start=len(self._still)):
            near = np.array([row[:2] - row[19] - 0.1, row[:2] + row[19] + 0.1])
            low, high = np.floor((near - self._corner) / CELL_M).astype(int)
            low, high = np.maximum(low, 0), np.minimum(high, np.array(chain.shape) - 1)
            for i in range(low[0], high[0] + 1):
                for j in range(low[1], high[1] + 1):
                    links.append((k, int(chain[i, j])))
                    chain[i, j] = len(links) - 1
        return chain, np.array(links, np.int32).reshape(-1, 2)


def _touched(row: Floats, corner: Floats, ny: int) -> npt.NDArray[np.int64]:
    """The cells that the bounding box of a thing may touch."""
    (x0, y0), (x1, y1), c, s = row[13:15], row[16:18], row[4], row[5]
    corners = np.array([[x0, y0], [x0, y1], [x1, y0], [x1, y1]]) @ np.array([[c, s], [-s, c]]) + row[:2]
    low, high = np.floor((np.array([corners.min(0), corners.max(0)]) - corner) / CELL_M).astype(int)
    i, j = (grid.ravel() for grid in np.mgrid[low[0] : high[0] + 1, low[1] : high[1] + 1])
    middle = np.column_stack([i + 0.5, j + 0.5]) * CELL_M + corner - row[:2]
    along, across = middle @ np.array([c, s]), middle @ np.array([-s, c])
    reach = 0.5 * CELL_M * np.sqrt(2.0)
    near = (along > x0 - reach) & (along < x1 + reach) & (across > y0 - reach) & (across < y1 + reach)
    return np.asarray((i * ny + j)[near])
