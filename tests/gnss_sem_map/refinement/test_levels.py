"""Levels of road and sidewalk: height puts right what images and neighbours get wrong alike, or is silent."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import norm
from sklearn.linear_model import LinearRegression
from surfaces import with_heights

from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.refinement import kerbs, levels
from gnss_sem_map.refinement.levels import LevelSettings, split_levels
from gnss_sem_map.refinement.state import Evidence, MapState, NotApplicable
from gnss_sem_map.voxels.semantic_map import SemanticMap, State
from gnss_sem_map.voxels.voxel_map import VoxelMap, keys_of

URBAN = open_label_set()
ROAD, SIDEWALK, BUILDING = (URBAN.index(name) for name in ("road", "sidewalk", "building"))
SIZE_M = 0.2
Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Labels = NDArray[np.int8]


def street(
    step_m: float = 0.12, roughness_m: float = 0.01, heading: float = 0.3, lift_m: float = 0.0
) -> tuple[Floats, Labels]:
    """Surface points (n, 3) m, one per voxel column, and their truth: a sloping street with sidewalks on both sides."""
    rng = np.random.default_rng(0)
    x, y = (one.ravel() for one in np.meshgrid(np.arange(150) * SIZE_M + 0.1, np.arange(90) * SIZE_M + 0.1))
    across = (y - 9) * np.cos(heading) - (x - 15) * np.sin(heading)
    truth = np.where(np.abs(across) > 3.5, SIDEWALK, ROAD).astype(np.int8)
    z = lift_m + 0.03 * x - 0.02 * y + step_m * (truth == SIDEWALK) + rng.normal(0, roughness_m, len(x))
    return np.column_stack([x, y, z]), truth


def mapped(
    p: Floats, called: Labels, confidence: float = 0.9
) -> tuple[SemanticMap, Floats, NDArray[np.int64]]:
    """The map of these points, the height of its surfaces, and the place of every point in it."""
    keys, first, place = np.unique(keys_of(p, SIZE_M), return_index=True, return_inverse=True)
    evidence = np.full((len(keys), len(URBAN.names)), -1000, np.int32)
    evidence[np.arange(len(keys)), called[first]] = -100
    voxels = VoxelMap(SIZE_M, URBAN, keys, evidence, np.ones(len(keys), np.uint32))
    states = np.full(len(keys), State.OBSERVED, np.uint8)
    sure = np.full(len(keys), confidence, np.float32)
    return SemanticMap(voxels, called[first], sure, states), p[first, 2], place


def with_mistakes(p: Floats, truth: Labels) -> Labels:
    """Two gaps between cars that stand on a sidewalk, called road, and a patch of road called sidewalk."""
    called = truth.copy()
    for x, y, other in ((8, 13, ROAD), (20, 6, ROAD), (15, 9, SIDEWALK)):
        called[(np.abs(p[:, 0] - x) < 1.2) & (np.abs(p[:, 1] - y) < 1.2)] = other
    return called


def mistakes(p: Floats, truth: Labels, called: Labels) -> tuple[int, int]:
    """Of the voxels before and after."""
    before, heights, place = mapped(p, called)
    after = split_levels(before, heights, LevelSettings())
    return int((before.labels[place] != truth).sum()), int((after.labels[place] != truth).sum())


@pytest.mark.parametrize("heading", [0.0, 0.3, 2.0])
@pytest.mark.parametrize("step_m", [0.12, 0.2])
def test_patches_on_the_wrong_level_come_right(heading: float, step_m: float) -> None:
    p, truth = street(step_m=step_m, heading=heading)
    before, after = mistakes(p, truth, with_mistakes(p, truth))
    assert before > 250
    assert after < before / 10


@pytest.mark.parametrize("offset_m", [(0, 0, 0), (20_000, -9_000, 150)])
def test_where_the_map_s_origin_lies_changes_nothing(offset_m: tuple[float, float, float]) -> None:
    p, truth = street()
    called = with_mistakes(p, truth)
    semantic_map, heights, _ = mapped(p + offset_m, called)
    told = split_levels(semantic_map, heights, LevelSettings())
    known, known_heights, _ = mapped(p, called)
    expected = split_levels(known, known_heights, LevelSettings())
    np.testing.assert_array_equal(told.labels, expected.labels)
    np.testing.assert_allclose(told.confidence, expected.confidence, atol=1e-3)


@pytest.mark.parametrize(
    ("step_m", "roughness_m"),
    [(0.0, 0.01), (0.03, 0.01), (-0.12, 0.01), (0.12, 0.08)],
    ids=["level ground", "too low a step", "a sidewalk below the road", "ground too rough to tell"],
)
def test_where_there_are_not_clearly_two_levels_the_map_stands(step_m: float, roughness_m: float) -> None:
    p, truth = street(step_m, roughness_m)
    before, heights, _ = mapped(p, with_mistakes(p, truth))
    after = split_levels(before, heights, LevelSettings())
    np.testing.assert_array_equal(after.labels, before.labels)
    np.testing.assert_array_equal(after.confidence, before.confidence)


def test_a_street_on_a_bridge_above_another_is_told_for_itself() -> None:
    (p, truth), (above, _) = street(heading=0.3), street(heading=0.3, lift_m=6.0)
    both = np.concatenate([p, above])
    called = with_mistakes(p, truth)
    before, after = mistakes(both, np.tile(truth, 2), np.tile(called, 2))
    alone = mistakes(p, truth, called)
    assert (before, after) == (2 * alone[0], 2 * alone[1])


def test_only_shown_road_and_sidewalk_of_known_height_are_told() -> None:
    p, truth = street()
    before, heights, _ = mapped(p, with_mistakes(p, truth))
    kind = np.arange(len(before)) % 7
    called = np.where(kind == 0, BUILDING, before.labels).astype(np.int8)
    states = np.where(kind == 1, State.REMOVED, before.states).astype(np.uint8)
    heights = np.where(kind == 2, np.nan, heights)
    before = replace(before, labels=called, states=states, entropy=np.full(len(before), 0.5, np.float32))
    after = split_levels(before, heights, LevelSettings())
    assert before.entropy is not None
    assert after.entropy is not None
    for name in ("labels", "states", "confidence", "entropy"):
        np.testing.assert_array_equal(getattr(after, name)[kind < 3], getattr(before, name)[kind < 3])
    differ = after.labels != before.labels
    assert differ.sum() > 100
    assert (after.states[differ] == State.REFINED).all()
    assert (after.states[~differ] == before.states[~differ]).all()
    assert (after.confidence[after.confidence != before.confidence] >= 0.5).all()


def test_the_planes_are_those_of_scikit_learn_and_the_odds_those_of_scipy(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """On a place small enough that every cell sees all of it, and classes that are certain."""
    rng = np.random.default_rng(1)
    p = np.column_stack([rng.uniform(100, 104, (900, 2)), np.zeros(900)])
    on_sidewalk = (p[:, 0] > 102.3).astype(float)
    p[:, 2] = 5 + 0.01 * p[:, 0] + 0.1 * on_sidewalk + rng.normal(0, 0.02, 900)
    ground = levels._Ground.of(p, p[:, 2])
    planes = levels._fit(ground, on_sidewalk)
    terms = np.column_stack([p[:, :2], on_sidewalk])
    oracle = LinearRegression().fit(terms, p[:, 2])
    np.testing.assert_allclose(planes.slopes, np.tile(oracle.coef_, (len(planes.z0), 1)), atol=1e-6)
    left_over = p[:, 2] - oracle.predict(terms)
    np.testing.assert_allclose(planes.variance, (left_over**2).sum() / (900 - 4), rtol=1e-5)

    settings = LevelSettings()
    monkeypatch.setattr(levels, "VOXEL_STDDEV_M", 0.04)
    monkeypatch.setattr(levels, "FACE_BEGINS", 0.5)
    log_odds = levels._log_odds(planes, ground, settings)
    road = oracle.predict(np.column_stack([p[:, :2], np.zeros(900)]))
    expected = norm.logpdf(p[:, 2], road + oracle.coef_[2], 0.04) - norm.logpdf(p[:, 2], road, 0.04)
    assert levels._are_two(planes, settings).all()
    np.testing.assert_allclose(log_odds, expected, atol=1e-3)


@pytest.mark.parametrize("step_m", [0.12, 0.15])
def test_confidence_keeps_its_word(step_m: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Images that are wrong as often as they admit, surfaces that stray as far as is set: the odds are Bayes' own."""
    p, truth = street(step_m, roughness_m=0.03)
    column, row = (p[:, :2] // 1.0).astype(int).T  # images err in patches
    wrong = np.random.default_rng(2).random((30, 18))[column, row] < 0.1
    called = np.where(wrong, ROAD + SIDEWALK - truth, truth).astype(np.int8)
    before, heights, place = mapped(p, called, confidence=0.9)
    monkeypatch.setattr(levels, "FACE_BEGINS", 0.5)
    after = split_levels(before, heights, LevelSettings())
    is_right = np.empty(len(after), np.bool_)
    is_right[place] = after.labels[place] == truth
    told = after.confidence != before.confidence
    assert told.mean() > 0.8
    assert is_right[told].mean() > 0.95
    assert after.confidence[told].mean() == pytest.approx(is_right[told].mean(), abs=0.02)


def test_what_lies_a_whole_step_off_both_levels_stays_what_it_was() -> None:
    p, truth = street()
    ramp = np.abs(p[:, 0] - 15) < 1
    p[ramp, 2] += 0.5
    before, heights, place = mapped(p, truth, confidence=0.4)
    after = split_levels(before, heights, LevelSettings())
    np.testing.assert_array_equal(after.labels[place[ramp]], before.labels[place[ramp]])
    np.testing.assert_array_equal(after.confidence[place[ramp]], before.confidence[place[ramp]])


def test_states_say_where_a_label_comes_from() -> None:
    p, truth = street()
    of_images, heights, place = mapped(p, truth)
    wrong = with_mistakes(p, truth)
    called = of_images.labels.copy()
    called[place] = wrong
    states = np.where(called == of_images.labels, State.OBSERVED, State.REFINED).astype(np.uint8)
    after = split_levels(replace(of_images, labels=called, states=states), heights, LevelSettings())
    differ = after.labels != called
    assert differ.sum() > 250
    expected = np.where(after.labels == of_images.labels, State.OBSERVED, State.REFINED)
    np.testing.assert_array_equal(after.states, expected)
    inferred = replace(of_images, labels=called, states=np.full_like(states, State.INFERRED))
    assert (split_levels(inferred, heights, LevelSettings()).states == State.INFERRED).all()


def state_of(semantic_map: SemanticMap, heights: Floats) -> MapState:
    """The map as the steps before left it."""
    voxels = with_heights(semantic_map.voxels, heights)
    return replace(MapState.of(voxels, Evidence()), decided=replace(semantic_map, voxels=voxels))


def test_steps_change_the_decision_and_mark_where_points_are_told_apart() -> None:
    p, truth = street()
    before, heights, _ = mapped(p, with_mistakes(p, truth))
    state = state_of(before, heights)
    after = levels.apply(state, LevelSettings())
    assert after.decided is not None
    assert (after.decided.labels != before.labels).sum() > 100
    found = kerbs.apply(after, kerbs.KerbSettings())
    assert found.kerbs is not None
    assert found.decided is not None
    split = found.decided.states == State.SPLIT
    np.testing.assert_array_equal(found.decided.voxels.keys[split], found.kerbs.keys)
    for name in ("labels", "confidence"):
        np.testing.assert_array_equal(getattr(found.decided, name), getattr(after.decided, name))


def test_maps_without_road_sidewalk_or_heights_are_left_as_they_are() -> None:
    p, truth = street()
    whole, heights, _ = mapped(p, truth)
    only_road = replace(whole, labels=np.full_like(whole.labels, ROAD))
    removed = replace(whole, states=np.full_like(whole.states, State.REMOVED))
    for one in (only_road, removed):
        for step, settings in ((levels, LevelSettings()), (kerbs, kerbs.KerbSettings())):
            with pytest.raises(NotApplicable, match="no road, or no sidewalk"):
                step.apply(state_of(one, heights), settings)
    unmeasured = replace(MapState.of(whole.voxels, Evidence()), decided=whole)
    with pytest.raises(NotApplicable, match="not measured"):
        levels.apply(unmeasured, LevelSettings())
