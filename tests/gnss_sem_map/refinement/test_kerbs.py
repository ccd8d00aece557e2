"""Where road meets sidewalk: points know more than voxels, and where there is no step nobody pretends to know."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator
from scipy.special import logit
from scipy.stats import norm

from gnss_sem_map import config
from gnss_sem_map.datasets import open_drive
from gnss_sem_map.datasets.label_files import read_labels
from gnss_sem_map.evaluation.metrics import Tables, confusion
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.mapping import evidence
from gnss_sem_map.mapping.point_labels import PointLabels, label_points
from gnss_sem_map.refinement import kerb_points
from gnss_sem_map.refinement.kerb_points import Kerbs
from gnss_sem_map.refinement.kerbs import KerbSettings, find_kerbs
from gnss_sem_map.runs import pipeline
from gnss_sem_map.runs.map_job import MapJob
from gnss_sem_map.segmentation import open_segmenter
from gnss_sem_map.simulation import simulate
from gnss_sem_map.voxels import tiles
from gnss_sem_map.voxels.semantic_map import SemanticMap, State
from gnss_sem_map.voxels.voxel_map import VoxelMap, keys_of

URBAN = open_label_set()
ROAD, SIDEWALK, BUILDING = (URBAN.index(name) for name in ("road", "sidewalk", "building"))
SIZE_M = 0.2


@dataclass(frozen=True)
class Scene:
    """Points, what each is, and a map whose every voxel is what most of its points are."""

    p_map: NDArray[np.float64]
    truth: NDArray[np.int8]
    semantic_map: SemanticMap

    @property
    def keys(self) -> NDArray[np.int64]:
        return keys_of(self.p_map, SIZE_M)

    @property
    def places(self) -> NDArray[np.int64]:
        return self.semantic_map.voxels.indices_of(self.keys)

    @property
    def heights(self) -> NDArray[np.float64]:
        return np.bincount(self.places, self.p_map[:, 2]) / np.bincount(self.places)

    def kerbs(self, settings: KerbSettings | None = None) -> Kerbs:
        found = find_kerbs(self.semantic_map, self.heights, settings or KerbSettings())
        assert found is not None
        return found

    def mistakes(self) -> tuple[int, int]:
        """Of the map's voxels, and with kerbs told apart."""
        called = self.semantic_map.labels[self.places]
        inside, chosen, _ = self.kerbs().decide(self.keys, self.p_map)
        told = called.copy()
        told[inside] = chosen
        return int((called != self.truth).sum()), int((told != self.truth).sum())


def scene(step_m: float = 0.12, heading: float = 0.3, low_m: float = 0.04, confidence: float = 0.9) -> Scene:
    """Ten metres of a street, sidewalk on its left and `step_m` higher; points stand 1 cm off at random."""
    rng = np.random.default_rng(0)
    p_map = rng.uniform((0, -2, 0), (10, 2, 0), (80_000, 3))
    left = p_map[:, 1] - heading * (p_map[:, 0] - 5) > 0.07
    p_map[:, 2] = low_m + step_m * left + np.clip(rng.normal(0, 0.01, len(p_map)), -0.03, 0.03)
    truth = np.where(left, SIDEWALK, ROAD).astype(np.int8)
    keys, voxel = np.unique(keys_of(p_map, SIZE_M), return_inverse=True)
    votes = np.bincount(2 * voxel + left, minlength=2 * len(keys)).reshape(-1, 2)
    called = np.where(votes[:, 1] > votes[:, 0], SIDEWALK, ROAD).astype(np.int8)
    evidence = np.full((len(keys), len(URBAN.names)), -1000, np.int32)
    voxels = VoxelMap(SIZE_M, URBAN, keys, evidence, votes.sum(axis=1).astype(np.uint32))
    states = np.full(len(keys), State.OBSERVED, np.uint8)
    return Scene(
        p_map, truth, SemanticMap(voxels, called, np.full(len(keys), confidence, np.float32), states)
    )


@pytest.mark.parametrize("heading", [0.0, 0.3, 0.6])
@pytest.mark.parametrize("low_m", [0.0, 0.04, 0.07])
def test_points_of_a_kerb_are_told_apart_better_than_any_labels_of_voxels_could(
    heading: float, low_m: float
) -> None:
    """The voxels here have the best labels that there are, those of most of their points."""
    of_voxels, of_points = scene(heading=heading, low_m=low_m).mistakes()
    assert of_voxels > 300
    assert of_points < of_voxels / 5


def test_a_line_on_level_ground_is_no_kerb_and_the_voxels_stand() -> None:
    flat = scene(step_m=0.0)
    assert find_kerbs(flat.semantic_map, flat.heights, KerbSettings()) is None
    sunk = scene(step_m=-0.12)  # a sidewalk below the road is none that these heights know
    assert find_kerbs(sunk.semantic_map, sunk.heights, KerbSettings()) is None


def test_where_no_two_meet_there_is_no_kerb() -> None:
    street = scene()
    one = np.full_like(street.semantic_map.labels, ROAD)
    removed = np.full_like(street.semantic_map.states, State.REMOVED)
    beside_a_wall = np.where(street.semantic_map.labels == SIDEWALK, BUILDING, ROAD).astype(np.int8)
    for other in ({"labels": one}, {"states": removed}, {"labels": beside_a_wall}):
        assert find_kerbs(replace(street.semantic_map, **other), street.heights, KerbSettings()) is None


def test_the_odds_are_those_of_scipy(monkeypatch: pytest.MonkeyPatch) -> None:
    """Place: a bilinear interpolation of probabilities between voxel centres; height: two normal distributions."""
    low, confidence, stddev = 0.04, 0.9, 0.08
    street = scene(low_m=low, confidence=confidence, heading=0.0)
    monkeypatch.setattr(kerb_points, "POINT_STDDEV_M", stddev)
    monkeypatch.setattr(kerb_points, "FACE_BEGINS", 0.5)
    inside, chosen, probability = street.kerbs().decide(street.keys, street.p_map)
    x, y = (np.arange(n) * SIZE_M for n in (50, 20))
    grid = np.where(street.semantic_map.labels.reshape(50, 20) == ROAD, confidence, 1 - confidence)
    of_road = RegularGridInterpolator((x + SIZE_M / 2, y - 2 + SIZE_M / 2), grid)
    within = np.flatnonzero(np.abs(street.p_map[inside, 0] - 5) < 4.5)
    p = street.p_map[inside[within]]
    log_odds = logit(of_road(p[:, :2])) + (
        norm.logpdf(p[:, 2], low, stddev) - norm.logpdf(p[:, 2], low + 0.12, stddev)
    )
    assert len(p) > 2000
    expected = np.where(log_odds >= 0, ROAD, SIDEWALK)
    clear = np.abs(log_odds) > 0.05  # the levels are measured, not given
    np.testing.assert_array_equal(chosen[within][clear], expected[clear])
    np.testing.assert_allclose(probability[within], 1 / (1 + np.exp(-np.abs(log_odds))), atol=0.02)


def test_points_far_from_a_kerb_or_in_no_voxel_are_left_alone() -> None:
    street = scene()
    keys = street.keys
    keys[::7] += 50  # far above
    inside, _, _ = street.kerbs().decide(keys, street.p_map)
    assert (inside % 7 != 0).all()
    off = np.abs(street.p_map[inside, 1] - 0.3 * (street.p_map[inside, 0] - 5) - 0.07)
    assert 0 < off.max() < 0.6


Told = dict[str, dict[str, list[PointLabels]]]


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two simulated seconds, whose label images are true."""
    return simulate(tmp_path_factory.mktemp("street"), 2.0, 1)


@pytest.fixture(scope="module")
def told(street: Path, tmp_path_factory: pytest.TempPathFactory) -> Told:
    """Setting -> scan -> what the raw map and the refined one say of its points."""
    log = open_drive(street)
    segmenter = open_segmenter(
        f"labels:{street / 'truth' / 'train_ids'}", URBAN, sizes=log.calibration.image_sizes
    )
    settings = config.Settings()
    run = MapJob(settings, log.frame, tmp_path_factory.mktemp("run"), is_one=True)
    mapped = pipeline.map_log(log, segmenter, run)
    folder = mapped.folder
    kerbs = pipeline.refine(folder, settings, mapped.stats).kerbs
    maps = [tiles.open_map(folder / name) for name in ("map", "refined")]
    moving = evidence.read(folder, URBAN).moving_points
    found = {
        name: label_points(mapped.log, mapped.trajectory, maps, settings, moving, told_apart)
        for name, told_apart in (("on", kerbs), ("off", None))
    }
    return {name: {scan.name: both for scan, both in scans} for name, scans in found.items()}


@pytest.mark.integration
def test_a_run_tells_the_points_of_its_refined_map_apart_and_no_others(told: Told) -> None:
    for name, on in told["on"].items():
        off = told["off"][name]
        np.testing.assert_array_equal(on[0].labels, off[0].labels)
        np.testing.assert_array_equal(on[1].removed, off[1].removed)
        differ = on[1].labels != off[1].labels
        assert np.isin(on[1].labels[differ], (ROAD, SIDEWALK)).all()
        assert np.isin(off[1].labels[differ], (ROAD, SIDEWALK)).all()
        assert (on[1].confidence[differ] >= 0.5).all()


@pytest.mark.integration
def test_on_a_simulated_street_two_of_five_points_on_the_wrong_side_of_a_kerb_come_right(
    told: Told, street: Path
) -> None:
    tables, ids = Tables.of(URBAN), np.append(URBAN.legend.semantic_kitti_ids, 0).astype(np.uint32)
    wrong = {}
    for setting in ("on", "off"):
        counts = np.zeros((6, 7), np.int64)
        for name, (raw, refined) in told[setting].items():
            seen = raw.labels >= 0  # what no camera saw is wrong for other reasons as well
            truth = read_labels(street / "truth" / "labels" / f"{name}.label")
            counts += confusion(ids[refined.labels[seen]], truth[seen], tables, name)
        wrong[setting] = counts[ROAD, SIDEWALK] + counts[SIDEWALK, ROAD]
    assert wrong["off"] > 1000
    assert wrong["on"] < 0.6 * wrong["off"]
