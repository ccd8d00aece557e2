"""Rows of range images: whatever the rings of a LiDAR, each is seen apart, and between two both are asked."""

import numpy as np
import pytest

from gnss_sem_map.dynamics import range_images
from gnss_sem_map.dynamics.image_rows import BEYOND, CELL_DEG, CELLS, FINE, LOWEST_DEG, Rows
from gnss_sem_map.dynamics.visibility import share_seen_through

EVEN_16 = np.arange(-15, 16, 2.0)
EVEN_32 = np.linspace(-30.67, 10.67, 32)
UNEVEN = np.array(
    [-25, -15.6, -11.3, -8.8, -7.2, -6.1, -5.3, -4.6, -4, -3.67, -3.3, -3, -2.67, -1, 1.7, 4.7, 7, 15.0]
)
EVEN_128 = np.linspace(-22.5, 22.5, 128)
HDL_64E = np.concatenate([np.linspace(2.0, -8.33, 32), np.linspace(-8.87, -24.9, 32)])


def sphere(elevations_deg, range_m=20.0, azimuths=1800):
    """What rings see of a sphere around them."""
    a, e = np.meshgrid(
        np.radians(np.linspace(-180, 180, azimuths, endpoint=False)), np.radians(elevations_deg)
    )
    return range_m * np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=-1).reshape(
        -1, 3
    )


def cell_of(elevation_deg):
    return int((elevation_deg - LOWEST_DEG) / CELL_DEG)


def tells(points, rows, elevation_deg, range_m):
    """1 where a scan hits a place straight ahead, -1 where it sees through it, else 0."""
    image = range_images.empty_image(rows)
    range_images.draw(points, np.eye(4), rows.of_return, image)
    hits, misses = np.zeros((2, 1), np.int32)
    place = range_m * np.array([[np.cos(np.radians(elevation_deg)), 0.0, np.sin(np.radians(elevation_deg))]])
    range_images.count_hits_and_misses(
        place, image[None], np.eye(4)[None], rows.around, np.arange(1), 3.0, 40.0, 0.3, 0.01, hits, misses
    )
    return int(hits[0] - misses[0])


@pytest.mark.parametrize("elevations", [EVEN_16, EVEN_32])
def test_rings_that_lie_apart_have_a_row_each_and_the_image_no_more(elevations):
    rows = Rows.of([sphere(elevations)])
    of_rings = [rows.of_return[cell_of(e)] for e in np.sort(elevations) if -25 < e < 4]
    assert (np.diff(of_rings) > 0).all()
    assert len(elevations) <= rows.count <= len(elevations) + 2 * BEYOND


@pytest.mark.parametrize("elevations", [EVEN_16, EVEN_32, UNEVEN, EVEN_128, HDL_64E])
def test_every_elevation_in_view_has_a_row_and_rows_follow_each_other(elevations):
    rows = Rows.of([sphere(elevations)])
    inside = rows.of_return[cell_of(elevations.min()) : cell_of(elevations.max()) + 1]
    assert inside.min() > 0
    assert set(np.diff(inside)) <= {0, 1}
    assert rows.count < 85
    assert rows.around.max() == rows.of_return.max() == rows.count == len(rows.bounds)


def test_rows_of_a_dense_lidar_are_the_cells():
    rows = Rows.of([sphere(HDL_64E)])
    low, high = cell_of(-24.9), cell_of(2.0)
    np.testing.assert_array_equal(np.diff(rows.of_return[low : high + 1]), 1)
    assert not rows.gaps_rad.any()
    at = rows.of_return[low : high + 1]
    np.testing.assert_array_equal(rows.around[low : high + 1], np.stack([at - 1, at, at + 1], axis=1))


def test_a_pattern_without_rings_has_no_gaps():
    rng = np.random.default_rng(0)
    elevations = rng.uniform(-12, 12, 20_000)
    points = sphere(elevations, azimuths=1)
    rows = Rows.of([points])
    assert not rows.gaps_rad[cell_of(-12) : cell_of(12)].any()
    inside = np.arange(max(cell_of(-12), FINE[0]), cell_of(4.0))
    np.testing.assert_array_equal(np.diff(rows.of_return[inside]), 1)


@pytest.mark.parametrize("elevations", [EVEN_16, EVEN_32, UNEVEN, EVEN_128, HDL_64E])
def test_before_a_wall_is_free_in_it_is_hit_and_behind_it_nothing_is_known_at_any_elevation(elevations):
    points = sphere(elevations)
    rows = Rows.of([points])
    for elevation in np.linspace(elevations.min(), elevations.max(), 60):
        found = [tells(points, rows, elevation, range_m) for range_m in (10.0, 20.0, 30.0)]
        assert found == [-1, 1, 0], elevation


@pytest.mark.parametrize("blocked", [0, 1])
def test_what_one_of_two_rings_does_not_see_is_not_known_between_them(blocked):
    points = sphere(EVEN_16)
    rows = Rows.of([points])
    ring = 7 + blocked
    nearer = np.repeat(np.arange(16), 1800) == ring
    assert tells(points, rows, 0.0, 10.0) == -1
    assert tells(np.where(nearer[:, None], 0.3 * points, points), rows, 0.0, 10.0) == 0
    assert tells(points[~nearer], rows, 0.0, 10.0) == 0


def test_of_a_gap_the_angle_between_its_rings_is_known():
    rows = Rows.of([sphere(EVEN_16)])
    for elevation in np.arange(-14.5, 15, 0.5):
        assert np.degrees(rows.gaps_rad[cell_of(elevation)]) == pytest.approx(2.0, abs=1.1 * CELL_DEG)


def test_a_lidar_that_saw_nothing_has_no_rows():
    rows = Rows.of([np.full((5, 3), np.nan, np.float32)])
    assert rows.count == 0
    assert range_images.empty_image(rows).shape[0] == 1
    assert len(rows.of_return) == len(rows.around) == CELLS


@pytest.mark.parametrize("nothing", [np.nan, 0.0])
def test_rows_without_a_return_hide_no_ring_whatever_the_driver_writes(nothing):
    seen = sphere(EVEN_16)
    cloud = np.concatenate([seen, np.full((20 * len(seen), 3), nothing)])
    rows = Rows.of([cloud])
    np.testing.assert_array_equal(rows.seen, Rows.of([seen]).seen)
    assert share_seen_through([cloud], rows) == share_seen_through([seen], rows)


@pytest.mark.parametrize(
    ("points", "low", "high"), [(50_000, 0.9, 1.0), (9_000, 0.3, 0.8), (3_000, 0.0, 0.25)]
)
def test_points_that_are_too_far_apart_see_through_nothing(points, low, high):
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(8 * points, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    cloud = 20.0 * directions[abs(directions[:, 2]) < np.sin(np.radians(22.5))][:points]
    assert low <= share_seen_through([cloud], Rows.of([cloud])) <= high


def test_of_the_rows_around_some_cells_the_first_is_the_lowest_and_the_last_the_highest():
    rng = np.random.default_rng(0)
    for _ in range(100):
        around = Rows(rng.random(CELLS) < rng.random()).around
        first = rng.integers(CELLS)
        rows = around[first : first + 1 + rng.integers(30)].reshape(-1)
        rows = rows[rows > 0]
        if len(rows):
            assert (rows[0], rows[-1]) == (rows.min(), rows.max())
