"""The list of steps: one name each, and nothing read from farther away than each of them says."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from long_street import SIZE_M, keyframes, street

from gnss_sem_map import refinement
from gnss_sem_map.refinement.by_block import refine
from gnss_sem_map.refinement.state import Evidence, GeometricEvidence, MapState
from gnss_sem_map.refinement.steps import STEPS, RefinementSettings, Step, do
from gnss_sem_map.voxels.semantic_map import State


def test_a_step_has_one_name_in_file_and_settings() -> None:
    files = {path.stem for path in Path(refinement.__path__[0]).glob("*.py")}
    names = [step.name for step in STEPS]
    assert set(names) <= files
    assert list(RefinementSettings.model_fields) == names
    assert [step.name for step in refine(street())[1].steps] == names


@pytest.mark.parametrize("name", [step.name for step in STEPS if step.name != "decision"])
def test_every_step_can_be_switched_off(name: str) -> None:
    voxels = street()
    settings = RefinementSettings.model_validate({name: {"enabled": False}})
    refined, report = refine(voxels, settings)
    assert {step.name: step.skipped for step in report.steps}[name] == "switched off"
    np.testing.assert_array_equal(refined.voxels.hits, voxels.hits)


@pytest.mark.parametrize("step", STEPS, ids=lambda step: step.name)
def test_a_step_reads_no_farther_than_its_reach(step: Step) -> None:
    """Without all that is farther from a place than the reach, the place is refined to the same."""
    settings = step.settings(RefinementSettings()).model_copy(update={"enabled": True})
    voxels = street()
    said = np.random.default_rng(1).integers(-3000, 0, (len(voxels), len(voxels.label_set.names) + 2))
    geometry = GeometricEvidence(voxels.keys, said.astype(np.int32), np.ones(len(voxels), np.int32))
    beside = Evidence(moved=voxels[:0], keyframes=keyframes(), geometry=geometry)
    before = MapState.of(voxels, beside)
    if step.name in ("kerbs", "free_space", "crumbs", "removed_layer"):
        before = replace(before, decided=refine(voxels, RefinementSettings.model_validate(OFF))[0])
    x = voxels.centres[:, 0]
    low, high = 330.0, 345.0
    reach = step.reach_m(settings, SIZE_M) + SIZE_M
    near, place = (x > low - reach) & (x < high + reach), (x > low) & (x < high)
    assert place.sum() > 500
    assert near.sum() < 0.1 * len(near)
    whole, part = step.apply(before, settings), step.apply(before[np.flatnonzero(near)], settings)
    if step.name == "free_space":
        assert 100 < whole.is_removed[place].sum() < 0.5 * place.sum()
    assert whole.inferred[place].any() == (step.name == "geometric_labels")
    for field in ("scores", "labels", "is_removed", "inferred"):
        expected, found = getattr(whole, field)[place], getattr(part, field)[place[near]]
        np.testing.assert_array_equal(expected, found)


def test_other_in_a_decided_map_stays_other_and_is_told_apart_from_what_is_removed() -> None:
    voxels, other = street(), len(street().label_set.names)
    decided = refine(voxels, RefinementSettings.model_validate(OFF))[0]
    chosen = np.arange(len(voxels)) % 3 == 0
    labels = np.where(chosen, np.int8(other), decided.labels)
    states = np.where(chosen, np.uint8(State.INFERRED), decided.states)
    evidence = Evidence(moved=voxels[:0], keyframes=keyframes())
    state = replace(MapState.of(voxels, evidence), decided=replace(decided, labels=labels, states=states))
    gone = {}
    for step in STEPS[[each.name for each in STEPS].index("decision") + 1 :]:
        state, report = do(step, state, RefinementSettings())
        gone[step.name] = report.changes.get(("other", "removed"), 0)
        assert not {name for pair in report.changes if "other" in pair for name in pair} - {
            "other",
            "removed",
        }
    assert state.decided is not None
    np.testing.assert_array_equal(state.labels[chosen], other)
    assert sum(gone.values()) == np.count_nonzero(state.is_removed & chosen) > 0


OFF = {step.name: {"enabled": False} for step in STEPS if step.name not in ("decision", "discount")}
