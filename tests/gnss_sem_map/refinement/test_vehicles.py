"""Vehicle rules on small maps whose answer is plain to see."""

import numpy as np

from gnss_sem_map.dynamics.motion_state import Motion
from gnss_sem_map.refinement.vehicles import VehicleSettings, paper, supported

ROAD, VEHICLE, BUILDING = 0, 2, 3


def box(x, y, z):
    return np.stack(np.meshgrid(range(*x), range(*y), range(*z), indexing="ij"), -1).reshape(-1, 3)


def scene(*parts):
    """Voxels (v, 3) and labels (v,) of several (label, voxels)."""
    indices = np.concatenate([voxels for _, voxels in parts]).astype(np.int32)
    labels = np.concatenate([np.full(len(voxels), label, np.int8) for label, voxels in parts])
    return indices, labels


def judge(rule, indices, labels, **numbers):
    settings = VehicleSettings(**numbers)
    if rule is paper:
        return paper(indices, labels, VEHICLE, ROAD, settings, 0.2)
    heights = ((indices[:, 2] + 0.5) * 0.2).astype(np.float32)
    return supported(indices, labels, heights, VEHICLE, ROAD, settings, 0.2)


def test_eq_12_rejects_exactly_the_voxels_without_road_in_their_column():
    indices, labels = scene((ROAD, box((0, 10), (0, 10), (0, 1))), (VEHICLE, box((5, 20), (0, 10), (2, 6))))
    found = judge(paper, indices, labels)
    np.testing.assert_array_equal(found.rejected, (labels == VEHICLE) & (indices[:, 0] >= 10))


def test_eq_13_calls_the_long_and_the_large_moving_and_spares_the_rest():
    road = (ROAD, box((0, 200), (0, 80), (0, 1)))
    car, trail, block = (
        box((10, 30), (10, 19), (1, 7)),
        box((60, 95), (10, 12), (1, 4)),
        box((120, 140), (10, 20), (1, 9)),
    )
    indices, labels = scene(road, (VEHICLE, car), (VEHICLE, trail), (VEHICLE, block))
    found = judge(paper, indices, labels)
    assert [o.motion for o in found.objects] == [Motion.PARKED, Motion.MOVING, Motion.MOVING]
    assert [o.voxels for o in found.objects] == [len(car), len(trail), len(block)]
    np.testing.assert_array_equal(found.moving, (labels == VEHICLE) & (indices[:, 0] >= 60))
    assert "7.0 m" in found.objects[1].reason


def test_a_parked_car_that_hides_the_road_under_it_is_kept_as_a_whole():
    """Eq. 12 deletes it; support by object needs road within a metre of a third of its voxels."""
    road, car = box((0, 100), (0, 20), (0, 1)), box((10, 30), (20, 28), (1, 7))
    indices, labels = scene((ROAD, road), (VEHICLE, car))
    assert judge(paper, indices, labels).rejected.sum() == len(car)
    found = judge(supported, indices, labels)
    assert not found.rejected.any()
    assert [o.motion for o in found.objects] == [Motion.UNKNOWN]


def test_what_bled_onto_a_facade_far_from_the_road_is_no_vehicle():
    road, wall = box((0, 100), (0, 20), (0, 1)), box((10, 40), (60, 62), (2, 12))
    indices, labels = scene((ROAD, road), (VEHICLE, wall))
    found = judge(supported, indices, labels)
    np.testing.assert_array_equal(found.rejected, labels == VEHICLE)
    assert [o.motion for o in found.objects] == [Motion.UNSUPPORTED]


def test_vehicle_voxels_in_the_road_surface_or_above_a_lorry_are_rejected():
    indices, labels = scene(
        (ROAD, box((0, 60), (0, 20), (-2, -1))), (VEHICLE, box((10, 30), (5, 14), (-1, 30)))
    )
    rejected = judge(supported, indices, labels).rejected
    heights = (indices[:, 2] + 0.5) * 0.2
    np.testing.assert_array_equal(rejected, (labels == VEHICLE) & ((heights < 0.1) | (heights > 3.5)))


def test_maps_without_vehicles_or_without_road_are_judged_without_error():
    road, cars = scene((ROAD, box((0, 9), (0, 9), (0, 1)))), scene((VEHICLE, box((0, 9), (0, 9), (1, 4))))
    for rule in (paper, supported):
        found = judge(rule, *road)
        assert not found.rejected.any()
        assert found.objects == ()
        assert judge(rule, *cars).rejected.all()
