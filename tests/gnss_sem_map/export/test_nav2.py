"""The grid for Nav2, read by the documented rules of nav2_map_server, against a street that is known exactly."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from hillside import CANOPY, CAR, HEDGE, MOVED, ROAD, SIGN, SIZE, Part, exported, hillside, in_part
from pydantic import ValidationError

from factor_graphs.trajectory import Trajectory
from gnss_sem_map.config import Nav2Settings
from gnss_sem_map.errors import ConfigError, DataError
from gnss_sem_map.export import nav2
from gnss_sem_map.export.exported import Exported
from gnss_sem_map.export.nav2 import write_nav2

FREE, OCCUPIED, UNKNOWN = 0, 100, -1


def map_server(file: Path) -> tuple[np.ndarray, float, np.ndarray]:
    """The cells of nav_msgs/OccupancyGrid, southernmost row first, resolution and origin, as map_io makes them.

    trinary: occupancy (255 - pixel) / 255 above and below the thresholds; raw: the pixel itself from 0 to 100.
    """
    about = yaml.safe_load(file.read_text())
    kind, size, most, pixels = (file.parent / about["image"]).read_bytes().split(b"\n", 3)
    columns, rows = map(int, size.split())
    assert (kind, most, about["negate"], about["origin"][2]) == (b"P5", b"255", 0, 0)
    image = np.frombuffer(pixels, np.uint8).reshape(rows, columns)[::-1].astype(int)
    occupancy = (255 - image) / 255
    if about["mode"] == "trinary":
        cells = np.where(occupancy > about["occupied_thresh"], OCCUPIED, UNKNOWN)
        cells[occupancy < about["free_thresh"]] = FREE
    else:
        assert about["mode"] == "raw"
        cells = np.where(image <= 100, image, UNKNOWN)
    return cells, about["resolution"], np.array(about["origin"][:2])


def cells_of(part: Part, grid: tuple[np.ndarray, float, np.ndarray]) -> np.ndarray:
    cells, size, origin = grid
    rows, columns = np.indices(cells.shape).reshape(2, -1)
    places = origin + (np.column_stack([columns, rows]) + 0.5) * size
    return cells.ravel()[in_part(np.floor(places / SIZE).astype(int), part)]


def written(e: Exported, folder: Path, **robot: float) -> tuple[np.ndarray, float, np.ndarray]:
    write_nav2(replace(e, nav2=Nav2Settings.model_validate(robot)), folder)
    return map_server(folder / "map.yaml")


def test_road_is_free_and_what_stands_in_the_robots_height_is_occupied(tmp_path: Path) -> None:
    grid = written(exported(), tmp_path / "nav2")
    assert grid[1] == SIZE
    assert (cells_of(CAR, grid) == OCCUPIED).all()
    assert (cells_of(SIGN, grid) == OCCUPIED).all()
    assert (cells_of(HEDGE, grid) == OCCUPIED).all()
    assert (cells_of(MOVED, grid) == FREE).all()
    # trees hang over road and sidewalk
    assert (cells_of(replace(CANOPY, y=(-4, 3.6)), grid) == FREE).all()
    assert (cells_of(replace(CANOPY, y=(4.4, 8)), grid) == FREE).all()
    assert (cells_of(Part((0, 40), (-6, -4), 0), grid) == FREE).all()
    assert (cells_of(Part((0, 40), (8.4, 9), 0), grid) == UNKNOWN).all()


def test_a_taller_robot_meets_the_branches(tmp_path: Path) -> None:
    grid = written(exported(), tmp_path / "nav2", robot_height_m=3.5)
    assert (cells_of(CANOPY, grid) == OCCUPIED).all()


@pytest.mark.parametrize(("step_m", "is_line"), [(0.05, True), (0.1, True), (0.15, False)])
def test_a_kerb_is_a_line_of_obstacles_for_who_cannot_climb_it(
    step_m: float, is_line: bool, tmp_path: Path
) -> None:
    grid = written(exported(), tmp_path / "nav2", step_m=step_m)
    beside = cells_of(Part((13, 19), (3.4, 4.6), 0), grid).reshape(6, -1)
    assert ((beside == OCCUPIED).sum(axis=0) == (1 if is_line else 0)).all()


def test_ground_that_is_too_steep_is_occupied_and_steeper_ground_costs_more(tmp_path: Path) -> None:
    steep = written(exported(), tmp_path / "steep", slope_deg=1.0)
    assert (cells_of(Part((1, 7), (-3, 3), ROAD), steep) == OCCUPIED).all()
    written(exported(), tmp_path / "nav2")
    costs = map_server(tmp_path / "nav2" / "costmap.yaml")
    road = cells_of(Part((1, 7), (-3, 3), ROAD), costs)
    # 3.2 % of the 17.6 % that 10 degrees are, and a rise of 1.2 cm over two cells
    np.testing.assert_allclose(road, 99 * np.hypot(0.03, 0.01) / np.tan(np.radians(10)), atol=3)
    assert (cells_of(Part((1, 39), (-5.6, -4.4), 0), costs) == nav2.OTHER_GROUND_COST).all()
    assert (cells_of(CAR, costs) == OCCUPIED).all()
    assert (cells_of(Part((0, 40), (8.4, 9), 0), costs) == UNKNOWN).all()


def test_a_large_cell_is_occupied_where_any_part_of_it_is(tmp_path: Path) -> None:
    small, large = (
        written(exported(), tmp_path / "small"),
        written(exported(), tmp_path / "large", cell_m=0.4),
    )
    assert large[1] == 0.4
    assert (cells_of(SIGN, large) == OCCUPIED).all()
    assert (large[0] == OCCUPIED).sum() >= (small[0] == OCCUPIED).sum() / 4
    np.testing.assert_allclose(large[2] / 0.4, np.round(large[2] / 0.4))


def test_nothing_stands_where_the_vehicle_itself_drove(tmp_path: Path) -> None:
    T = np.tile(np.eye(4), (40, 1, 1))
    T[:, :3, 3] = np.column_stack([np.linspace(25, 35, 40), np.full(40, -0.7), np.ones(40)])
    driven = replace(exported(), tracks=[Trajectory(np.arange(40.0), T)])
    assert (cells_of(SIGN, written(driven, tmp_path / "nav2")) == FREE).all()
    assert (cells_of(CAR, map_server(tmp_path / "nav2" / "map.yaml")) == OCCUPIED).all()


def test_windows_join_without_a_seam(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = written(exported(), tmp_path / "whole")
    monkeypatch.setattr(nav2, "WINDOW", 64)
    np.testing.assert_array_equal(written(exported(), tmp_path / "parts")[0], whole[0])


@pytest.mark.parametrize(
    ("robot", "said"),
    [
        ({"step_m": 2.0}, "expected a lower step"), ({"robot_height_m": 0}, "robot_height_m"),
        ({"slope_deg": 90}, "slope_deg"), ({"cell_m": -1}, "cell_m"),
    ],
)  # fmt: skip
def test_a_robot_that_makes_no_sense_is_refused(robot: dict[str, float], said: str) -> None:
    with pytest.raises(ValidationError, match=said):
        Nav2Settings.model_validate(robot)


def test_cells_that_do_not_fit_the_voxels_and_a_map_without_ground_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"found 0.3 m, expected a multiple of the map's voxels of 0.2 m"):
        written(exported(), tmp_path / "nav2", cell_m=0.3)
    m = hillside()
    only_hedge = m[np.flatnonzero(in_part(m.voxels.indices[:, :2], HEDGE))]
    with pytest.raises(DataError, match="found no ground that a robot could drive on"):
        written(exported(semantic_map=only_hedge), tmp_path / "nav2")
    assert not list(tmp_path.iterdir())


def test_a_map_without_a_georeference_has_a_grid_and_no_class_needs_a_name(tmp_path: Path) -> None:
    m = hillside()
    names = tuple(f"class {i}" for i in range(5))
    label_set = replace(m.voxels.label_set, names=names, sources={}, given_roles=m.voxels.label_set.roles)
    other = written(exported(semantic_map=hillside(label_set)), tmp_path / "other")
    np.testing.assert_array_equal(other[0], written(exported(), tmp_path / "nav2")[0])
