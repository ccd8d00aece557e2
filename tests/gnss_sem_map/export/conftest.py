"""A short street as a semantic map, a track along it, and where on Earth it lies."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from browsers import Browser, opened_browser

from factor_graphs.geodesy import LocalFrame
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.labels.label_set import LabelSet, open_label_set
from gnss_sem_map.voxels.semantic_map import SemanticMap, State
from gnss_sem_map.voxels.voxel_map import VoxelMap, pack

VOXEL_M = 0.2
LABELS = open_label_set()
ROAD, SIDEWALK, VEHICLE, BUILDING, VEGETATION, OTHER = range(6)


def semantic_map(
    indices: np.ndarray, labels: np.ndarray, states: np.ndarray | None = None, classes: LabelSet = LABELS
) -> SemanticMap:
    """A map that holds these voxels (v, 3), each once, with these labels (v,)."""
    keys, first = np.unique(pack(indices), return_index=True)
    labels = np.asarray(labels, np.int8)[first]
    rng = np.random.default_rng(7)
    evidence = np.zeros((len(keys), len(classes.names)), np.int32)
    of_class = np.flatnonzero((labels >= 0) & (labels < len(classes.names)))
    evidence[of_class] = -2000
    evidence[of_class, labels[of_class]] = -100
    hits = rng.integers(1, 500, len(keys)).astype(np.uint32)
    seen = np.where(labels >= 0, State.OBSERVED, State.UNOBSERVED)
    return SemanticMap(
        voxels=VoxelMap(VOXEL_M, classes, keys, evidence, hits),
        labels=labels,
        confidence=np.where(labels >= 0, rng.uniform(0.5, 1, len(keys)), 0).astype(np.float32),
        states=np.asarray(seen if states is None else np.asarray(states)[first], np.uint8),
    )


def box(x: tuple[float, float], y: tuple[float, float], z: tuple[float, float]) -> np.ndarray:
    """Indices (n, 3) of all voxels of a box, given in metres."""
    axes = [np.arange(round(low / VOXEL_M), round(high / VOXEL_M)) for low, high in (x, y, z)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


@pytest.fixture(scope="session")
def street() -> SemanticMap:
    """60 m of road eastward, kerb, wall in the north, trees, a car, a removed car, a lawn, unseen ground."""
    parts = [
        (box((0, 60), (-4, 4), (0, 0.2)), ROAD, State.OBSERVED),
        (box((0, 60), (4, 6), (0, 0.4)), SIDEWALK, State.REFINED),
        (box((5, 50), (6, 6.4), (0, 8)), BUILDING, State.OBSERVED),
        (box((10, 13), (-9, -6), (0, 5)), VEGETATION, State.INFERRED),
        (box((20, 24), (1.6, 3.6), (0.2, 1.6)), VEHICLE, State.OBSERVED),
        (box((40, 44), (-3, -1.2), (0.2, 1.6)), VEHICLE, State.REMOVED),
        (box((50, 58), (6, 9), (0, 0.2)), OTHER, State.INFERRED),
        (box((0, 60), (-6, -4), (0, 0.2)), -1, State.UNOBSERVED),
    ]
    return semantic_map(
        np.concatenate([indices for indices, _, _ in parts]),
        np.concatenate([np.full(len(indices), label) for indices, label, _ in parts]),
        np.concatenate([np.full(len(indices), state) for indices, _, state in parts]),
    )


@pytest.fixture(scope="session")
def town(street: SemanticMap) -> SemanticMap:
    """Twelve copies of the street in eleven tiles, west and east, south and north of the origin."""
    copies = [(dx, dy) for dx in (-900, -300, 400, 1100) for dy in (-700, 30, 600)]
    voxels = street.voxels
    keys = np.concatenate([pack(voxels.indices + np.array([dx, dy, 0])) for dx, dy in copies])
    order = np.argsort(keys)
    many = np.tile(np.arange(len(street)), len(copies))[order]
    return SemanticMap(
        replace(voxels, keys=keys[order], evidence=voxels.evidence[many], hits=voxels.hits[many]),
        street.labels[many],
        street.confidence[many],
        street.states[many],
    )


@pytest.fixture(scope="session")
def track() -> Trajectory:
    """Eastward along the street at 10 m/s, one metre above it, turning a little."""
    stamps = np.linspace(0.05, 5.9, 40)
    T = np.tile(np.eye(4), (40, 1, 1))
    yaw = 0.1 * np.sin(stamps)
    T[:, 0, 0] = T[:, 1, 1] = np.cos(yaw)
    T[:, 1, 0], T[:, 0, 1] = np.sin(yaw), -np.sin(yaw)
    T[:, :3, 3] = np.column_stack([10 * stamps, 0.2 * np.sin(stamps), np.full(40, 1.1)])
    return Trajectory(stamps, T)


@pytest.fixture(scope="session")
def karlsruhe() -> LocalFrame:
    """Where KITTI was recorded; half a degree west of its UTM zone's central meridian."""
    return LocalFrame(49.0, 8.4, 115.0)


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with opened_browser(tmp_path_factory.mktemp("profile")) as opened:
        yield opened
