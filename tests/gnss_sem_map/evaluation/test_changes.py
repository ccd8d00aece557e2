"""A street on two days: what came, what went, what only walked by, and what nobody could see."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
import scenes
from numpy.typing import NDArray

from gnss_sem_map.dynamics.visibility import KeyframeSelector, RangeImage
from gnss_sem_map.evaluation.changes import ChangedObject, changes_between
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.mapping import evidence
from gnss_sem_map.mapping.evidence import RunEvidence
from gnss_sem_map.mapping.raw_map import RawMap
from gnss_sem_map.scans.deskew import points_in_map
from gnss_sem_map.voxels.semantic_map import SemanticMap
from gnss_sem_map.voxels.tiles import in_memory
from gnss_sem_map.voxels.voxel_map import VoxelMap, keys_of

Array = NDArray[np.float64]
SWEEPS, SIZE_M = 40, 0.2
CAR = scenes.still(11.6, 3.6, 0.0, 4.0, 1.8, 1.5)
CONTAINER = scenes.still(11.9, -5.4, 0.0, 3.4, 1.8, 1.5)
BEHIND_A_HOUSE = scenes.still(2.0, 19.5, 0.0, 4.0, 1.8, 1.5)
WALKER = ((2.0, 4.0, 0.0), (2.5, 4.5, 1.7), (1.2, 0.0, 0.0))
AIR_BESIDE_THE_CAR = scenes.still(11.6, 2.4, 0.6, 4.0, 1.0, 0.7)
LABELS = open_label_set("urban")
VEHICLE = LABELS.index("vehicle")


@cache
def seen(boxes: tuple[scenes.Box, ...]) -> tuple[list[Array], list[Array]]:
    """The points of every sweep in the map, and T_map_lidar."""
    motion = scenes.drive(SWEEPS * 0.1)
    truth = scenes.trajectory_of(motion, SWEEPS)
    street = scenes.street(boxes)
    stamps = (np.arange(SWEEPS) + 0.5) * scenes.SWEEP_S
    clouds = [
        points_in_map(scenes.sweep(motion, street, k), stamps[k], truth, scenes.T_IMU_LIDAR)
        for k in range(SWEEPS)
    ]
    return clouds, list(truth.at(stamps) @ scenes.T_IMU_LIDAR)


def voxels_of(points: Array, vehicles: tuple[scenes.Box, ...] = ()) -> VoxelMap:
    keys, counts = np.unique(keys_of(points, SIZE_M), return_counts=True)
    voxels = VoxelMap(
        SIZE_M, LABELS, keys, np.zeros((len(keys), len(LABELS.names)), np.int32), counts.astype(np.uint32)
    )
    for low, high, _ in vehicles:
        inside = ((voxels.centres > np.array(low) - 0.1) & (voxels.centres < np.array(high) + 0.1)).all(
            axis=1
        )
        voxels.evidence[inside, VEHICLE] = 1000
    return voxels


def session(
    folder: Path, boxes: tuple[scenes.Box, ...] = (), vehicles: tuple[scenes.Box, ...] = ()
) -> RawMap:
    clouds, poses = seen(boxes)
    keyframes = KeyframeSelector()
    for k, (cloud, T) in enumerate(zip(clouds, poses, strict=True)):
        keyframes.add(k * scenes.SWEEP_S, RangeImage.of(cloud, T, scenes.DENSE))
    scans = keyframes.keyframes()
    assert scans is not None
    folder.mkdir()
    evidence.write_keyframes(scans, folder / "0.npz")
    nothing = in_memory(SemanticMap.of(voxels_of(np.empty((0, 3)))))
    fused = in_memory(SemanticMap.of(voxels_of(np.concatenate(clouds), vehicles)))
    return RawMap(fused, RunEvidence(nothing, [], [folder / "0.npz"]))


def assert_are(things: list[ChangedObject], box: scenes.Box) -> None:
    """Together they fill most of the box, and nothing else."""
    low, high = np.array(box[0]), np.array(box[1])
    places = np.concatenate([thing.voxels.centres for thing in things])
    assert ((places > low - 0.3) & (places < high + 0.3)).all()
    assert np.ptp(places[:, 0]) > 0.75 * (high - low)[0]
    for thing in things:
        assert thing.misses >= 3
        assert thing.misses > 3 * thing.hits
        assert (np.abs(thing.voxels.centres - thing.centre).max(axis=0) < np.linalg.norm(thing.size)).all()


def test_what_came_and_what_went_are_told_apart(tmp_path: Path) -> None:
    before, after = session(tmp_path / "a", (CAR,), (CAR,)), session(tmp_path / "b", (CONTAINER,))
    found = changes_between(before, after)
    gone, come = ([thing for thing in found if thing.appeared == appeared] for appeared in (False, True))
    assert {thing.label for thing in gone} == {VEHICLE}
    assert {thing.label for thing in come} == {-1}
    assert_are(gone, CAR)
    assert_are(come, CONTAINER)
    again = [thing for thing in changes_between(after, before) if not thing.appeared]
    assert [thing.voxels.keys.tolist() for thing in again] == [thing.voxels.keys.tolist() for thing in come]


def test_a_street_that_stays_as_it_was_has_not_changed(tmp_path: Path) -> None:
    first = session(tmp_path / "a", (CAR,))
    assert changes_between(first, first) == []
    clouds, poses = seen((CAR,))
    # every other sweep of the same street: other voxels are missing, and nothing sees through them
    assert len(clouds) == len(poses)
    half = in_memory(SemanticMap.of(voxels_of(np.concatenate(clouds[::2]))))
    assert changes_between(first, RawMap(half, first.evidence)) == []


@pytest.mark.slow
def test_what_the_other_day_cannot_see_has_not_changed(tmp_path: Path) -> None:
    """A car behind a house is in one map by chance, and the other day looks at the house."""
    before, after = session(tmp_path / "a"), session(tmp_path / "b")
    low, high, _ = BEHIND_A_HOUSE
    chance = np.random.default_rng(0).uniform(low, high, (5000, 3))
    clouds, _ = seen(())
    fused = in_memory(SemanticMap.of(voxels_of(np.concatenate([*clouds, chance]))))
    assert changes_between(RawMap(fused, before.evidence), after) == []


@pytest.mark.slow
def test_somebody_who_walked_by_is_no_change(tmp_path: Path) -> None:
    assert changes_between(session(tmp_path / "a", (WALKER,)), session(tmp_path / "b")) == []


def test_what_its_own_day_sees_through_is_no_part_of_what_stands_there(tmp_path: Path) -> None:
    """Chance points touch a car; what is 0.3 m in front of a surface counts as a hit of it."""
    before, after = session(tmp_path / "a", (CAR,)), session(tmp_path / "b")
    low, high, _ = AIR_BESIDE_THE_CAR
    chance = np.random.default_rng(0).uniform(low, high, (5000, 3))
    clouds, _ = seen((CAR,))
    fused = in_memory(SemanticMap.of(voxels_of(np.concatenate([*clouds, chance]))))
    found = changes_between(RawMap(fused, before.evidence), after)
    places = np.concatenate([thing.voxels.centres for thing in found])
    assert np.ptp(places[:, 0]) > 3.0
    assert (places[:, 1] > CAR[0][1] - 0.3 - SIZE_M / 2).all()
    assert changes_between(RawMap(fused, after.evidence), after) == []


def test_without_keyframe_scans_nothing_is_said(tmp_path: Path) -> None:
    before, after = session(tmp_path / "a", (CAR,)), session(tmp_path / "b")
    blind = RawMap(after.fused, RunEvidence(after.evidence.moved, [], []))
    assert changes_between(before, blind) == []
