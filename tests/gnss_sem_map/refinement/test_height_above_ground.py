"""The ground under a map, and what heights say against classes."""

import numpy as np
import pytest

from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.refinement.geometric_prior import GeometricPriorSettings, against
from gnss_sem_map.refinement.height_above_ground import height_over_ground

URBAN = open_label_set("urban")


def plane(slope=0.0, side=40.0, step=0.2):
    x, y = (a.ravel() for a in np.meshgrid(np.arange(0, side, step), np.arange(0, side, step)))
    return np.stack([x, y, slope * x - 3.0], axis=1)


@pytest.mark.parametrize("slope", [0.0, 0.05, 0.1])
def test_ground_has_no_height_and_what_stands_on_it_has_its_own(slope):
    ground = plane(slope)
    pole = np.array([[20.0, 20.0, slope * 20.0 - 3.0 + h] for h in (1.0, 2.0, 5.0)])
    heights = height_over_ground(np.concatenate([ground, pole]))
    inner = ((ground[:, :2] > 3) & (ground[:, :2] < 37)).all(axis=1)
    assert abs(heights[: len(ground)][inner]).max() < 0.1
    np.testing.assert_allclose(heights[len(ground) :], [1.0, 2.0, 5.0], atol=0.1)


def test_a_car_that_hides_the_ground_is_not_the_ground():
    ground = plane()
    under = ((ground[:, :2] > (15, 15)) & (ground[:, :2] < (19.5, 17))).all(axis=1)
    roof = ground[under] + (0, 0, 1.5)
    heights = height_over_ground(np.concatenate([ground[~under], roof]))
    assert heights[(~under).sum() :].min() > 1.0


def test_returns_from_below_the_road_do_not_lower_the_ground():
    ground = plane()
    ghosts = ground[::97] - (0, 0, 1.5)
    heights = height_over_ground(np.concatenate([ground, ghosts]))
    assert abs(np.median(heights[: len(ground)])) < 0.1


def test_the_ground_does_not_notice_where_its_blocks_meet():
    ground = plane(slope=0.02, side=30.0)
    within = height_over_ground(ground + np.array([100.0, 100.0, 0.0]))
    across = height_over_ground(ground + np.array([256.0 - 15.0, 512.0 - 15.0, 0.0]))
    np.testing.assert_allclose(within, across, atol=0.02)


def test_no_voxels_have_no_heights():
    assert height_over_ground(np.empty((0, 3))).shape == (0,)


def test_each_rule_counts_against_its_class_alone():
    settings = GeometricPriorSettings(against_nat=2.0)
    road, sidewalk, vehicle, building, vegetation = range(5)
    unknown, level, steep = np.nan, 1.0, 0.5
    for height, lie, expected in (
        (0.0, unknown, {building: -2, vegetation: -1}),
        (0.0, level, {building: -4, vegetation: -1}),
        (0.2, level, {building: -2}),
        (0.2, 0.9, {}),
        (0.2, steep, {road: -2, sidewalk: -2}),
        (0.4, level, {road: -2}),
        (1.0, unknown, {road: -2, sidewalk: -2}),
        (1.0, steep, {road: -2, sidewalk: -2}),
        (4.0, level, {road: -2, sidewalk: -2, vehicle: -4}),
    ):
        row = [expected.get(c, 0) for c in range(5)]
        found = against(np.array([height], np.float32), np.array([lie], np.float32), URBAN, settings)
        np.testing.assert_array_equal(found, [row])
