"""What a calibration file says: likelihoods from counts, and nothing for other classes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from pydantic import ValidationError

from gnss_sem_map.config import Settings, load
from gnss_sem_map.errors import ConfigError
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.labels.sensor_model import (
    CELLS,
    FLATNESS_EDGES,
    HEIGHT_EDGES_M,
    CalibrationDrive,
    LabelCalibration,
    cells_of,
    read,
)
from gnss_sem_map.refinement.normals import flatness
from gnss_sem_map.refinement.potts_mrf import PottsSettings
from gnss_sem_map.refinement.steps import RefinementSettings
from gnss_sem_map.voxels.voxel_map import pack

URBAN = open_label_set()


def street(seed: int, most: int = 100_000) -> CalibrationDrive:
    rng = np.random.default_rng(seed)
    return CalibrationDrive(
        f"street {seed}", rng.integers(0, most, (5, 6)), rng.integers(0, most, (5, *CELLS))
    )


def of(*streets: CalibrationDrive, temperature: float = 2.0) -> LabelCalibration:
    return LabelCalibration(URBAN.name, URBAN.names, streets, temperature)


def test_with_many_points_the_likelihoods_are_the_shares_that_were_counted() -> None:
    answers = np.array([[70, 20, 2, 3, 2, 3]] * 5) * 10**9
    answers[1] = np.array([50, 40, 2, 2, 3, 3]) * 10**9
    found = np.exp(of(replace(street(0), answers=answers)).log_likelihoods)
    np.testing.assert_allclose(found.sum(axis=1), 1, rtol=1e-12)
    np.testing.assert_allclose(found[0, 1] / found[0, 0], 50 / 70, rtol=1e-6)
    np.testing.assert_allclose(found[1, 1] / found[1, 0], 40 / 20, rtol=1e-6)


def test_a_class_of_which_nothing_was_seen_is_neither_excluded_nor_preferred() -> None:
    """Its likelihood is that of the average class: one pseudo-count per class says so little."""
    answers = np.array([[900, 50, 10, 20, 10, 10]] * 5)
    answers[2] = 0
    found = of(replace(street(0), answers=answers)).log_likelihoods
    assert np.abs(found[:, 2] - found[:, 0]).max() < 0.1


@settings(max_examples=30, deadline=None)
@given(st.lists(st.integers(0, 2**31), min_size=1, max_size=4), st.randoms(use_true_random=False))
def test_every_street_counts_the_same_in_any_order(seeds: list[int], chance) -> None:
    streets = [street(seed) for seed in seeds]
    shuffled = list(streets)
    chance.shuffle(shuffled)
    a, b = of(*streets), of(*shuffled)
    np.testing.assert_allclose(a.log_likelihoods, b.log_likelihoods, rtol=1e-9)
    twice = of(*streets, *streets)
    np.testing.assert_allclose(twice.log_likelihoods, a.log_likelihoods, rtol=1e-9)
    assert (a.log_likelihoods < 0).all()
    assert np.isfinite(a.log_likelihoods).all()


@given(st.floats(-5, 20), st.one_of(st.just(float("nan")), st.floats(0, 1)))
def test_a_cell_holds_the_heights_and_normals_between_its_edges(height: float, flat: float) -> None:
    row, column = divmod(int(cells_of(np.array([height]), np.array([flat]))[0]), CELLS[1])
    edges = (-np.inf, *HEIGHT_EDGES_M, np.inf)
    assert edges[row] <= height < edges[row + 1]
    if np.isnan(flat):
        assert column == CELLS[1] - 1
    else:
        edges = (-np.inf, *FLATNESS_EDGES, np.inf)
        assert edges[column] <= flat < edges[column + 1]


def test_a_file_reads_back_as_it_was_written(tmp_path: Path) -> None:
    written, file = of(street(1), street(2), temperature=1.7), tmp_path / "calibration.yaml"
    file.write_text(written.to_yaml())
    found = read(file, URBAN)
    assert (found.names, found.class_set, found.temperature) == (written.names, "urban", 1.7)
    assert [s.name for s in found.drives] == ["street 1", "street 2"]
    np.testing.assert_array_equal(found.log_likelihoods, written.log_likelihoods)
    heights, flat = np.array([0.0, 2.2]), np.array([1.0, np.nan])
    np.testing.assert_array_equal(found.of_geometry(heights, flat), written.of_geometry(heights, flat))


def test_another_class_sets_file_is_an_error(tmp_path: Path) -> None:
    content = yaml.safe_load(of(street(1)).to_yaml())
    content["class_set"], content["classes"] = "marsh", ["reed", "water", "bank", "boat", "bird"]
    file = tmp_path / "marsh.yaml"
    file.write_text(yaml.safe_dump(content))
    with pytest.raises(ConfigError, match=r"class set 'marsh'.*'urban'"):
        read(file, URBAN)


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("format", 99, "format"),
        ("temperature", -1.0, "temperature -1.0"),
        ("temperature", "warm", "could not convert"),
        ("streets", [], "0 drives"),
        ("streets", [{"name": "x", "answers": [[1, 2]], "cells": [[[1]]]}], r"answers \(1, 2\)"),
        ("streets", [{"name": "x"}], "answers"),
    ],
)
def test_a_damaged_file_says_what_is_wrong(tmp_path: Path, key: str, value: object, said: str) -> None:
    content = yaml.safe_load(of(street(1)).to_yaml()) | {key: value}
    file = tmp_path / "calibration.yaml"
    file.write_text(yaml.safe_dump(content))
    with pytest.raises(ConfigError, match=said):
        read(file, URBAN)


@pytest.mark.parametrize("text", ["", "[", "- 1\n", "!!python/object:os.system {}\n"])
def test_what_is_no_calibration_file_is_refused(tmp_path: Path, text: str) -> None:
    file = tmp_path / "calibration.yaml"
    file.write_text(text)
    with pytest.raises(ConfigError, match="calibration"):
        read(file, URBAN)
    with pytest.raises(ConfigError, match="cannot read"):
        read(tmp_path / "none.yaml", URBAN)


def plane(x: range, y: range, z: range) -> NDArray[np.int64]:
    grid = np.stack(np.meshgrid(x, y, z, indexing="ij"), -1).reshape(-1, 3)
    return np.sort(pack(grid))


def test_flatness_is_one_on_ground_zero_on_walls_and_unknown_for_lines_and_single_voxels() -> None:
    slope = np.sort(pack(np.array([(x, y, x) for x in range(9) for y in range(9)])))
    for keys, expected in (
        (plane(range(9), range(9), range(1)), 1.0),
        (plane(range(9), range(1), range(9)), 0.0),
        (slope, np.sqrt(0.5)),
    ):
        found = flatness(keys)
        assert np.isnan(found).sum() == 4, "a corner has three neighbours"
        np.testing.assert_allclose(found[~np.isnan(found)], expected, atol=1e-6)
    assert np.isnan(flatness(plane(range(9), range(1), range(1)))).all()
    assert np.isnan(flatness(plane(range(1), range(1), range(1)))).all()
    assert len(flatness(np.empty(0, np.int64))) == 0


def test_flatness_is_that_of_the_covariance_of_the_occupied_neighbours() -> None:
    rng = np.random.default_rng(0)
    indices = np.unique(rng.integers(0, 8, (250, 3)), axis=0)
    found = flatness(pack(indices))
    wanted = rng.random(len(indices)) < 0.5
    np.testing.assert_array_equal(
        flatness(pack(indices), wanted), np.where(wanted, found, np.float32(np.nan))
    )
    for i, index in enumerate(indices):
        near = indices[(np.abs(indices - index) <= 1).all(axis=1)]
        if len(near) < 5:
            assert np.isnan(found[i])
            continue
        spreads, axes = np.linalg.eigh(np.cov(near.T, bias=True))
        if spreads[1] - spreads[0] > 1e-6 and spreads[1] > 0.011:
            np.testing.assert_allclose(found[i], np.abs(axes[2, 0]), atol=1e-5)


def test_eq_6_alone_is_one_setting_and_what_contradicts_it_is_refused() -> None:
    paper = load(None, ["fusion=paper"])
    assert paper.labelling.probability_floor == 0.01
    assert paper.refinement.discount.exponent == paper.refinement.decision.temperature == 1
    assert paper.refinement.systematic_error.rate == 0
    assert not paper.refinement.geometric_prior.enabled
    assert not paper.refinement.potts_mrf.enabled
    assert paper.refinement.vehicles == Settings().refinement.vehicles
    both = load(None, ["refinement.count_grid.method=paper", "fusion=paper", "labelling.abstain=true"])
    assert both.refinement.count_grid.method == "paper"
    assert not both.refinement.geometric_prior.enabled
    assert both.labelling.abstain
    assert both.labelling.probability_floor == 0.01
    assert Settings.model_validate(yaml.safe_load(paper.to_yaml())) == paper
    said = r"fusion: paper sets refinement\.potts_mrf\.enabled to False, found True"
    with pytest.raises(ConfigError, match=said):
        load(None, ["refinement.potts_mrf.enabled=true", "fusion=paper"])
    from_python = RefinementSettings(potts_mrf=PottsSettings(enabled=True))
    with pytest.raises(ValidationError, match=said):
        Settings(fusion="paper", refinement=from_python)
    assert Settings(fusion="paper", refinement=RefinementSettings()) == paper
