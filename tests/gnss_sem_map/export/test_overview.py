"""The overview of a map counts every voxel that stands once and has north on top."""

from dataclasses import replace

import numpy as np
import pytest

from gnss_sem_map.export.overview import coverage_pixels, label_pixels, overview_of
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.voxels.kernels import UNITS_PER_NAT
from gnss_sem_map.voxels.semantic_map import SemanticMap, State
from gnss_sem_map.voxels.tiles import in_memory
from gnss_sem_map.voxels.voxel_map import VoxelMap, pack

URBAN = open_label_set()


def map_of(indices: np.ndarray, labels: np.ndarray, hits: np.ndarray) -> SemanticMap:
    keys = pack(indices)
    order = np.argsort(keys)
    evidence = np.zeros((len(keys), len(URBAN.names)), np.int32)
    evidence[np.arange(len(keys)), labels] = 2 * UNITS_PER_NAT
    return SemanticMap.of(VoxelMap(0.2, URBAN, keys[order], evidence[order], hits[order].astype(np.uint32)))


def test_an_overview_of_a_plane_over_four_tiles() -> None:
    """A square of 100 x 100 voxels about the corner of four tiles: its north half is building, its south half road."""
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(-50, 50), np.arange(-50, 50)))
    road, building = URBAN.index("road"), URBAN.index("building")
    indices = np.stack([x, y, np.zeros_like(x)], axis=1)
    semantic_map = map_of(indices, np.where(y >= 0, building, road), np.where(x < 0, 1, 30))
    tiled = in_memory(semantic_map)
    assert len(tiled.tiles) == 4
    overview = overview_of(tiled)
    assert overview is not None
    assert overview.hits.sum() == 5000 * 31
    middle = len(overview.labels) // 2
    assert (overview.labels[: middle - 1] == building).all()
    assert (overview.labels[middle + 1 :] == road).all()
    assert overview.hits[0, 0] < overview.hits[0, -1]
    # squares of 0.8 m, of which those at the rim are counted whole
    assert 20.0**2 <= overview.area_m2 <= 21.6**2
    (few, sure), (many, _) = overview.by_looks[1], overview.by_looks[20]
    assert few == many == 5000
    assert np.isclose(sure, semantic_map.confidence[0])
    assert overview.confidence["road"][0] == 5000
    assert (coverage_pixels(overview)[0, 0] > coverage_pixels(overview)[0, -1]).all()
    assert (label_pixels(overview)[0, 0] == URBAN.colours[building]).all()


def test_a_cut_keeps_the_points_of_surer_labels_whose_mean_confidence_is_the_expected_accuracy(
    street: SemanticMap,
) -> None:
    overview = overview_of(in_memory(street))
    assert overview is not None
    stands, hits, sure = street.states != State.REMOVED, street.voxels.hits.astype(float), street.confidence
    unseen = np.isin(street.states, (State.INFERRED, State.UNOBSERVED))
    for name, of_all in (("all", stands), ("not seen by a camera", unseen)):
        expected = []
        for cut in np.linspace(0, 0.95, 20).astype(np.float32):
            kept = of_all & (street.labels >= 0) & (sure >= cut)
            expected.append(
                (hits[kept].sum() / hits[of_all].sum(), np.average(sure[kept], weights=hits[kept]))
            )
        np.testing.assert_allclose(np.transpose(overview.kept[name]), expected)
    seen = replace(street, states=np.where(street.inferred, State.OBSERVED, street.states).astype(np.uint8))
    observed = overview_of(in_memory(seen))
    assert observed is not None
    assert list(observed.kept) == ["all"]
    shares = [street.shown & ~street.inferred, street.inferred, stands & (street.labels < 0)]
    assert list(overview.origins.values()) == pytest.approx([mask.sum() / stands.sum() for mask in shares])
    assert overview.confidence["other"][0] == (street.labels == len(URBAN.names)).sum()


def test_what_stands_without_a_class_is_covered_and_told_apart_by_its_reason(street: SemanticMap) -> None:
    overview = overview_of(in_memory(street))
    assert overview is not None
    hits, stands = street.voxels.hits, street.states != State.REMOVED
    unseen = hits[street.states == State.UNOBSERVED].sum()
    assert overview.hits.sum() == hits[stands].sum()
    assert overview.not_looked_at == pytest.approx(unseen / hits[stands].sum())
    assert overview.undecided == 0
    assert (overview.labels == -1).any()
    without_labels = overview_of(in_memory(SemanticMap.of(street.voxels)))
    assert without_labels is not None
    assert overview.area_m2 == without_labels.area_m2
