"""How sure a map is that what moved is a vehicle: by the movers that images show, for those that none shows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.refinement.by_block import refine
from gnss_sem_map.refinement.figures import LEAST_ERROR_RATE, STEP
from gnss_sem_map.refinement.removed_layer import probabilities_of
from gnss_sem_map.refinement.state import Evidence
from gnss_sem_map.voxels.kernels import UNITS_PER_NAT
from gnss_sem_map.voxels.semantic_map import SemanticMap, State
from gnss_sem_map.voxels.voxel_map import VoxelMap, VoxelTable, pack

URBAN = open_label_set("urban")
COUNT, VEHICLE, BUILDING = len(URBAN.names), URBAN.index("vehicle"), URBAN.index("building")
UNSEEN = -1


def movers(labels: list[int], nat: float = 3.0, hits: int = 10) -> VoxelMap:
    """Voxels in a row that images call these classes, each surer of it than of another by `nat`."""
    called = np.array(labels)
    evidence = np.full((len(called), COUNT), -round(nat * UNITS_PER_NAT), np.int32)
    evidence[np.arange(len(called)), called] = -1
    evidence[called == UNSEEN] = 0
    keys = pack(np.column_stack([np.arange(len(called)), np.zeros((len(called), 2), int)]))
    return VoxelMap(0.2, URBAN, keys, evidence, np.full(len(called), hits, np.uint32))


def layer(moved: VoxelMap) -> SemanticMap:
    """The removed layer over a map in which nothing stands."""
    refined, _ = refine(VoxelTable(0.2, URBAN).to_map(), beside=Evidence(moved=moved))
    return refined


@pytest.mark.parametrize("others", [0, 1, 3, 10])
def test_what_no_image_shows_is_as_surely_a_vehicle_as_the_movers_that_images_show(others: int) -> None:
    called = [VEHICLE] * (20 - others) + [BUILDING] * others
    found = layer(movers([*called, UNSEEN, UNSEEN]))
    expected = 1 - max(others / 20, LEAST_ERROR_RATE)
    np.testing.assert_allclose(found.confidence[-2:], expected, atol=STEP / 2 + 1e-6)
    assert (found.labels == VEHICLE).all()
    assert (found.states == State.REMOVED).all()


def test_without_a_mover_in_an_image_nothing_is_known() -> None:
    found = layer(movers([UNSEEN] * 5))
    np.testing.assert_allclose(found.confidence, 1 / COUNT)
    assert found.entropy is not None
    np.testing.assert_allclose(found.entropy, np.log(COUNT), rtol=1e-6)


def test_movers_count_with_their_points() -> None:
    seen = [VEHICLE, BUILDING, UNSEEN]
    moved = movers(seen)
    moved = VoxelMap(0.2, URBAN, moved.keys, moved.evidence, np.array([30, 10, 99], np.uint32))
    assert layer(moved).confidence[-1] == pytest.approx(0.75)


@given(
    otherwise=st.floats(0.01, 1),
    scores=st.lists(st.floats(-6, 0), min_size=COUNT, max_size=COUNT),
)
def test_the_posterior_is_bayes_rule(otherwise: float, scores: list[float]) -> None:
    units = np.rint(np.array(scores) * UNITS_PER_NAT).astype(np.int32)
    moved = VoxelMap(0.2, URBAN, np.zeros(1, np.int64), units[None], np.ones(1, np.uint32))
    prior = np.full(COUNT, min(otherwise, 1 - 1 / COUNT) / (COUNT - 1))
    prior[VEHICLE] = 1 - (COUNT - 1) * prior[VEHICLE]
    posterior = prior * np.exp(units / UNITS_PER_NAT)
    np.testing.assert_allclose(
        probabilities_of(moved, otherwise)[0], posterior / posterior.sum(), rtol=1e-4, atol=1e-6
    )


def test_the_stated_confidence_is_the_share_that_is_right() -> None:
    """Movers of which a tenth are no vehicles; images show half, and err as seldom as they say."""
    rng, nat, size = np.random.default_rng(0), 7.0, 40_000
    true = (VEHICLE + (rng.random(size) < 0.1) * rng.integers(1, COUNT, size)) % COUNT
    is_right = rng.random(size) < 1 / (1 + (COUNT - 1) * np.exp(-nat))
    called = np.where(is_right, true, (true + rng.integers(1, COUNT, size)) % COUNT)
    seen = rng.random(size) < 0.5
    moved = movers(np.where(seen, called, UNSEEN).tolist(), nat)
    found = layer(moved)
    for group in (seen & (called == VEHICLE), seen & (called != VEHICLE), ~seen):
        share = (true == VEHICLE)[group].mean()
        assert found.confidence[group].mean() == pytest.approx(share, abs=0.01)
        assert group.sum() > 1000


def test_what_moved_has_the_class_that_images_say_if_that_may_move_and_else_the_first_that_may() -> None:
    roles = {"car": "vehicle", "house": "building", "walker": "person", "road": "road", "tree": "vegetation"}
    rows = [
        {"name": name, "role": role, "colour": [0, 0, 0], "semantic_kitti_id": 40 + i, "asprs_code": 1}
        for i, (name, role) in enumerate(roles.items())
    ]
    several = open_label_set({"name": "several", "classes": rows})
    moved = replace(movers([0, 2, 2, 1, UNSEEN]), label_set=several)
    refined, _ = refine(VoxelTable(0.2, several).to_map(), beside=Evidence(moved=moved))
    assert refined.labels.tolist() == [0, 2, 2, 0, 0]
    expected = probabilities_of(moved, 0.25)  # one of the four that images show
    np.testing.assert_allclose(refined.confidence, expected[range(5), refined.labels], atol=STEP)
    np.testing.assert_allclose(expected[-1], [0.375, 0.25 / 3, 0.375, 0.25 / 3, 0.25 / 3], atol=1e-5)
