"""A street on a slope, every point of which is known: kerb, parked car, trees over road, a hedge, nothing behind it."""

from dataclasses import dataclass, replace

import numpy as np

from factor_graphs.geodesy import LocalFrame
from gnss_sem_map.export.exported import Exported
from gnss_sem_map.labels.label_set import LabelSet, open_label_set
from gnss_sem_map.voxels import tiles
from gnss_sem_map.voxels.kernels import HEIGHT_UNITS
from gnss_sem_map.voxels.semantic_map import SemanticMap, State
from gnss_sem_map.voxels.voxel_map import VoxelMap, pack

SIZE = 0.2
KERB_M = 0.12
ROAD, SIDEWALK, VEHICLE, BUILDING, VEGETATION, OTHER = range(6)
HITS = 20


def ground(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """True height of the ground: 3 % up to the east, 1 % to the north, and the kerb at y = 4 m."""
    return np.asarray(0.03 * x + 0.01 * y + np.where(y > 4, KERB_M, 0))


@dataclass(frozen=True)
class Part:
    """Columns of a rectangle in m, and how high over the ground their voxels are."""

    x: tuple[float, float]
    y: tuple[float, float]
    label: int
    above: tuple[float, ...] = (0.0,)
    state: State = State.OBSERVED

    def columns(self) -> np.ndarray:
        axes = [np.arange(round(low / SIZE), round(high / SIZE)) for low, high in (self.x, self.y)]
        return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 2)


CAR = Part((20, 24), (1, 3), VEHICLE, tuple(np.arange(0.25, 1.4, 0.2)))
HEDGE = Part((0, 40), (8, 8.4), VEGETATION, tuple(np.arange(0.1, 1.2, 0.2)))
CANOPY = Part((8, 12), (-4, 8), VEGETATION, (3.0, 3.2))
SIGN = Part((30, 30.4), (-1, -0.4), OTHER, (0.5, 0.7))
MOVED = Part((32, 36), (-3, -1), VEHICLE, (0.5, 0.7), State.REMOVED)
PARTS = (
    Part((0, 40), (-4, 4), ROAD), Part((0, 40), (4, 8), SIDEWALK), CAR, HEDGE, CANOPY, SIGN, MOVED,
    Part((0, 40), (-6, -4), OTHER),
)  # fmt: skip


def hillside(label_set: LabelSet | None = None, shift: tuple[int, int] = (0, 0)) -> SemanticMap:
    """The map; under the car no ground was seen. `shift` moves it by whole columns, the slope stays where it is."""
    rows = []
    for part in PARTS:
        columns = part.columns()
        if part.label in (ROAD, SIDEWALK):
            columns = columns[~in_part(columns, CAR)]
        x, y = (columns + 0.5).T * SIZE
        for above in part.above:
            z = (ground(x, y) + above) / SIZE
            rows.append(
                np.column_stack([columns, z, np.full(len(z), part.label), np.full(len(z), part.state)])
            )
    table = np.concatenate(rows)
    k = np.floor(table[:, 2])
    keys, first = np.unique(pack(np.column_stack([table[:, :2] + shift, k]).astype(int)), return_index=True)
    table, inside = table[first], (table[:, 2] - k)[first]
    label_set, v = label_set or open_label_set(), len(keys)
    voxels = VoxelMap(
        SIZE, label_set, keys, np.zeros((v, len(label_set.names)), np.int32), np.full(v, HITS, np.uint32),
        np.floor(inside * HEIGHT_UNITS).astype(np.int64) * HITS,
    )  # fmt: skip
    return SemanticMap(
        voxels, table[:, 3].astype(np.int8), np.ones(v, np.float32), table[:, 4].astype(np.uint8)
    )


def in_part(columns: np.ndarray, part: Part) -> np.ndarray:
    """Which columns (n, 2) are in the rectangle of a part."""
    low, high = np.array([part.x, part.y]).T / SIZE
    return np.asarray(((columns >= np.round(low)) & (columns < np.round(high))).all(axis=1))


def exported(frame: LocalFrame | None = None, semantic_map: SemanticMap | None = None) -> Exported:
    return replace(Exported(tiles.in_memory(semantic_map or hillside(), frame)), title="hillside")
