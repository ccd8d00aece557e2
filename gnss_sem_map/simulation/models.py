"""Models of the things of a town: a few shapes each, x forward or along, y left or inwards, z up."""

from dataclasses import dataclass

import numpy as np

from gnss_sem_map.simulation.compiled import Floats
from gnss_sem_map.simulation.shapes import SHAPE_COLUMNS, Form
from gnss_sem_map.simulation.surfaces import Kind, Surface

Row = list[float]


@dataclass(frozen=True, eq=False)
class Model:
    """Shapes that belong together: `shapes` (k, SHAPE_COLUMNS), lengths in metres."""

    name: str
    shapes: Floats

    def __post_init__(self) -> None:
        if self.shapes.ndim != 2 or self.shapes.shape[1] != SHAPE_COLUMNS:
            raise ValueError(
                f"model {self.name}: shapes are {self.shapes.shape}, expected (k, {SHAPE_COLUMNS})"
            )

    @property
    def bounds(self) -> Floats:
        """(6,) smallest and largest x, y, z in metres; zeros without shapes."""
        if not len(self.shapes):
            return np.zeros(6)
        centre, half = self.shapes[:, :3], self.shapes[:, 3:6]
        return np.concatenate([(centre - half).min(0), (centre + half).max(0)])


def _model(name: str, rows: list[Row]) -> Model:
    table = np.array(rows, float)
    half = table[:, 3:6]
    radius = np.linalg.norm(half, axis=1)
    radius[table[:, 11] == Form.ELLIPSOID] = half.max(axis=1)[table[:, 11] == Form.ELLIPSOID]
    return Model(name, np.column_stack([table, radius]))


def _block(
    x: tuple[float, float],
    y: tuple[float, float],
    z: tuple[float, float],
    surface: Surface,
    kind: Kind,
    tapers: tuple[float, float, float] = (0.0, 0.0, 0.0),
    leaves: tuple[float, float] = (0.0, 1.0),
) -> Row:
    """A block between these limits; tapers: how much the top is shorter in front, behind, and at each side."""
    centre = [0.5 * (low + high) for low, high in (x, y, z)]
    half = [0.5 * (high - low) for low, high in (x, y, z)]
    return [*centre, *half, *tapers, *leaves, Form.BLOCK, surface, kind]


def _round(
    form: Form,
    centre: tuple[float, float, float],
    half: tuple[float, float, float],
    surface: Surface,
    kind: Kind,
    leaves: tuple[float, float] = (0.0, 1.0),
) -> Row:
    return [*centre, *half, 0.0, 0.0, 0.0, *leaves, form, surface, kind]


def _wheels(base: float, track: float, radius: float, kind: Kind) -> list[Row]:
    centres = [(x, y, radius) for x in (base, -base) for y in (track, -track)]
    return [_round(Form.AXLE, c, (radius, 0.11, radius), Surface.RUBBER, kind) for c in centres]


def _lamps(x: float, y: float, z: tuple[float, float], kind: Kind) -> list[Row]:
    rows = []
    for side in (-1.0, 1.0):
        inner, outer = sorted((side * (y - 0.30), side * y))
        rows.append(_block((x - 0.10, x + 0.012), (inner, outer), z, Surface.HEADLAMP, kind))
        rows.append(_block((-x - 0.012, -x + 0.10), (inner, outer), z, Surface.TAILLAMP, kind))
    return rows


def car(name: str, length: float, width: float, height: float, bonnet: float, boot: float) -> Model:
    """A passenger car: wheels, hull, shoulders, a cabin of glass with a roof, lamps, bumpers and plates."""
    x, y, kind = 0.5 * length, 0.5 * width, Kind.CAR
    waist, rear = 0.56 * height + 0.05, 0.16 if boot < 0.4 else 0.42
    cabin = (-x + boot, x - bonnet)
    top = (cabin[0] + rear, cabin[1] - 0.62)
    rows = [
        _block((-x, x), (-y, y), (0.22, 0.60), Surface.PAINT, kind, (0.05, 0.03, 0.0)),
        _block((-x + 0.03, x - 0.05), (-y, y), (0.60, waist), Surface.PAINT, kind, (0.16, 0.06, 0.05)),
        _block(
            cabin,
            (-y + 0.05, y - 0.05),
            (waist - 0.01, height - 0.04),
            Surface.CABIN,
            kind,
            (0.62, rear, 0.17),
        ),
        _block(top, (-y + 0.20, y - 0.20), (height - 0.045, height), Surface.PAINT, kind, (0.10, 0.08, 0.06)),
        _block((-x - 0.03, x + 0.03), (-y + 0.06, y - 0.06), (0.26, 0.42), Surface.RUBBER, kind),
        _block((x - 0.1, x + 0.04), (-0.26, 0.26), (0.36, 0.47), Surface.MARKING, kind),
        _block((-x - 0.04, -x + 0.1), (-0.26, 0.26), (0.44, 0.55), Surface.MARKING, kind),
        *_lamps(x - 0.005, y - 0.06, (0.56, 0.70), kind),
        *_wheels(0.30 * length, y - 0.09, 0.31, kind),
    ]
    for side in (-1.0, 1.0):  # mirrors
        low, high = sorted((side * (y - 0.02), side * (y + 0.15)))
        rows.append(
            _block(
                (cabin[1] - 0.55, cabin[1] - 0.40), (low, high), (waist, waist + 0.14), Surface.PAINT, kind
            )
        )
    return _model(name, rows)


def van() -> Model:
    """A delivery van: one tall body with a sloping front."""
    kind, x, y = Kind.CAR, 2.45, 0.96
    return _model(
        "van",
        [
            _block((-x, x), (-y, y), (0.26, 1.05), Surface.PAINT, kind, (0.10, 0.0, 0.0)),
            _block((-x, 0.55), (-y, y), (1.05, 2.02), Surface.PAINT, kind, (0.0, 0.05, 0.10)),
            _block(
                (0.55, x - 0.35), (-y + 0.03, y - 0.03), (1.05, 1.95), Surface.CABIN, kind, (1.0, 0.0, 0.12)
            ),
            _block((-x - 0.01, -x + 0.2), (-0.72, 0.72), (1.15, 1.75), Surface.CABIN, kind, (0.0, 0.05, 0.0)),
            _block((-x - 0.03, x + 0.03), (-y + 0.05, y - 0.05), (0.30, 0.46), Surface.RUBBER, kind),
            _block((-x - 0.04, -x + 0.1), (-0.26, 0.26), (0.50, 0.61), Surface.MARKING, kind),
            *_lamps(x, y - 0.05, (0.72, 0.92), kind),
            *_wheels(1.55, y - 0.09, 0.34, kind),
        ],
    )


def truck() -> Model:
    """A box truck."""
    kind, y = Kind.TRUCK, 1.1
    return _model(
        "truck",
        [
            _block((-3.6, 3.5), (-y + 0.25, y - 0.25), (0.55, 0.95), Surface.STEEL, kind),
            _block((-3.7, 1.7), (-y, y), (0.95, 3.3), Surface.CARGO, kind),
            _block((1.85, 3.7), (-y + 0.08, y - 0.08), (0.45, 1.55), Surface.PAINT, kind),
            _block((1.85, 3.7), (-y + 0.08, y - 0.08), (1.55, 2.5), Surface.CABIN, kind, (0.30, 0.0, 0.06)),
            _block((1.90, 3.35), (-y + 0.16, y - 0.16), (2.5, 2.62), Surface.PAINT, kind),
            *_lamps(3.7, y - 0.12, (0.72, 0.92), kind),
            *_wheels(2.55, y - 0.17, 0.46, kind),
        ],
    )


def tanker() -> Model:
    """A tractor with a tank of twelve metres behind it: longer and higher than any other vehicle of the town."""
    kind, y = Kind.TRUCK, 1.25
    wheels = [_round(Form.AXLE, (x, z * (y - 0.15), 0.5), (0.5, 0.13, 0.5), Surface.RUBBER, kind)
              for x in (-6.6, -5.3, 3.4, 6.4) for z in (1, -1)]  # fmt: skip
    return _model(
        "tanker",
        [
            _block((-7.8, 5.0), (-y + 0.3, y - 0.3), (0.8, 1.15), Surface.STEEL, kind),
            _block((-7.9, 4.2), (-y, y), (1.15, 2.3), Surface.CARGO, kind),
            _block((-7.9, 4.2), (-y, y), (2.3, 3.6), Surface.CARGO, kind, (0.15, 0.15, 0.6)),
            _block((5.0, 7.6), (-y + 0.05, y - 0.05), (0.5, 1.9), Surface.PAINT, kind),
            _block((5.0, 7.6), (-y + 0.05, y - 0.05), (1.9, 3.1), Surface.CABIN, kind, (0.2, 0.0, 0.05)),
            *_lamps(7.6, y - 0.12, (0.8, 1.0), kind),
            *wheels,
        ],
    )


def person() -> Model:
    """A pedestrian."""
    kind = Kind.PERSON
    limbs = [
        _block((-0.10, 0.08), (s - 0.07, s + 0.07), (0.0, 0.86), Surface.CLOTH, kind) for s in (-0.11, 0.11)
    ]
    arms = [
        _block((-0.06, 0.06), (s - 0.05, s + 0.05), (0.82, 1.42), Surface.CLOTH, kind) for s in (-0.28, 0.28)
    ]
    return _model(
        "person",
        [
            *limbs,
            *arms,
            _block((-0.13, 0.13), (-0.22, 0.22), (0.82, 1.48), Surface.CLOTH, kind, (0.03, 0.03, 0.03)),
            _round(Form.ELLIPSOID, (0.02, 0.0, 1.63), (0.11, 0.09, 0.14), Surface.SKIN, kind),
        ],
    )


def cyclist() -> Model:
    """A cyclist."""
    kind = Kind.CYCLIST
    wheels = [
        _round(Form.AXLE, (x, 0.0, 0.34), (0.34, 0.025, 0.34), Surface.RUBBER, kind) for x in (0.52, -0.52)
    ]
    legs = [
        _block((-0.12, 0.12), (s - 0.06, s + 0.06), (0.35, 0.98), Surface.CLOTH, kind) for s in (-0.11, 0.11)
    ]
    return _model(
        "cyclist",
        [
            *wheels,
            *legs,
            _block((-0.50, 0.50), (-0.03, 0.03), (0.52, 0.60), Surface.STEEL, kind),
            _block((0.42, 0.52), (-0.27, 0.27), (0.98, 1.04), Surface.STEEL, kind),
            _block((-0.20, 0.30), (-0.20, 0.20), (0.95, 1.52), Surface.CLOTH, kind, (0.05, 0.25, 0.03)),
            _round(Form.ELLIPSOID, (0.24, 0.0, 1.66), (0.12, 0.10, 0.14), Surface.SKIN, kind),
        ],
    )


def tree(name: str, rng: np.random.Generator, height: float, reach: float) -> Model:
    """A trunk, limbs, and a crown of a few overlapping volumes with gaps between the leaves."""
    clear, girth = 0.30 * height, 0.022 * height * rng.uniform(0.75, 1.1)
    crown_top, middle = 0.5 * (height - clear), 0.5 * (height + clear)
    rows = [
        _round(
            Form.UPRIGHT,
            (0, 0, 0.5 * middle - 0.2),
            (girth, girth, 0.5 * middle + 0.2),
            Surface.BARK,
            Kind.TRUNK,
        )
    ]
    leaves = (float(rng.uniform(0.42, 0.54)), 0.30)
    rows.append(
        _round(
            Form.ELLIPSOID,
            (0, 0, middle),
            (0.8 * reach, 0.8 * reach, crown_top),
            Surface.LEAVES,
            Kind.FOLIAGE,
            leaves,
        )
    )
    for k in range(4):
        angle = 2 * np.pi * (k + rng.uniform(-0.3, 0.3)) / 4
        out, size = reach * rng.uniform(0.35, 0.5), reach * rng.uniform(0.45, 0.6)
        centre = (out * np.cos(angle), out * np.sin(angle), middle + rng.uniform(-0.45, 0.25) * crown_top)
        rows.append(
            _round(Form.ELLIPSOID, centre, (size, size, 0.8 * size), Surface.LEAVES, Kind.FOLIAGE, leaves)
        )
    return _model(name, rows)


def bush(reach: float) -> Model:
    """A low shrub."""
    half = (reach, reach, 0.75 * reach)
    return _model(
        "bush",
        [_round(Form.ELLIPSOID, (0, 0, 0.6 * reach), half, Surface.LEAVES, Kind.FOLIAGE, (0.75, 0.22))],
    )


def hedge(length: float, height: float) -> Model:
    """A clipped hedge along x."""
    return _model(
        "hedge",
        [
            _block(
                (-0.5 * length, 0.5 * length),
                (0.0, 0.8),
                (-0.2, height),
                Surface.LEAVES,
                Kind.FOLIAGE,
                (0.05, 0.05, 0.06),
                (0.9, 0.20),
            )
        ],
    )


def wall(length: float, height: float) -> Model:
    """A garden wall along x with a coping."""
    x = 0.5 * length
    return _model(
        "wall",
        [
            _block((-x, x), (0.0, 0.24), (-1.0, height), Surface.WALL, Kind.WALL),
            _block((-x, x), (-0.04, 0.28), (height, height + 0.07), Surface.STONE, Kind.WALL),
        ],
    )


def fence(length: float, height: float) -> Model:
    """A slatted fence along x with posts."""
    x = 0.5 * length
    rows = [_block((-x, x), (0.0, 0.04), (0.05, height), Surface.FENCE, Kind.FENCE)]
    for k in range(max(2, round(length / 2.4)) + 1):
        at = -x + k * length / max(2, round(length / 2.4))
        rows.append(
            _block((at - 0.05, at + 0.05), (0.0, 0.10), (-0.5, height + 0.06), Surface.STEEL, Kind.FENCE)
        )
    return _model("fence", rows)


def building(
    width: float, depth: float, storeys: int, gabled: bool, balconies: list[tuple[float, int]]
) -> Model:
    """A house along x whose front is the plane y = 0: plinth, cornice, roof, balconies (x, storey)."""
    x, height, kind = 0.5 * width, 1.0 + 3.1 * storeys, Kind.BUILDING
    rows = [
        _block((-x, x), (0.0, depth), (-2.0, height), Surface.FACADE, kind),
        _block((-x, x), (-0.07, 0.0), (-2.0, 0.75), Surface.STONE, kind),
        _block((-x, x), (-0.30, depth + 0.30), (height, height + 0.28), Surface.STONE, kind),
    ]
    if gabled:
        ridge = 0.5 * depth + 0.25
        rows.append(
            _block(
                (-x, x),
                (-0.25, depth + 0.25),
                (height + 0.28, height + 3.4),
                Surface.ROOF,
                kind,
                (0, 0, ridge - 0.1),
            )
        )
        rows.append(
            _block(
                (0.3 * x, 0.3 * x + 0.7),
                (0.6 * depth, 0.6 * depth + 0.6),
                (height, height + 4.2),
                Surface.STONE,
                kind,
            )
        )
    for at, storey in balconies:
        z = 1.0 + 3.1 * storey
        rows.append(_block((at - 1.3, at + 1.3), (-1.0, 0.0), (z - 0.18, z), Surface.STONE, kind))
        rows.append(_block((at - 1.3, at + 1.3), (-1.0, -0.95), (z, z + 0.95), Surface.STEEL, kind))
        for side in (at - 1.3, at + 1.25):
            rows.append(_block((side, side + 0.05), (-1.0, 0.0), (z, z + 0.95), Surface.STEEL, kind))
    return _model("building", rows)


def lamp_post() -> Model:
    """A street lamp that reaches over the road (towards -y)."""
    kind = Kind.POLE
    return _model(
        "lamp post",
        [
            _round(Form.UPRIGHT, (0, 0, 3.2), (0.075, 0.075, 3.6), Surface.STEEL, kind),
            _block((-0.04, 0.04), (-1.5, 0.0), (6.62, 6.70), Surface.STEEL, kind),
            _block((-0.12, 0.12), (-1.9, -1.2), (6.52, 6.64), Surface.STEEL, kind),
        ],
    )


def traffic_light() -> Model:
    """Signals on a pole; their faces look towards -x."""
    return _model(
        "traffic light",
        [
            _round(Form.UPRIGHT, (0, 0, 1.5), (0.06, 0.06, 2.0), Surface.STEEL, Kind.POLE),
            _block((-0.17, 0.17), (-0.15, 0.15), (2.5, 3.45), Surface.LIGHT, Kind.LIGHT),
        ],
    )


def sign() -> Model:
    """A traffic sign on a post; its face looks towards -x."""
    return _model(
        "sign",
        [
            _round(Form.UPRIGHT, (0, 0, 1.2), (0.035, 0.035, 1.7), Surface.STEEL, Kind.POLE),
            _block((-0.05, -0.035), (-0.30, 0.30), (2.15, 2.75), Surface.SIGN, Kind.SIGN),
        ],
    )


def bollard() -> Model:
    """A short post."""
    return _model("bollard", [_round(Form.UPRIGHT, (0, 0, 0.3), (0.05, 0.05, 0.7), Surface.STEEL, Kind.POLE)])


def container() -> Model:
    """A skip for rubble that stands in the parking lane."""
    return _model("container", [_block((-1.7, 1.7), (-0.9, 0.9), (0.1, 1.6), Surface.STEEL, Kind.CONTAINER)])


def oriel(width: float, depth: float, height: float) -> Model:
    """A part of a house that comes forward above the ground floor, up to this height; its house's front is y = 0."""
    x = 0.5 * width
    return _model("oriel", [_block((-x, x), (-depth, 0.0), (3.3, height), Surface.FACADE, Kind.BUILDING)])


def cars() -> list[Model]:
    """The vehicles of the town: the first four are common, the last two are not."""
    return [
        car("hatchback", 4.05, 1.76, 1.47, bonnet=0.92, boot=0.12),
        car("saloon", 4.65, 1.82, 1.44, bonnet=1.15, boot=0.72),
        car("estate", 4.60, 1.80, 1.50, bonnet=1.12, boot=0.14),
        car("compact", 3.62, 1.66, 1.50, bonnet=0.72, boot=0.10),
        van(),
        truck(),
    ]
