"""Returns of the vehicle itself are told from what it passes."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from gnss_sem_map.scans.own_vehicle import FARTHEST_M, NEAREST_M, reach_of_vehicle

SCANS = 8


def surface(x: float, y: tuple[float, float], rng: np.random.Generator) -> NDArray[np.float64]:
    """200 points of an upright surface ahead, with noise."""
    places = rng.uniform((x, y[0], -0.5), (x, y[1], 0.5), (200, 3))
    return places + rng.normal(0, 0.01, places.shape)


def test_what_stays_in_place_in_all_scans_is_the_vehicle() -> None:
    rng = np.random.default_rng(1)
    bonnet = [surface(1.31, (-0.4, 0.4), rng) for _ in range(SCANS)]
    farthest_m = max(np.linalg.norm(points, axis=1).max() for points in bonnet)
    assert farthest_m < reach_of_vehicle(bonnet) < farthest_m + 0.9


@pytest.mark.parametrize("passed", [1, 3, 5])
def test_what_is_passed_now_and_then_is_not(passed: int) -> None:
    rng = np.random.default_rng(2)
    parked = [surface(1.5, (-0.8, 0.8), rng) for _ in range(passed)]
    scans = [*parked, *[np.full((5, 3), np.nan)] * (SCANS - passed)]
    assert reach_of_vehicle(scans) == NEAREST_M
    no_return = np.zeros((50, 3))
    assert reach_of_vehicle([np.concatenate([points, no_return]) for points in scans]) == NEAREST_M


def test_a_vehicle_that_stands_does_not_tell_itself_from_what_is_around() -> None:
    rng = np.random.default_rng(3)
    assert reach_of_vehicle([surface(2.3, (-0.5, 0.5), rng) for _ in range(SCANS)]) == FARTHEST_M


def test_no_scan_and_nothing_near_leave_the_least() -> None:
    assert reach_of_vehicle([]) == reach_of_vehicle([np.full((9, 3), 30.0)]) == NEAREST_M
