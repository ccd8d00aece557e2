"""The compiled table equals a readable numpy map bit for bit, and forgets the order of what it was given."""

from __future__ import annotations

from dataclasses import replace
from functools import reduce
from operator import add
from pathlib import Path

import numpy as np
import numpy_chain
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from surfaces import heights_in_voxels

from gnss_sem_map.errors import ConfigError, DataError
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.voxels import voxel_map
from gnss_sem_map.voxels.kernels import SUM_LIMIT
from gnss_sem_map.voxels.semantic_map import SemanticMap, State
from gnss_sem_map.voxels.voxel_map import (
    VoxelMap,
    VoxelTable,
    keys_of,
    limits_of,
    log_table,
    pack,
    unpack,
)

URBAN = open_label_set()
Batch = tuple[NDArray[np.float64], NDArray[np.int32], NDArray[np.uint8]]


def batches(seed: int, count: int = 6, points: int = 4000, spread: float = 4.0) -> list[Batch]:
    rng = np.random.default_rng(seed)
    return [
        (
            rng.normal(0, spread, (points, 3)),
            rng.integers(-1, 300, points).astype(np.int32),
            rng.integers(0, 256, (300, 6)).astype(np.uint8) * (rng.random((300, 6)) < 0.6).astype(np.uint8),
        )
        for _ in range(count)
    ]


def by_table(parts: list[Batch], floor: float = 0.05) -> VoxelMap:
    table = VoxelTable(0.2, URBAN, floor)
    for p_map, pixels, classes in parts:
        table.add(keys_of(p_map, 0.2), pixels, classes, heights_in_voxels(p_map[:, 2], 0.2))
    return table.to_map()


def by_numpy(parts: list[Batch], floor_percent: int = 5) -> VoxelMap:
    """The oracle: group by voxel, sum the logarithms of floored, renormalised probabilities."""
    logs = log_table(5, floor_percent).astype(np.int64)
    p_map = np.concatenate([p for p, _, _ in parts])
    evidence, of_images = [], []
    for _, pixels, classes in parts:
        seen = np.where(pixels[:, None] >= 0, classes[pixels], 0).astype(np.int64)
        of_images.append(np.column_stack([seen.any(axis=1), seen[:, 5]]))
        seen = seen[:, :5]
        total = seen.sum(axis=1, keepdims=True)
        q = np.maximum(100 * seen, floor_percent * total)
        evidence.append(np.where(total > 0, logs[q] - logs[q.sum(axis=1, keepdims=True)], 0))
    indices, where = np.unique(np.floor(p_map / 0.2).astype(np.int64), axis=0, return_inverse=True)
    sums, others = np.zeros((len(indices), 5), np.int64), np.zeros((len(indices), 2), np.int32)
    np.add.at(sums, where.ravel(), np.concatenate(evidence))
    np.add.at(others, where.ravel(), np.concatenate(of_images))
    hits = np.bincount(where.ravel(), minlength=len(indices))
    units = np.floor(256 * np.mod(p_map[:, 2] / 0.2, 1)).astype(np.int64)
    heights = np.zeros(len(indices), np.int64)
    np.add.at(heights, where.ravel(), units)
    return VoxelMap(0.2, URBAN, pack(indices), sums.astype(np.int32), hits.astype(np.uint32), heights, others)


def assert_same(a: VoxelMap, b: VoxelMap) -> None:
    for name in ("keys", "evidence", "hits", "heights", "of_images"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)


@pytest.mark.parametrize("floor", [0.01, 0.05, 0.2])
def test_the_table_equals_the_numpy_map_bit_for_bit(floor: float) -> None:
    parts = batches(1)
    assert_same(by_table(parts, floor), by_numpy(parts, round(100 * floor)))


def learnt(seed: int) -> NDArray[np.float64]:
    """What six answers say of five classes, nat."""
    return np.log(np.random.default_rng(seed).dirichlet(np.full(5, 0.4), 6) + 1e-4)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.booleans(), st.booleans(), st.permutations(range(4)))
def test_calibrated_and_abstaining_looks_equal_plain_numpy_in_any_order(
    seed: int, calibrated: bool, abstain: bool, order: list[int]
) -> None:
    answers = learnt(seed) if calibrated else None
    parts = batches(seed, count=4, points=300, spread=1.0)
    table = VoxelTable(0.2, URBAN, 0.05, answers, abstain)
    plain = numpy_chain.NumpyMap(0.2, URBAN, answers=answers, abstain=abstain)
    for i, (p_map, pixels, classes) in enumerate(parts):
        plain.add(keys_of(p_map, 0.2), pixels, classes, heights_in_voxels(p_map[:, 2], 0.2))
        p_map, pixels, classes = parts[order[i]]
        table.add(keys_of(p_map, 0.2), pixels, classes, heights_in_voxels(p_map[:, 2], 0.2))
    assert_same(table.to_map(), plain.to_map())


def test_other_says_something_once_it_was_calibrated_and_a_void_pixel_never_does() -> None:
    """Where `other` is seen on vegetation only, it is evidence for vegetation."""
    answers = np.full((6, 5), np.log(0.2))
    answers[5] = np.log([0.02, 0.02, 0.02, 0.02, 0.92])
    classes = np.array([[0, 0, 0, 0, 0, 255], [0] * 6], np.uint8)
    keys, pixels = keys_of(np.array([[0.1, 0.1, 0.1], [1.1, 0.1, 0.1]]), 0.2), np.array([0, 1], np.int32)
    for calibrated, labels in ((None, [-1, -1]), (answers, [4, -1])):
        table = VoxelTable(0.2, URBAN, answers=calibrated)
        table.add(keys, pixels, classes)
        assert table.to_map().labels.tolist() == labels


def test_the_fixed_point_sums_are_the_logarithms_of_eq_6() -> None:
    """In floating point, with the probabilities themselves: within half a unit for each of the two table look-ups."""
    parts = batches(2, count=3)
    fused, looks = by_table(parts), np.zeros(0)
    keys = np.concatenate([keys_of(p, 0.2) for p, _, _ in parts])
    p = np.concatenate([np.where(x[:, None] >= 0, c[x], 0)[:, :5] for _, x, c in parts]).astype(float)
    p = p[p.any(axis=1)], keys[p.any(axis=1)]
    probability = np.maximum(p[0] / p[0].sum(axis=1, keepdims=True), 0.05)
    probability /= probability.sum(axis=1, keepdims=True)
    places = fused.indices_of(p[1])
    exact = np.zeros(fused.evidence.shape)
    np.add.at(exact, places, np.log(probability))
    looks = np.bincount(places, minlength=len(fused))
    assert (np.abs(fused.evidence / 1024 - exact) <= (looks[:, None] + 1e-9) / 1024).all()


@settings(max_examples=25, deadline=None)
@given(st.permutations(range(6)), st.integers(1, 5))
def test_any_order_and_any_merge_give_the_same_bits(order: list[int], split: int) -> None:
    parts = batches(3, points=500)
    whole = by_table(parts)
    assert_same(by_table([parts[i] for i in order]), whole)
    halves = by_table([parts[i] for i in order[:split]]), by_table([parts[i] for i in order[split:]])
    assert_same(halves[0] + halves[1], whole)


def test_what_was_added_can_be_taken_out_again() -> None:
    whole, part = by_table(batches(1)), by_table(batches(2))
    assert_same(whole + part - part, whole)
    assert len(whole - whole) == 0
    for other in (part, replace(whole, hits=whole.hits + np.uint32(1)), replace(whole, voxel_size_m=0.4)):
        with pytest.raises(DataError, match="not part of the other"):
            whole - other
    with pytest.raises(DataError, match="other evidence"):
        whole - replace(whole, evidence=whole.evidence - np.int32(1))


def test_the_table_grows_without_losing_anything(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(voxel_map, "SMALLEST_TABLE", 1 << 10)
    parts = batches(4, count=4, points=12_000, spread=60.0)
    fused = by_table(parts)
    assert len(fused) > 30 << 10
    assert fused.hits.sum() == 48_000
    assert_same(fused, by_numpy(parts))


@given(st.lists(st.tuples(*[st.integers(-(1 << 20) + 1, (1 << 20) - 1)] * 3), min_size=1, max_size=50))
def test_packing_is_reversible_and_sorts_like_the_indices(rows: list[tuple[int, int, int]]) -> None:
    indices = np.array(sorted(rows))
    keys = pack(indices)
    np.testing.assert_array_equal(unpack(keys), indices)
    assert (np.diff(keys) >= 0).all()
    assert (keys > 0).all()


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 2.2e5, -2.2e5])
def test_a_point_that_no_key_can_hold_is_an_error_and_never_wraps(bad: float) -> None:
    for axis in range(3):
        p_map = np.zeros((5, 3))
        p_map[3, axis] = bad
        with pytest.raises(DataError, match="point 3 of 5"):
            keys_of(p_map, 0.2)


@pytest.mark.parametrize("order", [(0, 1, 2, 3), (3, 0, 2, 1)])
def test_sums_stay_at_their_limit_in_any_order_of_scans_and_maps(order: tuple[int, ...]) -> None:
    """So a vehicle may stand before a wall for hours; compared with sums of 64 bits that are cut at the end."""
    keys, classes = (
        keys_of(np.zeros((90_000, 3)), 0.2),
        np.array([[255, 9, 0, 0, 0, 0], [0] * 5 + [255]], np.uint8),
    )
    tables = [VoxelTable(0.2, URBAN, 0.01) for _ in range(5)]
    for number in order:
        for table in (tables[4], tables[number]):
            table.add(keys, np.full(90_000, number == 3, np.int32), classes)
    whole, *parts = (tables[number].to_map() for number in (4, *order))
    exact = sum(part.evidence.astype(np.int64) for part in parts)
    assert exact.min() < -SUM_LIMIT < exact.max()
    np.testing.assert_array_equal(whole.evidence, np.maximum(exact, -SUM_LIMIT))
    assert_same(reduce(add, parts), whole)
    assert_same((parts[0] + parts[1]) + (parts[2] + parts[3]), whole)
    assert whole.labels.tolist() == [0]
    for _ in range(7):  # 255 of `other` for each of the 360,000 points, eight times and more
        whole = whole + replace(whole, hits=parts[0].hits)
    assert whole.of_images is not None
    assert whole.of_images[0, 1] == SUM_LIMIT


def test_a_voxel_without_a_look_has_no_label() -> None:
    table = VoxelTable(0.2, URBAN)
    p_map = np.array([[0.1, 0.1, 0.1], [1.1, 0.1, 0.1], [2.1, 0.1, 0.1]])
    classes = np.array([[0, 0, 200, 0, 0, 55], [0, 0, 0, 0, 0, 255]], np.uint8)
    table.add(keys_of(p_map, 0.2), np.array([0, -1, 1], np.int32), classes)
    semantic = SemanticMap.of(table.to_map())
    assert semantic.labels.tolist() == [URBAN.index("vehicle"), -1, -1]
    assert semantic.states.tolist() == [State.OBSERVED, State.UNOBSERVED, State.UNOBSERVED]
    assert semantic.confidence[0] == pytest.approx(0.8 / (0.8 + 4 * 0.05) * 1.0, abs=0.05)
    assert semantic.confidence[1:].tolist() == [0, 0]


def test_maps_of_different_kinds_do_not_add() -> None:
    a, b = VoxelTable(0.2, URBAN).to_map(), VoxelTable(0.1, URBAN).to_map()
    with pytest.raises(DataError, match=r"0\.1 m voxels"):
        a + b
    with pytest.raises(ConfigError, match="more than 0"):
        VoxelTable(-1.0, URBAN)


def test_a_selection_keeps_what_the_mask_says() -> None:
    fused = by_table(batches(5, count=1))
    part = fused[fused.observed]
    assert len(part) == int(fused.observed.sum()) > 0
    assert part.observed.all()
    np.testing.assert_array_equal(fused.indices_of(part.keys), np.flatnonzero(fused.observed))
    assert (fused.indices_of(np.array([1, part.keys[0] + 1], np.int64))[:1] == -1).all()


def test_a_large_table_takes_at_most_72_bytes_per_voxel_and_keeps_all() -> None:
    table, keys = VoxelTable(0.2, URBAN), np.arange(1 << 40, (1 << 40) + 1_500_000)
    np.random.default_rng(6).shuffle(keys)
    worst = 0.0
    for part in np.array_split(keys, 30):
        table.add(part)
        if len(table) > 1 << 18:
            worst = max(worst, table.nbytes / len(table))
    assert 56 < worst <= 72
    np.testing.assert_array_equal(table.to_map().keys, np.sort(keys))


def test_a_table_that_was_put_aside_goes_on_as_one_that_was_not(tmp_path: Path) -> None:
    (first, pixels, classes), (second, *_) = batches(2, count=2)
    away, stays = VoxelTable(0.2, URBAN), VoxelTable(0.2, URBAN)
    for table in (away, stays):
        table.add(keys_of(first, 0.2), pixels, classes)
    away.put_aside(tmp_path / "table")
    assert away.nbytes < stays.nbytes / 5
    away.take_back(tmp_path / "table")
    assert not list(tmp_path.iterdir())
    for table in (away, stays):
        table.add(keys_of(second, 0.2))
    assert_same(away.to_map(), stays.to_map())


@pytest.mark.parametrize("names", [2, 5, 6, 19])
def test_rows_hold_any_number_of_classes(names: int) -> None:
    classes = [
        {"name": f"c{i}", "semantic_kitti_id": i + 1, "asprs_code": 1, "colour": [0, 0, i]}
        for i in range(names)
    ]
    some = open_label_set({"name": "some", "classes": classes})
    rng = np.random.default_rng(7)
    classes = rng.integers(0, 256, (50, names + 1)).astype(np.uint8)
    p_map, pixels = rng.normal(0, 3, (2000, 3)), rng.integers(-1, 50, 2000).astype(np.int32)
    keys, heights = keys_of(p_map, 0.2), heights_in_voxels(p_map[:, 2], 0.2)
    whole, parts = VoxelTable(0.2, some), VoxelTable(0.2, some)
    whole.add(keys, pixels, classes, heights)
    for part in np.array_split(rng.permutation(len(keys)), 7):
        parts.add(keys[part], pixels[part], classes, heights[part])
    fused = whole.to_map()
    assert_same(parts.to_map(), fused)
    assert fused.evidence.shape == (len(np.unique(keys)), names)
    assert fused.hits.sum() == len(keys)
    assert fused.heights is not None
    assert fused.heights.sum() == heights.sum(dtype=np.int64)


def test_surfaces_lie_at_the_mean_height_of_the_points_of_a_voxel() -> None:
    parts = batches(8)
    fused = by_table(parts)
    p_map = np.concatenate([p for p, _, _ in parts])
    places = fused.indices_of(keys_of(p_map, 0.2))
    expected = np.bincount(places, p_map[:, 2]) / np.bincount(places)
    np.testing.assert_allclose(fused.surface_heights, expected, atol=0.5 * 0.2 / 256 + 1e-9)
    half = by_table(parts[:3])
    assert_same((fused - half) + half, fused)
    table = VoxelTable(0.2, URBAN)
    table.add(keys_of(p_map, 0.2))
    assert np.isnan(table.to_map().surface_heights).all()


def test_more_points_of_a_voxel_than_can_be_counted_are_an_error() -> None:
    keys = pack(np.zeros((1, 3), int))
    many = VoxelMap(0.2, URBAN, keys, np.zeros((1, 5), np.int32), np.full(1, (1 << 31) - 1, np.uint32))
    with pytest.raises(DataError, match="points"):
        many + many


def test_a_map_is_selected_in_its_order_alone() -> None:
    """Another order would break the search for keys; one as long as the map was answered with the map as it is."""
    fused = SemanticMap.of(by_table(batches(1)))
    chosen = np.flatnonzero(fused.confidence > 0.5)
    assert_same(fused[chosen].voxels, fused[fused.confidence > 0.5].voxels)
    assert_same(fused[np.arange(len(fused))].voxels, fused.voxels)
    for order in (np.argsort(fused.confidence), np.zeros(len(fused), int), chosen[::-1]):
        with pytest.raises(DataError, match="increasing"):
            fused[order]


def test_limits_are_those_of_every_column() -> None:
    rows = np.random.default_rng(0).integers(-99, 99, (50, 3))
    low, high = limits_of(rows)
    np.testing.assert_array_equal(low, rows.min(axis=0))
    np.testing.assert_array_equal(high, rows.max(axis=0))
