"""The list of steps: one name each, and nothing read from farther away than each of them says."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from gnss_sem_map import refinement
from gnss_sem_map.dynamics import range_images
from gnss_sem_map.dynamics.visibility import KeyframeScans
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.refinement.state import Evidence, MapState
from gnss_sem_map.refinement.steps import STEPS, RefinementSettings, Step, refine
from gnss_sem_map.refinement.surface_heights import SurfaceHeights
from gnss_sem_map.voxels.voxel_map import VoxelMap, pack

URBAN = open_label_set()
SIZE_M = 0.2
ROAD, SIDEWALK = 0, 1
LENGTH = 3500
"""Voxels along a street that is longer than two blocks of ground."""


def test_a_step_has_one_name_in_file_and_settings() -> None:
    files = {path.stem for path in Path(refinement.__path__[0]).glob("*.py")}
    names = [step.name for step in STEPS]
    assert set(names) <= files
    assert list(RefinementSettings.model_fields) == names
    assert [step.name for step in refine(street()[0])[1].steps] == names


@pytest.mark.parametrize("name", [step.name for step in STEPS if step.name != "decision"])
def test_every_step_can_be_switched_off(name: str) -> None:
    voxels, heights = street()
    settings = RefinementSettings.model_validate({name: {"enabled": False}})
    refined, report = refine(voxels, settings, Evidence(surface_heights=heights))
    assert {step.name: step.skipped for step in report.steps}[name] == "switched off"
    np.testing.assert_array_equal(refined.voxels.hits, voxels.hits)


def street() -> tuple[VoxelMap, SurfaceHeights]:
    """A long road beside a sidewalk, with something over it in places; labels err, heights of surfaces are known."""
    rng = np.random.default_rng(0)
    ground = np.stack(np.meshgrid(range(LENGTH), range(8), [0], indexing="ij"), -1).reshape(-1, 3)
    overhead = ground[::3] + np.array([0, 0, 4])
    indices = np.concatenate([ground, overhead])
    keys = pack(indices)
    order = np.argsort(keys)
    indices, keys = indices[order], keys[order]
    true = np.where(indices[:, 1] < 4, ROAD, SIDEWALK)
    labels = np.where(rng.random(len(keys)) < 0.15, rng.integers(0, 5, len(keys)), true)
    evidence = -rng.integers(1500, 3000, (len(keys), 5)).astype(np.int32)
    evidence[np.arange(len(keys)), labels] = -rng.integers(1, 1500, len(keys))
    evidence[rng.random(len(keys)) < 0.1] = 0
    counts = np.ones(len(keys), np.int64)
    z = np.where(true == ROAD, 0.02, 0.14) + rng.normal(0, 0.01, len(keys))
    return VoxelMap(SIZE_M, URBAN, keys, evidence, counts.astype(np.uint32)), SurfaceHeights(keys, z, counts)


def keyframes() -> KeyframeScans:
    """Scans over the street that see nothing nearer than 70 m, so that their rays traverse all of it."""
    azimuth, elevation = np.radians(np.meshgrid(np.arange(-180, 180, 0.2), np.arange(-25, 3, 0.2)))
    flat = 70.0 * np.cos(elevation)
    sphere = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), 70.0 * np.sin(elevation)], -1)
    scans = []
    for x in np.linspace(325.0, 350.0, 10):
        T_lidar_map, image = np.eye(4), range_images.empty_image()
        T_lidar_map[:3, 3] = (-x, 0.0, -2.0)
        range_images.draw(
            np.ascontiguousarray(sphere.reshape(-1, 3) + np.array([x, 0.0, 2.0])), T_lidar_map, image
        )
        scans.append((image, T_lidar_map))
    return KeyframeScans.of(scans)


LOCAL = [step for step in STEPS if np.isfinite(step.reach_m(step.settings(RefinementSettings()), SIZE_M))]


@pytest.mark.parametrize("step", LOCAL, ids=lambda step: step.name)
def test_a_step_reads_no_farther_than_its_reach(step: Step) -> None:
    """Without all that is farther from a place than the reach, the place is refined to the same."""
    settings = step.settings(RefinementSettings()).model_copy(update={"enabled": True})
    voxels, heights = street()
    beside = Evidence(moved=voxels[:0], surface_heights=heights, keyframes=keyframes())
    before = MapState.of(voxels, beside)
    if step.name in ("removed_layer", "levels", "kerbs"):
        before = replace(before, decided=refine(voxels, RefinementSettings.model_validate(OFF))[0])
    x = voxels.centres[:, 0]
    low, high = 330.0, 345.0
    reach = step.reach_m(settings, SIZE_M) + SIZE_M
    near, place = (x > low - reach) & (x < high + reach), (x > low) & (x < high)
    assert place.sum() > 500
    if step.name != "geometric_prior":
        assert near.sum() < 0.5 * len(near)
    whole, part = step.apply(before, settings), step.apply(_cut(before, near), settings)
    if step.name == "free_space":
        assert 100 < whole.is_removed[place].sum() < 0.5 * place.sum()
    for field in ("scores", "labels", "is_removed", "inferred"):
        expected, found = getattr(whole, field)[place], getattr(part, field)[place[near]]
        if step.name == "levels":  # planes are fitted around another origin
            assert (np.asarray(expected) == np.asarray(found)).mean() > 0.999
        else:
            np.testing.assert_array_equal(expected, found)


OFF = {step.name: {"enabled": False} for step in STEPS if step.name not in ("decision", "discount")}


def _cut(state: MapState, near: NDArray[np.bool_]) -> MapState:
    decided = state.decided
    cut = MapState.of(state.voxels[near], state.beside)
    if decided is None:
        return cut
    parts = {name: getattr(decided, name)[near] for name in ("labels", "confidence", "states", "entropy")}
    return replace(cut, decided=replace(decided, voxels=cut.voxels, **parts))
