"""What the simulated LiDAR and camera deliver: order, times, labels, pictures, and the same bytes every time."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from gnss_sem_map.simulation import Simulation, prepare
from gnss_sem_map.simulation.noise import gaussian, uniform, value_noise
from gnss_sem_map.simulation.surfaces import RAW_IDS, TRAIN_IDS, Kind


def test_a_file_holds_ring_after_ring_with_azimuth_increasing_from_zero(simulation: Simulation) -> None:
    points = simulation.scan(0).points
    azimuth = np.degrees(np.arctan2(points[:, 1], points[:, 0])) % 360
    elevation = np.degrees(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])))
    rings = np.split(elevation, np.flatnonzero(np.diff(azimuth) < -180) + 1)
    assert len(rings) == len(simulation.lidar.elevations)
    middles = [np.median(ring) for ring in rings]
    assert np.all(np.diff(middles) < 0)
    np.testing.assert_allclose(middles, np.degrees(simulation.lidar.elevations), atol=0.02)


def test_the_time_of_a_point_follows_from_its_azimuth(simulation: Simulation) -> None:
    scan = simulation.scan(3)
    azimuth = np.arctan2(scan.points[:, 1].astype(float), scan.points[:, 0].astype(float))
    np.testing.assert_allclose(0.5 - azimuth / (2 * np.pi), scan.fractions, atol=2e-4)
    assert scan.fractions[azimuth > 3.0].max() < 0.05  # behind on the left: the start


@pytest.mark.integration
def test_the_unit_is_an_hdl_64e() -> None:
    lidar = prepare(0.3, 0).lidar
    assert len(lidar.elevations) == 64
    assert np.degrees(lidar.elevations[[0, -1]]) == pytest.approx([2.0, -24.9])
    assert 360 / lidar.columns == pytest.approx(0.173, abs=0.001)
    assert np.abs(lidar.azimuths).max() < np.pi


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_the_same_seed_gives_the_same_bytes_with_any_number_of_threads(
    seed: int, simulation: Simulation
) -> None:
    def render(k: int) -> list[bytes]:
        again = prepare(1.2, seed, simulation.lidar, simulation.camera) if k == 2 else once
        scan, image = again.scan(k), again.image(k)
        arrays = [scan.points, scan.labels, image.rgb, image.train_ids, image.depth, image.instances]
        return [np.ascontiguousarray(array).tobytes() for array in arrays]

    once = prepare(1.2, seed, simulation.lidar, simulation.camera)
    one_by_one = [render(k) for k in (2, 1, 0)]
    with ThreadPoolExecutor(3) as pool:
        together = list(pool.map(render, (0, 1, 2)))
    assert together == one_by_one[::-1]


def test_another_seed_is_another_town(simulation: Simulation) -> None:
    other = prepare(1.2, 1, simulation.lidar, simulation.camera)
    assert (other.image(0).train_ids != simulation.image(0).train_ids).mean() > 0.2


def test_noise_belongs_to_its_numbers_and_has_the_moments_it_claims() -> None:
    values = np.array([[uniform(1, i, j, 0), gaussian(2, i, j, 0)] for i in range(200) for j in range(100)])
    assert values[:, 0].mean() == pytest.approx(0.5, abs=0.01)
    assert values[:, 0].std() == pytest.approx(12**-0.5, abs=0.01)
    assert values[:, 1].mean() == pytest.approx(0.0, abs=0.03)
    assert values[:, 1].std() == pytest.approx(1.0, abs=0.02)
    assert abs(np.corrcoef(values[:-1, 1], values[1:, 1])[0, 1]) < 0.03
    assert value_noise(3, 4.0, 5.0) == uniform(3, 4, 5, 0)
    assert uniform(3, -4, 5, 0) != uniform(3, 4, 5, 0)


def test_every_kind_has_its_ids_and_only_movers_have_moving_ones() -> None:
    still, moving = RAW_IDS
    for kind in Kind:
        mobile = kind in (Kind.CAR, Kind.TRUCK, Kind.PERSON, Kind.CYCLIST)
        assert (moving[kind] >= 252) == mobile
        assert still[kind] < 252
    assert TRAIN_IDS[[Kind.ROAD, Kind.SIDEWALK, Kind.BUILDING, Kind.FOLIAGE, Kind.CAR]].tolist() == [
        0,
        1,
        2,
        8,
        13,
    ]


def test_moving_labels_are_exactly_the_movers(whole_drive: Simulation) -> None:
    world = whole_drive.world
    movers = set(world.instances[len(world.town.things) :].tolist())
    seen = set()
    for frame in (0, 90, 180, 270):
        labels = whole_drive.scan(frame).labels
        for raw, number in {(int(v) & 0xFFFF, int(v) >> 16) for v in np.unique(labels)}:
            assert (raw >= 252) == (number in movers)
            assert (number > 0) == (raw in (10, 18, 252, 253, 254, 258))
            seen.add(raw)
    assert {10, 252, 254, 40, 48, 50, 51, 70, 71, 80} <= seen


def test_a_picture_is_lit_textured_and_noisy(simulation: Simulation) -> None:
    image = simulation.image(4)
    road = image.rgb[image.train_ids == 0].astype(float)
    assert 25 < road.mean() < 190
    assert road.std() > 4
    sky = image.rgb[image.train_ids == 10].astype(float)
    assert sky.mean() > road.mean()
    assert len(np.unique(image.rgb.reshape(-1, 3), axis=0)) > 5000
    assert (image.depth > 0).sum() == (image.train_ids != 10).sum()


def test_exposure_changes_from_picture_to_picture(whole_drive: Simulation) -> None:
    means = [whole_drive.image(k).rgb.mean() for k in (0, 20, 110, 200)]
    assert np.ptp(means) > 3


def test_points_fall_on_pixels_of_their_own_class(whole_drive: Simulation) -> None:
    """At the moment of exposure, away from borders in the image and where the image's depth is the point's own."""
    expected = {
        40: 0,
        60: 0,
        48: 1,
        50: 2,
        51: (3, 4),
        70: 8,
        71: 8,
        72: 9,
        80: 5,
        10: 13,
        252: 13,
        18: 14,
        44: 255,
    }
    right = total = 0
    for frame in (10, 130, 200, 290):
        scan, image = whole_drive.scan(frame), whole_drive.image(frame)
        u, v, z = whole_drive.project(frame, scan)
        height, width = image.depth.shape
        inner = (z > 0.5) & (u >= 2) & (v >= 2) & (u < width - 2) & (v < height - 2)
        for raw, row, column, depth in zip(
            scan.labels[inner] & 0xFFFF, v[inner], u[inner], z[inner], strict=True
        ):
            around = image.train_ids[row - 2 : row + 3, column - 2 : column + 3]
            visible = abs(depth - image.depth[row, column]) < 0.3 + 0.02 * depth
            if raw in expected and np.ptp(around) == 0 and visible:
                total += 1
                right += bool(np.isin(around[2, 2], expected[int(raw)]))
    assert total > 1500
    assert right / total >= 0.99
