"""The refined map: what changes, what must not, and that the report says so."""

import numpy as np
import pytest
from pydantic import ValidationError

from gnss_sem_map.errors import DataError
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.refinement.by_block import refine
from gnss_sem_map.refinement.removed_layer import with_removed
from gnss_sem_map.refinement.state import Evidence
from gnss_sem_map.refinement.steps import RefinementSettings
from gnss_sem_map.voxels.semantic_map import Reason, SemanticMap, State
from gnss_sem_map.voxels.voxel_map import VoxelMap, VoxelTable, pack

OFF = {"enabled": False}
URBAN = open_label_set("urban")
ROAD, SIDEWALK, VEHICLE, BUILDING, VEGETATION = range(5)


def voxel_map(indices, labels, nat=2.0, hits=4, names=URBAN):
    """A map whose voxels favour the given classes; -1: no camera saw them."""
    indices, labels = np.asarray(indices), np.asarray(labels)
    keys = pack(indices)
    order = np.argsort(keys)
    evidence = np.full((len(keys), len(names.names)), -round(nat * 1024), np.int32)
    evidence[np.arange(len(keys)), labels] = -1
    evidence[labels < 0] = 0
    return VoxelMap(0.2, names, keys[order], evidence[order], np.full(len(keys), hits, np.uint32))


def street(rng):
    """Road, a facade with a few wrong voxels, trees, and a parked car beside the road."""

    def box(x, y, z):
        return np.stack(np.meshgrid(range(*x), range(*y), range(*z), indexing="ij"), -1).reshape(-1, 3)

    parts = [
        (ROAD, box((0, 120), (0, 30), (0, 1))),
        (SIDEWALK, box((0, 120), (38, 50), (0, 1))),
        (VEHICLE, box((20, 42), (30, 38), (1, 8))),
        (BUILDING, box((0, 120), (50, 51), (1, 30))),
        (VEGETATION, box((60, 80), (-20, -5), (10, 25))),
    ]
    indices = np.concatenate([v for _, v in parts])
    truth = np.concatenate([np.full(len(v), c) for c, v in parts])
    labels = truth.copy()
    wrong = (truth == BUILDING) & (rng.random(len(truth)) < 0.1)
    labels[wrong] = VEGETATION
    order = np.argsort(pack(indices))
    return voxel_map(indices, labels), truth[order]


def test_wrong_voxels_of_a_facade_become_building_and_the_report_counts_them():
    voxels, truth = street(np.random.default_rng(0))
    refined, report = refine(voxels)
    assert (refined.labels == truth).mean() > (voxels.labels == truth).mean()
    changed = refined.labels != voxels.labels
    assert (refined.states[changed] == State.REFINED).all()
    assert (refined.states[~changed] == State.OBSERVED).all()
    assert sum(step.changed for step in report.steps) >= changed.sum() > 0
    columns = {step.name: step for step in report.steps}["count_grid"]
    assert columns.changes[("vegetation", "building")] > 100


@pytest.mark.parametrize("mode", ["evidence", "paper"])
def test_nothing_is_deleted_and_what_no_camera_saw_stays_unlabelled(mode):
    rng = np.random.default_rng(1)
    indices = np.unique(rng.integers(-20, 20, (3000, 3)), axis=0)
    voxels = voxel_map(indices, rng.integers(-1, 5, len(indices)))
    refined, _ = refine(voxels, RefinementSettings(vehicles={"method": mode}, count_grid={"method": mode}))
    for name in ("keys", "evidence", "hits"):
        np.testing.assert_array_equal(getattr(refined.voxels, name), getattr(voxels, name))
    unseen = ~voxels.observed
    assert (refined.labels[unseen] == -1).all()
    assert (refined.states[unseen] == State.UNOBSERVED).all()
    assert (refined.confidence[unseen] == 0).all()
    assert (refined.labels[~unseen] >= 0).all()
    assert ((refined.confidence[~unseen] >= 0.2) & (refined.confidence[~unseen] <= 1)).all()


def test_refinement_with_everything_off_is_the_map_as_fusion_left_it():
    voxels, _ = street(np.random.default_rng(2))
    off = RefinementSettings(
        geometric_prior=OFF,
        count_grid=OFF,
        vehicles=OFF,
        potts_mrf=OFF,
        systematic_error=OFF,
        discount={"exponent": 1.0},
    )
    refined, report = refine(voxels, off)
    plain = SemanticMap.of(voxels)
    np.testing.assert_array_equal(refined.labels, plain.labels)
    np.testing.assert_array_equal(refined.states, plain.states)
    np.testing.assert_allclose(refined.confidence, plain.confidence, rtol=1e-5)
    np.testing.assert_allclose(refined.entropy, plain.entropy, rtol=1e-4, atol=1e-6)
    assert all(step.changed == 0 for step in report.steps)


def test_the_papers_rule_removes_a_parked_car_that_stands_beside_the_road_and_evidence_keeps_it():
    voxels, truth = street(np.random.default_rng(3))
    cars = truth == VEHICLE
    paper, report = refine(
        voxels, RefinementSettings(vehicles={"method": "paper"}, geometric_prior=OFF, potts_mrf=OFF)
    )
    assert (paper.states[cars] == State.REMOVED).all()
    assert (paper.told_reasons[cars] == Reason.RULE).all()
    assert (paper.labels[cars] == VEHICLE).all()
    assert not paper.shown[cars].any()
    assert {step.name: step.changes for step in report.steps}["vehicles"] == {
        ("vehicle", "removed"): int(cars.sum())
    }
    evidence, _ = refine(voxels)
    assert evidence.shown[cars].all()
    assert (evidence.labels[cars] == VEHICLE).mean() > 0.85


def test_without_any_road_evidence_keeps_the_cars_and_says_why():
    voxels, truth = street(np.random.default_rng(3))
    voxels, truth = voxels[truth != ROAD], truth[truth != ROAD]
    evidence, report = refine(voxels, RefinementSettings(geometric_prior=OFF))
    assert (evidence.labels[truth == VEHICLE] == VEHICLE).all()
    assert {step.name: step.skipped for step in report.steps}["vehicles"] == "the map has no road to stand on"
    paper, _ = refine(voxels, RefinementSettings(vehicles={"method": "paper"}))
    assert not paper.shown[truth == VEHICLE].any(), "eq. 12 asks for road in the column"
    assert evidence.shown.all()


def test_removed_voxels_come_back_as_a_layer_only_where_nothing_else_stands():
    static = voxel_map([(0, 0, 0), (1, 0, 0)], [ROAD, -1])
    moving = voxel_map([(1, 0, 0), (2, 0, 0), (3, 0, 0)], [VEHICLE, VEHICLE, -1])
    off = RefinementSettings(geometric_prior=OFF, potts_mrf=OFF)
    refined, report = refine(static, off, Evidence(moved=moving))
    assert {step.name: step.changes for step in report.steps}["removed_layer"] == {
        ("vehicle", "removed"): 1,
        ("unlabelled", "removed"): 1,
    }
    np.testing.assert_array_equal(refined.voxels.indices[:, 0], [0, 1, 2, 3])
    np.testing.assert_array_equal(refined.labels, [ROAD, -1, VEHICLE, VEHICLE])
    np.testing.assert_array_equal(
        refined.states, [State.OBSERVED, State.UNOBSERVED, State.REMOVED, State.REMOVED]
    )
    np.testing.assert_array_equal(refined.voxels.evidence[:2], static.evidence)
    np.testing.assert_array_equal(refined.shown, [True, False, False, False])
    with pytest.raises(DataError, match=r"0\.5 m"):
        with_removed(refined, VoxelTable(0.5, URBAN).to_map())


def test_what_moved_through_standing_voxels_is_counted_there_and_changes_nothing_else():
    static = voxel_map([(0, 0, 0), (1, 0, 0)], [ROAD, ROAD], hits=4)
    moving = voxel_map([(1, 0, 0), (2, 0, 0)], [VEHICLE, VEHICLE], hits=3)
    off = RefinementSettings(geometric_prior=OFF, potts_mrf=OFF)
    refined, alone = refine(static, off, Evidence(moved=moving))[0], refine(static, off)[0]
    np.testing.assert_array_equal(refined.voxels.hits, [4, 7, 3])
    np.testing.assert_array_equal(refined.removed_hits, [0, 3, 3])
    np.testing.assert_array_equal(refined.standing.hits, static.hits)
    np.testing.assert_array_equal(refined.standing.evidence, static.evidence)
    for name in ("labels", "confidence", "states", "entropy"):
        np.testing.assert_array_equal(getattr(refined, name)[:2], getattr(alone, name))
    np.testing.assert_array_equal((static + moving - refined.standing).evidence, moving.evidence)


@pytest.mark.parametrize("mode", [{"method": "evidence"}, {"method": "paper"}, OFF])
def test_empty_maps_and_maps_of_one_class_are_refined_without_error(mode):
    settings = RefinementSettings(vehicles=mode, count_grid=mode)
    empty, _ = refine(VoxelTable(0.2, URBAN).to_map(), settings)
    assert len(empty) == 0
    grid = np.stack(np.meshgrid(range(8), range(8), range(8)), -1).reshape(-1, 3)
    for label in (-1, *range(5)):
        refined, _ = refine(voxel_map(grid, np.full(len(grid), label)), settings)
        assert len(refined) == len(grid)


def test_a_class_set_without_buildings_skips_that_step_and_says_so(tmp_path):
    classes = "".join(
        f"  - {{name: {name}, colour: [{i}, 0, 0], semantic_kitti_id: {40 + i}, asprs_code: {64 + i}}}\n"
        for i, name in enumerate(("floor", "shelf"))
    )
    file = tmp_path / "warehouse.yaml"
    file.write_text(f"name: warehouse\nclasses:\n{classes}")
    grid = np.array([(0, 0, 0), (1, 0, 0)])
    refined, report = refine(voxel_map(grid, [0, 1], names=open_label_set(file)))
    assert refined.labels.tolist() == [0, 1]
    skipped = {step.name: step.skipped for step in report.steps}
    assert skipped["count_grid"] == "no class of the set has the role building"
    assert skipped["vehicles"] == "no class of the set has the role vehicle"


def test_an_unknown_setting_is_refused():
    with pytest.raises(ValidationError, match="vehicels"):
        RefinementSettings.model_validate({"vehicels": OFF})
    assert not RefinementSettings.model_validate({"vehicles": OFF}).vehicles.enabled
