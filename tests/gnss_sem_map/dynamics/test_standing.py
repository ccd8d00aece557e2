"""What stands beside a mover stays, by what its voxels are in other scans."""

import numpy as np

from gnss_sem_map.dynamics.standing import is_occupied, standing

HIT, FREE = [[10], [0]], [[10], [10]]
"""Hits and misses of a voxel."""


def of_scans(*scans):
    return [np.array(scan) for scan in scans]


def stands(in_mover, alone, counted=HIT, whole=True):
    """Whether a voxel stays that is part of a mover in some scans, and in others of what stands, whole or not."""
    scans = [(True, 0)] * in_mover + [(False, 1 + whole)] * alone
    stays = standing(
        [np.array([0], np.int32)] * len(scans),
        [np.array(counted, np.int32)] * len(scans),
        of_scans(*([moved] for moved, _ in scans)),
        of_scans(*([stood] for _, stood in scans)),
    )
    found = {bool(stay[0]) for stay in stays}
    assert len(found) == 1, "a place stands or does not, in all scans alike"
    return found.pop()


def test_a_place_that_stood_alone_in_more_than_half_as_many_scans_stays():
    assert stands(in_mover=2, alone=2)
    assert stands(in_mover=3, alone=2)
    assert not stands(in_mover=4, alone=2)
    assert not stands(in_mover=4, alone=0)


def test_what_is_not_whole_must_have_stood_in_more_scans_than_it_moved():
    assert stands(in_mover=2, alone=3, whole=False)
    assert not stands(in_mover=2, alone=2, whole=False)


def test_what_other_scans_see_through_does_not_stand():
    assert not stands(in_mover=2, alone=10, counted=FREE)


def test_voxels_are_matched_by_place_whatever_their_order_in_the_scans():
    rng = np.random.default_rng(3)
    places = [rng.permutation(40)[: rng.integers(5, 30)].astype(np.int32) for _ in range(12)]
    counts = [rng.integers(0, 3, (2, len(place))).astype(np.int32) for place in places]
    moved = [rng.random(len(place)) < 0.5 for place in places]
    stood = [rng.integers(0, 3, len(place)) for place in places]
    expected = []
    for place, (hits, misses) in zip(places, counts, strict=True):
        expected.append([])
        for voxel, hit, miss in zip(place, hits, misses, strict=True):
            seen = [
                (left[where == voxel].sum(), stays[where == voxel].sum())
                for where, left, stays in zip(places, moved, stood, strict=True)
            ]
            gone, there = np.sum(seen, axis=0)
            expected[-1].append(there > gone and hit > 0 and miss <= hit / 20)
    for stay, oracle in zip(standing(places, counts, moved, stood), expected, strict=True):
        np.testing.assert_array_equal(stay, oracle)


def test_a_drive_without_voxels_has_nothing_that_stands():
    empty = np.zeros(0, np.int32)
    (stay,) = standing([empty], [np.zeros((2, 0), np.int32)], [empty > 0], [empty])
    assert stay.shape == (0,)


def test_what_nobody_else_hit_is_not_occupied():
    np.testing.assert_array_equal(is_occupied([0, 100, 100], [0, 5, 6]), [False, True, False])
