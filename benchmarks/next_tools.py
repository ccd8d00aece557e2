"""The grid for Nav2 and the terrain models of a simulated drive, against the exact town.

gnss-sem-map simulate -o town --seconds 15
python benchmarks/next_tools.py RUN DRIVE [--within 15]

RUN is a map of DRIVE, best along its true trajectory (`run DRIVE --trajectory DRIVE/truth/trajectory.tum`): otherwise
the errors of the trajectory are in the heights. What was seen is told by the points of the scans at their true poses,
with their true labels: a cell is occupied where something that stands still is in the robot's height band, in the
outline of a parked vehicle, or where the ground rises by more than its step inside the cell; free where the ground was
seen else; unknown where nothing of both was.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import rasterio
import yaml
from numba import njit
from numpy.typing import NDArray
from results_file import keep
from scipy.spatial import cKDTree

from gnss_sem_map.datasets.given_trajectory import read_tum
from gnss_sem_map.export.georeference import Georeference
from gnss_sem_map.runs.finished_run import Run
from gnss_sem_map.scans.deskew import usable_points_in_map
from gnss_sem_map.simulation.drive import prepare
from gnss_sem_map.simulation.ground import ground_height

Array = NDArray[np.float64]
RESULTS = Path(__file__).parent / "results" / "next_tools.json"
GROUND_IDS = (40, 44, 48, 60, 72)
WALL_IDS = (50, 51)
"""What reaches down to the ground, wherever it is seen."""
MOVING_FROM = 250
FREE, OCCUPIED, UNKNOWN = 254, 0, 205
Cells = tuple[NDArray[np.uint8], float, Array]
INSIDE_A_CELL = (-0.4, 0.0, 0.4)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path)
    parser.add_argument("drive", type=Path)
    parser.add_argument("--within", type=float, default=15.0, help="m, of the track")
    parser.add_argument("--out", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    run, town = Run.open(arguments.run), Town(arguments.drive)
    with TemporaryDirectory() as folder:
        grid, dtm = Path(folder) / "nav2", Path(folder) / "terrain"
        run.export(["nav2", "terrain"], folder)
        cells = read_grid(grid / "map.yaml")
        truth, seen = true_grid(cells, run, town)
        figures = {
            "nav2": of_grid(cells, truth, driven(run, town), arguments.within),
            "dtm": of_ground(dtm / "dtm.tif", cells, seen, run, town, arguments.within),
        }
    keep(arguments.out, figures)
    print(json.dumps(figures, indent=1))


class Town:
    """The true ground and vehicles of a drive, in the frame of its map."""

    def __init__(self, drive: Path) -> None:
        about = json.loads((drive / "truth" / "world.json").read_text("utf-8"))
        self.drive, simulation = drive, prepare(None, about["seed"])
        corners = np.vstack([np.zeros(3), 100 * np.eye(3)])
        at = simulation.place.to_map(*simulation.frame.to_geodetic(corners))
        self._shift, self._turn = at[0], (at[1:] - at[0]) / 100
        self._ground = simulation.world.town.ground
        self.poses = read_tum(drive / "truth" / "trajectory.tum")

    def above(self, p_map: Array) -> Array:
        """Height (n,) m of points (n, 3) m over the true ground."""
        p = p_map @ self._turn + self._shift
        return np.asarray(p[:, 2] - heights(self._ground, p[:, 0], p[:, 1]))

    def parked(self, xy: Array) -> NDArray[np.bool_]:
        """Which of the places (n, 2) m are under a vehicle that stands."""
        rows = np.genfromtxt(self.drive / "truth" / "vehicles.csv", delimiter=",", names=True, dtype=None)
        rows = rows[rows["moving"] == 0]
        _, first = np.unique(rows["instance"], return_index=True)
        found = np.zeros(len(xy), np.bool_)
        for row in rows[first]:
            c, s = np.cos(row["yaw_rad"]), np.sin(row["yaw_rad"])
            along, across = ((xy - (row["x_m"], row["y_m"])) @ np.array([[c, -s], [s, c]])).T
            found |= (np.abs(along) < row["length_m"] / 2) & (np.abs(across) < row["width_m"] / 2)
        return found


@njit
def heights(ground, x, y):
    found = np.empty(len(x))
    for i in range(len(x)):
        found[i] = ground_height(ground, x[i], y[i])
    return found


def of_grid(cells: Cells, truth: NDArray[np.uint8], track: Array, within_m: float) -> dict[str, Any]:
    """Cells within some metres of the track: how many are right, and how many on the track are occupied."""
    pixels, size, origin = cells
    rows, columns = np.indices(pixels.shape).reshape(2, -1)
    places = origin + (np.column_stack([columns, rows]) + 0.5) * size
    distance = cKDTree(track).query(places, distance_upper_bound=within_m)[0]
    near = np.isfinite(distance)
    told, true = pixels.ravel()[near], truth.ravel()[near]
    on_track = np.unique(np.floor((track - origin) / size).astype(int), axis=0)
    names = {FREE: "free", OCCUPIED: "occupied", UNKNOWN: "unknown"}
    return {
        "cells": int(near.sum()),
        "right": round(float((told == true).mean()), 5),
        "told_for_true": {
            f"{names[a]} for {names[b]}": int(((told == a) & (true == b)).sum()) for a in names for b in names
        },
        "cells_on_track": len(on_track),
        "occupied_on_track": int((pixels[on_track[:, 1], on_track[:, 0]] == OCCUPIED).sum()),
    }


def read_grid(file: Path) -> Cells:
    """Pixels with the southernmost row first, edge of a cell and lower left corner, as nav2_map_server reads them."""
    about = yaml.safe_load(file.read_text("utf-8"))
    kind, size, most, content = (file.parent / about["image"]).read_bytes().split(b"\n", 3)
    if (kind, most) != (b"P5", b"255"):
        raise ValueError(f"{file}: expected a binary PGM of 8 bits, found {kind!r} of {most!r}")
    columns, rows = map(int, size.split())
    pixels = np.frombuffer(content, np.uint8).reshape(rows, columns)[::-1]
    return pixels, about["resolution"], np.array(about["origin"][:2])


def driven(run: Run, town: Town) -> Array:
    """Places (k, 2) m of the vehicle while it scanned."""
    stamps = [scan.stamp for scan in run.drive().scans]
    poses = run.trajectory
    during = (poses.stamps >= min(stamps)) & (poses.stamps <= max(stamps))
    return np.asarray(poses.positions[during, :2])


def true_grid(cells: Cells, run: Run, town: Town) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """The cells as they are, where they were seen, and where the ground was."""
    shape, size, origin = cells[0].shape, cells[1], cells[2]
    settings = run.settings.delivery.nav2
    ground, band, walls, any_ = (np.zeros(shape, np.bool_) for _ in range(4))
    log = run.drive()
    for scan in log.scans:
        p, usable = usable_points_in_map(scan.read(), scan.stamp, town.poses, log.calibration.T_imu_lidar)
        label = (
            np.fromfile(town.drive / "truth" / "labels" / f"{scan.name}.label", np.uint32)[usable] & 0xFFFF
        )
        column, row = np.floor((p[:, :2] - origin) / size).astype(int).T
        inside = (label < MOVING_FROM) & (row >= 0) & (row < shape[0]) & (column >= 0) & (column < shape[1])
        p, label, row, column = p[inside], label[inside], row[inside], column[inside]
        any_[row, column], is_ground = True, np.isin(label, GROUND_IDS)
        ground[row[is_ground], column[is_ground]] = True
        above, is_wall = town.above(p), np.isin(label, WALL_IDS)
        stands = ~is_ground & (above > settings.step_m) & (above < settings.robot_height_m)
        band[row[stands], column[stands]] = True
        walls[row[is_wall], column[is_wall]] = True
    band |= walls & ~ground
    rows, columns = np.nonzero(any_)
    places = origin + (np.column_stack([columns, rows]) + 0.5) * size
    # an edge is in the cell if it passes between its centre and the middle of a side
    levels = np.stack([
        -town.above(np.column_stack([places + size * np.array([du, dv]), np.zeros(len(places))]))
        for du, dv in ((0, 0), (0.5, 0), (-0.5, 0), (0, 0.5), (0, -0.5))
    ])  # fmt: skip
    blocked = band[rows, columns] | town.parked(places) | (np.ptp(levels, axis=0) > settings.step_m)
    truth = np.where(ground, FREE, UNKNOWN).astype(np.uint8)
    truth[rows[blocked], columns[blocked]] = OCCUPIED
    return truth, ground


def of_ground(
    file: Path, cells: Cells, ground: NDArray[np.bool_], run: Run, town: Town, within_m: float
) -> dict[str, Any]:
    """Errors of the ground within some metres of the track: where it was seen, and under parked vehicles."""
    assert run.frame is not None
    with rasterio.open(file) as tiff:
        up, stddevs = tiff.read()
        rows, columns = np.nonzero(up != tiff.nodata)
        x, y = tiff.transform @ (columns + 0.5, rows + 0.5)
    up, stddevs = up[rows, columns].astype(float), stddevs[rows, columns]
    p = Georeference(run.frame).to_map(np.column_stack([x, y, up]))
    near = np.isfinite(cKDTree(driven(run, town)).query(p[:, :2], distance_upper_bound=within_m)[0])
    p, stddevs = p[near], stddevs[near]
    _, size, origin = cells
    column, row = (
        np.floor((p[:, :2] - origin) / size).astype(int).T.clip(0, np.array(ground.shape[::-1])[:, None] - 1)
    )
    # a pixel is the mean over its area: across a kerb, a point would not do
    errors = np.mean([
        town.above(p + size * np.array([du, dv, 0])) for du in INSIDE_A_CELL for dv in INSIDE_A_CELL
    ], axis=0)  # fmt: skip
    seen, parked = ground[row, column], town.parked(p[:, :2])
    return {
        name: {
            "cells": int(chosen.sum()),
            "rms_m": round(float(np.sqrt((errors[chosen] ** 2).mean())), 4),
            "mean_m": round(float(errors[chosen].mean()), 4),
            "within_2_stddevs": round(float((np.abs(errors) < 2 * stddevs)[chosen].mean()), 3),
        }
        for name, chosen in (
            ("seen", seen & ~parked), ("under parked vehicles", parked), ("interpolated", ~seen & ~parked),
        )
    }  # fmt: skip


if __name__ == "__main__":
    main()
