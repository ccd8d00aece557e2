"""Range images: what a scan says of a place that it hit, counted through, or could not see."""

import numpy as np
import pytest
from scenes import DENSE
from scipy.spatial.transform import Rotation

from gnss_sem_map.dynamics import range_images
from gnss_sem_map.dynamics.image_rows import CELL_DEG, LOWEST_DEG, Rows
from gnss_sem_map.dynamics.visibility import (
    CUBE_M,
    MARGIN_M,
    SHARP_RATIO,
    WIDE_RATIO,
    KeyframeScans,
    hits_and_misses,
    spatial_order,
)

WALL_M = 20.0


def wall_image(hole=None):
    """A wall around the LiDAR, 20 m away, densely sampled; without a `hole` in azimuth, degrees."""
    azimuths, elevations = np.meshgrid(
        np.radians(np.arange(-180, 180, 0.2)), np.radians(np.arange(-20, 3, 0.2))
    )
    if hole is not None:
        outside = abs(np.degrees(azimuths) - hole) > 10
        azimuths, elevations = azimuths[outside], elevations[outside]
    a, e = azimuths.ravel(), elevations.ravel()
    points = WALL_M * np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=1)
    return image_of(points)


def image_of(points, rows=DENSE):
    image = range_images.empty_image(rows)
    range_images.draw(points, np.eye(4), rows.of_return, image)
    return image


def pose_of(rotation, position):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation.as_matrix(), position
    return T


def seen_at(image, places, T_lidar_map=None, rows=DENSE):
    places = np.asarray(places, float).reshape(-1, 3)
    hits, misses = np.zeros(len(places), np.int32), np.zeros(len(places), np.int32)
    poses = np.eye(4)[None] if T_lidar_map is None else T_lidar_map[None]
    range_images.count_hits_and_misses(
        places, image[None], poses, rows.around, np.arange(1), 3.0, 40.0, 0.3, 0.01, hits, misses
    )
    return hits - misses


@pytest.mark.parametrize("azimuth_deg", [0.0, 90.0, 179.9, -180.0, -35.0])
def test_before_the_wall_is_empty_in_the_wall_is_hit_and_behind_it_nothing_is_known(azimuth_deg):
    a = np.radians(azimuth_deg)
    direction = np.array([np.cos(a), np.sin(a), -0.05])
    places = np.outer([10.0, 20.0, 30.0, 2.0], direction / np.linalg.norm(direction))
    np.testing.assert_array_equal(seen_at(wall_image(), places), [-1, 1, 0, 0])


@pytest.mark.parametrize("ratio", [SHARP_RATIO, WIDE_RATIO])
def test_a_place_is_hit_up_to_the_margin_before_a_wall_and_free_before_that(ratio):
    before = np.array([0.0, -0.05, 0.05, 0.35, 0.45, 0.55])
    places = np.column_stack([WALL_M - before, np.zeros((len(before), 2))])
    wall = KeyframeScans(wall_image()[None], np.eye(4)[None], DENSE)
    hits, misses = hits_and_misses(places, wall, 40.0, ratio)
    np.testing.assert_array_equal(hits, before <= MARGIN_M + ratio * WALL_M)
    np.testing.assert_array_equal(misses, 1 - hits)


@pytest.mark.parametrize("hole", [None, 0.0, 90.0, 180.0])
def test_neighbours_that_are_hidden_together_are_left_out_and_nothing_else_is(hole):
    """In any order of the places the same is counted; only among neighbours is anything left out."""
    rng = np.random.default_rng(0)
    places = rng.uniform((-60, -60, -6), (60, 60, 4), (60_000, 3))
    T_lidar_map = np.linalg.inv(
        pose_of(Rotation.from_euler("ZYX", [40, 2, -3], degrees=True), [7.0, -3.0, 0.5])
    )
    expected, image = seen_at(wall_image(hole), places, T_lidar_map), wall_image(hole)
    order = spatial_order(places)
    clusters = np.array_split(places[order], len(places) // range_images.CLUSTER)
    hidden = [
        range_images._is_hidden(
            *range_images._sphere_around(cluster),
            T_lidar_map,
            DENSE.around,
            image.reshape(-1),
            40.0,
            0.3,
            0.01,
        )
        for cluster in clusters
    ]
    assert 0.3 < np.mean(hidden) < 0.9
    np.testing.assert_array_equal(seen_at(image, places[order], T_lidar_map), expected[order])
    assert set(expected) == {-1, 0, 1}


def test_places_of_one_cube_follow_each_other():
    places = np.random.default_rng(0).uniform(-20, 20, (2000, 3))
    cubes = (places[spatial_order(places)] / CUBE_M).astype(int)
    changes = np.any(np.diff(cubes, axis=0) != 0, axis=1).sum()
    assert changes == len(np.unique(cubes, axis=0)) - 1


def test_where_nothing_came_back_nothing_is_known():
    assert seen_at(wall_image(hole=0.0), [(10.0, 0.0, 0.0)]) == 0


def test_beams_that_pass_only_above_a_place_have_not_looked_through_it():
    image = wall_image()
    cell = int((np.degrees(np.arctan2(-1.0, 10.0)) - LOWEST_DEG) / CELL_DEG)
    image[: DENSE.of_return[cell] + 1] = range_images.EMPTY
    assert seen_at(image, [(10.0, 0.0, -1.0)]) == 0
    assert seen_at(wall_image(), [(10.0, 0.0, -1.0)]) == -1


def test_the_pose_of_the_scan_is_taken_into_account():
    T_lidar_map = np.eye(4)
    T_lidar_map[0, 3] = -5.0  # the LiDAR stood at x = 5 m
    assert seen_at(wall_image(), [(25.0, 0.0, 0.0)], T_lidar_map) == 1
    assert seen_at(wall_image(), [(20.0, 0.0, 0.0)], T_lidar_map) == -1


def test_the_nearest_return_of_a_pixel_counts():
    image = image_of(np.array([[20.0, 0, 0], [10.0, 0, 0], [15.0, 0, 0], [1.0, 0, 0]]))
    assert image[image != range_images.EMPTY].tolist() == [1000]


def test_a_segment_is_hidden_on_a_side_where_something_nearer_stands_or_the_view_ends():
    image = wall_image()
    middle = 1 + range_images.COLUMNS // 2
    left = slice(middle + 12, middle + 30)
    for columns, seen, expected in (
        (slice(0, 0), 800, False),
        (left, 800, True),
        (left, range_images.EMPTY, True),
    ):
        nearer = image.copy()
        nearer[:, columns] = seen  # or the view of the LiDAR ends
        azimuths = np.radians(np.arange(-4, 4.5, 0.4))
        points = WALL_M * np.stack([np.cos(azimuths), np.sin(azimuths), -0.02 + 0 * azimuths], axis=1)
        segments = np.zeros(len(points), np.int32)
        assert range_images.hidden_sides(
            points, segments, np.eye(4), DENSE.of_return, nearer, 1, 0.5
        ).tolist() == [expected]


HEIGHT_M = 1.7


@pytest.mark.parametrize("rings_deg", [np.arange(-24, 2, 0.4), np.arange(-15, 16, 2.0)])
@pytest.mark.parametrize(
    ("shown_m", "expected"),
    [((-9.0, 9.0), False), ((-9.0, 1.0), True), ((0.8, 9.0), True), ((0.8, 1.6), True)],
)
def test_a_car_is_hidden_above_or_below_where_a_fence_stands_before_it_and_not_by_the_road(
    rings_deg, shown_m, expected
):
    """Side of a car at 16 m, on level ground, behind a fence at 8 m that is open where the line of sight meets heights
    of the car between `shown_m`."""
    a, e = (
        angle.ravel() for angle in np.meshgrid(np.radians(np.arange(-20, 20, 0.2)), np.radians(rings_deg))
    )
    rays = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=1)
    with np.errstate(divide="ignore"):
        road = np.where(rays[:, 2] < 0, -HEIGHT_M / rays[:, 2], 70.0)
    beside = abs(rays[:, 1] / rays[:, 0]) < 2.0 / 16
    at_car = HEIGHT_M + 16 / rays[:, 0] * rays[:, 2]
    car = np.where(beside & (at_car > 0) & (at_car < 1.7), 16 / rays[:, 0], np.inf)
    at_fence = HEIGHT_M + 8 / rays[:, 0] * rays[:, 2]
    is_open = (at_car > shown_m[0]) & (at_car < shown_m[1])
    fence = np.where((at_fence > 0) & ~is_open, 8 / rays[:, 0], np.inf)
    points = rays * np.minimum(np.minimum(road, car), fence)[:, None]
    of_car = (car < road) & (car < fence) & (at_car > 0.2)
    rows = Rows.of([points])
    assert range_images.hidden_above_or_below(
        points, np.where(of_car, 0, -1), np.eye(4), rows.of_return, rows.elevations_rad,
        image_of(points, rows), 1, 0.5,
    ).tolist() == [expected]  # fmt: skip


def test_pixels_are_where_the_angles_say():
    """The polynomial of the arc tangent against numpy's."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(2000, 3)) * [20, 20, 3]
    azimuths = np.degrees(np.arctan2(points[:, 1], points[:, 0])) + 180
    elevations = np.degrees(np.arcsin(points[:, 2] / np.linalg.norm(points, axis=1)))
    rows = DENSE.of_return[np.floor((elevations - LOWEST_DEG) / CELL_DEG).astype(int)]
    columns = np.floor(azimuths / range_images.COLUMN_DEG).astype(int) % range_images.COLUMNS
    ranges = np.linalg.norm(points, axis=1)
    expected = range_images.empty_image(DENSE)
    seen = (ranges >= range_images.NEAREST_M) & (rows > 0)
    centimetres = (ranges[seen] * range_images.UNITS_PER_M).astype(np.uint16)
    np.minimum.at(expected, (rows[seen], columns[seen] + 1), centimetres)
    drawn = image_of(points)
    np.testing.assert_array_equal(drawn[:, 1:-1], expected[:, 1:-1])
    np.testing.assert_array_equal(drawn[:, [0, -1]], expected[:, [-2, 1]])
