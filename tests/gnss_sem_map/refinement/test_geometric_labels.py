"""The geometric labels of voxels that have no neighbours: what images and shape say of each, and nothing else."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.refinement import decision, geometric_labels
from gnss_sem_map.refinement.by_block import refine
from gnss_sem_map.refinement.decision import DecisionSettings
from gnss_sem_map.refinement.figures import Figures
from gnss_sem_map.refinement.geometric_labels import GeometricLabelSettings
from gnss_sem_map.refinement.road_sidewalk import with_odds
from gnss_sem_map.refinement.state import Evidence, GeometricEvidence, MapState, NotApplicable
from gnss_sem_map.refinement.steps import RefinementSettings
from gnss_sem_map.voxels.kernels import UNITS_PER_NAT
from gnss_sem_map.voxels.semantic_map import SemanticMap, State
from gnss_sem_map.voxels.voxel_map import VoxelMap, pack, softmax

URBAN = open_label_set()
ROAD, SIDEWALK, VEHICLE, BUILDING, VEGETATION, OTHER = range(6)
STRONG, WEAK = -8.0, -0.05
"""Of all other classes against one, nat."""
ALONE = GeometricLabelSettings(coupling_nat=0)


def row(best: int, others: float, answers: int) -> list[float]:
    return [0.0 if c == best else others for c in range(answers)]


def images(*said: tuple[int, float] | None, other_share: float = 0.0) -> VoxelMap:
    """Voxels far from each other; of each, what images say: a class, and how far all others are behind."""
    nat = [[0.0] * 5 if one is None else [v - 1 for v in row(*one, 5)] for one in said]
    evidence = np.rint(np.array(nat) * UNITS_PER_NAT).astype(np.int32)
    keys = pack(np.array([(9 * k, 0, 5) for k in range(len(said))]))
    of_images = np.tile(np.array([1, round(255 * other_share)], np.int32), (len(said), 1))
    return VoxelMap(0.2, URBAN, keys, evidence, np.ones(len(said), np.uint32), None, of_images)


def shape(voxels: VoxelMap, *said: tuple[int, float] | None, kerbs: float = 0.0) -> GeometricEvidence:
    """What a classifier says of each voxel, as log probabilities, and the log odds of sidewalk by kerbs."""
    known = [k for k, one in enumerate(said) if one is not None]
    scores = np.array([row(*one, 6) for one in said if one is not None], np.float32).reshape(-1, 6)
    nat = np.column_stack([np.log(softmax(scores)), np.full(len(scores), kerbs)])
    sums = np.rint(UNITS_PER_NAT * nat).astype(np.int32)
    return GeometricEvidence(voxels.keys[known], sums, np.ones(len(known), np.int32))


def labelled(
    voxels: VoxelMap,
    geometry: GeometricEvidence,
    settings: GeometricLabelSettings = ALONE,
    error: float = 0.0,
) -> SemanticMap:
    state = MapState.of(voxels, Evidence(geometry=geometry), Figures(systematic_error=error))
    decided = decision.apply(geometric_labels.apply(state, settings), DecisionSettings()).decided
    assert decided is not None
    return decided


def test_strong_images_keep_their_class_and_undecided_ones_get_that_of_the_shape() -> None:
    voxels = images((VEHICLE, STRONG), (VEHICLE, WEAK), (VEHICLE, WEAK))
    found = labelled(voxels, shape(voxels, (BUILDING, -5.0), (BUILDING, -5.0), None))
    assert found.labels.tolist() == [VEHICLE, BUILDING, VEHICLE]
    assert found.states.tolist() == [State.OBSERVED, State.REFINED, State.OBSERVED]


def test_what_no_image_shows_is_inferred_as_sure_as_the_classifier_is() -> None:
    voxels = images(None, None, None)
    found = labelled(voxels, shape(voxels, (VEGETATION, -3.0), (OTHER, -1.0), None))
    assert found.labels.tolist() == [VEGETATION, OTHER, -1]
    assert found.states.tolist() == [State.INFERRED, State.INFERRED, State.UNOBSERVED]
    expected = [1 / (1 + 5 * np.exp(-3)), 1 / (1 + 5 * np.exp(-1)), 0]
    np.testing.assert_allclose(found.confidence, expected, atol=2e-3)


def test_without_a_classifier_nothing_is_done() -> None:
    voxels = images((ROAD, WEAK), None)
    with pytest.raises(NotApplicable, match="there is no geometric classifier"):
        geometric_labels.apply(MapState.of(voxels, Evidence()), GeometricLabelSettings())


@pytest.mark.parametrize(
    "settings", [ALONE, GeometricLabelSettings(), GeometricLabelSettings(other_where_seen=True)]
)
def test_where_a_classifier_says_nothing_nothing_changes(settings: GeometricLabelSettings) -> None:
    voxels = images((ROAD, STRONG), (SIDEWALK, WEAK), None, (VEGETATION, -1.0), None)
    nothing = GeometricEvidence(np.empty(0, np.int64), np.empty((0, 7), np.int32), np.empty(0, np.int32))
    before = MapState.of(voxels, Evidence(geometry=nothing))
    after = geometric_labels.apply(before, settings)
    np.testing.assert_array_equal(after.labels, before.labels)
    assert not after.inferred.any()
    p_before, p_after = softmax(before.scores), softmax(after.scores)
    seen = voxels.observed
    # `other` takes the least there is of what images may say of it
    np.testing.assert_allclose(p_after[seen, :5], p_before[seen], atol=2e-3)


@given(st.integers(0, 2**32 - 1), st.floats(0, 0.4), st.booleans())
def test_without_weight_and_neighbours_seen_voxels_keep_their_labels(
    seed: int, error: float, unsure: bool
) -> None:
    rng = np.random.default_rng(seed)
    voxels = images(*((int(c), -float(x)) for c, x in zip(
        rng.integers(0, 5, 40), rng.uniform(0.01, 2 if unsure else 200, 40), strict=True)))  # fmt: skip
    geometry = shape(voxels, *((int(c), -9.0) for c in rng.integers(2, 6, 40)))
    weightless = GeometricLabelSettings(weight=0, coupling_nat=0)
    state = MapState.of(voxels, Evidence(geometry=geometry), Figures(systematic_error=error))
    after = geometric_labels.apply(state, weightless)
    assert np.isfinite(after.scores).all()
    np.testing.assert_array_equal(after.labels, state.labels)


def test_votes_that_are_hopelessly_behind_leave_no_score_that_is_no_number() -> None:
    voxels = images((BUILDING, -500.0))
    state = MapState.of(voxels, Evidence(geometry=shape(voxels, (SIDEWALK, -4.0))))
    after = geometric_labels.apply(state, GeometricLabelSettings())
    assert np.isfinite(after.scores).all()
    assert after.labels.tolist() == [BUILDING]


def test_shape_adds_its_weight_to_the_odds_of_images() -> None:
    voxels = images((ROAD, -2.0), (ROAD, -6.0))
    geometry = shape(voxels, (SIDEWALK, -4.0), (SIDEWALK, -4.0))
    state = MapState.of(voxels, Evidence(geometry=geometry))
    for weight in (0.0, 0.3, 1.0):
        scores = geometric_labels.apply(state, weighing(weight)).scores
        found = scores[:, SIDEWALK] - scores[:, ROAD]
        np.testing.assert_allclose(found, [4.0 * weight - 2.0, 4.0 * weight - 6.0], atol=0.01)


def weighing(weight: float) -> GeometricLabelSettings:
    return GeometricLabelSettings(weight=weight, coupling_nat=0)


@given(
    st.lists(st.lists(st.floats(-60, 60, width=32), min_size=4, max_size=4), min_size=1, max_size=5),
    st.floats(-60, 60, width=32), st.permutations(range(4)),
)  # fmt: skip
def test_other_odds_leave_the_sum_of_the_two_and_all_else(
    rows: list[list[float]], more: float, places: list[int]
) -> None:
    logs, (road, sidewalk) = np.array(rows, np.float32), places[:2]
    found = with_odds(logs, (road, sidewalk), np.full(len(logs), more, np.float32))
    np.testing.assert_array_equal(found[:, places[2:]], logs[:, places[2:]])
    before = logs[:, sidewalk] - logs[:, road]
    np.testing.assert_allclose(found[:, sidewalk] - found[:, road], before + np.float32(more), atol=1e-4)
    sums = [np.logaddexp(one[:, road], one[:, sidewalk]) for one in (found, logs)]
    np.testing.assert_allclose(sums[0], sums[1], atol=1e-4)


@pytest.mark.parametrize("weight", [0.0, 0.3])
def test_kerbs_count_in_full_but_take_no_sidewalk_from_images(weight: float) -> None:
    voxels = images((ROAD, -2.0), (SIDEWALK, -2.0), None, None)
    undecided = [(ROAD, 0.0)] * 4
    for kerbs, expected in ((1.5, [-0.5, 3.5, 1.5, 1.5]), (-1.5, [-2.0, 2.0, -1.5, -1.5])):
        state = MapState.of(voxels, Evidence(geometry=shape(voxels, *undecided, kerbs=kerbs)))
        scores = geometric_labels.apply(state, weighing(weight)).scores
        np.testing.assert_allclose(scores[:, SIDEWALK] - scores[:, ROAD], expected, atol=0.01)
        np.testing.assert_allclose(scores[:2, VEHICLE] - scores[:2, BUILDING], 0, atol=1e-5)


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_other_wins_where_images_show_a_class_only_if_it_may(share: float) -> None:
    voxels = images((ROAD, WEAK), (VEGETATION, STRONG), (VEGETATION, WEAK), other_share=share)
    geometry = shape(voxels, (OTHER, -5.0), (OTHER, -5.0), (VEGETATION, -5.0))
    sure = GeometricLabelSettings(weight=1, coupling_nat=0)
    assert (labelled(voxels, geometry, sure).labels != OTHER).all()
    may = sure.model_copy(update={"other_where_seen": True})
    expected = [OTHER, OTHER, VEGETATION] if share else [ROAD, VEGETATION, VEGETATION]
    assert labelled(voxels, geometry, may).labels.tolist() == expected


def test_what_images_show_as_other_alone_is_other_unless_shape_is_surer() -> None:
    voxels = images(None, None, None, other_share=1.0)
    found = labelled(voxels, shape(voxels, (ROAD, -1.0), (ROAD, -9.0), None))
    assert found.labels.tolist() == [OTHER, ROAD, -1]
    assert found.states.tolist() == [State.INFERRED, State.INFERRED, State.UNOBSERVED]
    nothing_shown = images(None, other_share=0.0)
    assert labelled(nothing_shown, shape(nothing_shown, (ROAD, -1.0))).labels.tolist() == [ROAD]


def test_neighbours_convince_a_voxel_that_is_not_sure_also_where_no_image_looked() -> None:
    keys = pack(np.array([(x, y, 0) for x in range(5) for y in range(5)]))
    zeros = np.zeros((25, 5), np.int32)
    voxels = VoxelMap(0.2, URBAN, keys, zeros, np.ones(25, np.uint32))
    of_shape = [(SIDEWALK, -0.3) if k == 12 else (VEGETATION, -2.0) for k in range(25)]
    geometry = shape(voxels, *of_shape)
    assert labelled(voxels, geometry, ALONE).labels[12] == SIDEWALK
    assert (labelled(voxels, geometry, GeometricLabelSettings()).labels == VEGETATION).all()


def test_classifiers_of_several_drives_count_alike_in_any_order() -> None:
    rng = np.random.default_rng(0)
    parts = []
    for _ in range(3):
        keys = np.unique(rng.integers(0, 60, 40))
        sums = rng.integers(-9000, 0, (len(keys), 7)).astype(np.int32)
        parts.append(GeometricEvidence(keys, sums, np.ones(len(keys), np.int32)))
    one, other = parts[0] + parts[1] + parts[2], parts[2] + (parts[1] + parts[0])
    asked = np.arange(0, 70)
    for of_one, of_other in zip(one.of(asked), other.of(asked), strict=True):
        np.testing.assert_array_equal(of_one, of_other)
    for key in asked:
        said = [p.sums[p.keys == key][0] for p in parts if key in p.keys]
        expected = np.mean(said, axis=0) / UNITS_PER_NAT if said else np.full(7, np.nan)
        logs, kerbs = one.of(np.array([key]))
        np.testing.assert_allclose([*logs[0], *kerbs], expected, rtol=1e-5)


def test_a_map_in_memory_gets_geometric_labels_through_all_steps() -> None:
    voxels = images((VEHICLE, STRONG), None, None)
    geometry = shape(voxels, (VEHICLE, -3.0), (VEGETATION, -3.0), None)
    beside = Evidence(geometry=geometry)
    found, report = refine(voxels, beside=beside)
    assert found.states.tolist() == [State.OBSERVED, State.INFERRED, State.UNOBSERVED]
    changes = next(step.changes for step in report.steps if step.name == "geometric_labels")
    assert changes == {("unlabelled", "vegetation"): 1}
    off = RefinementSettings.model_validate({"geometric_labels": {"enabled": False}})
    assert refine(voxels, off, beside)[0].states.tolist() == [
        State.OBSERVED,
        State.UNOBSERVED,
        State.UNOBSERVED,
    ]
