"""A town from a seed: ground, houses, walls, fences, hedges, trees, lamps, signs, and parked cars."""

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from gnss_sem_map.simulation import models
from gnss_sem_map.simulation.compiled import Floats
from gnss_sem_map.simulation.ground import Ground, ground_height, height_gradient
from gnss_sem_map.simulation.models import Model
from gnss_sem_map.simulation.streets import Node, Side, Streets, lay_streets, random_route, sides
from gnss_sem_map.simulation.surfaces import Surface

Colour = tuple[float, float, float]

CAR_COLOURS: list[Colour] = [
    (0.82, 0.83, 0.84), (0.55, 0.57, 0.60), (0.10, 0.10, 0.11), (0.20, 0.22, 0.25), (0.05, 0.10, 0.28),
    (0.45, 0.05, 0.05), (0.32, 0.38, 0.42), (0.88, 0.88, 0.86), (0.08, 0.22, 0.16), (0.62, 0.55, 0.42),
]  # fmt: skip
_FACADES: list[Colour] = [
    (0.72, 0.66, 0.54), (0.68, 0.55, 0.44), (0.62, 0.61, 0.58), (0.76, 0.73, 0.66), (0.58, 0.36, 0.28),
    (0.74, 0.66, 0.42), (0.56, 0.58, 0.60), (0.70, 0.58, 0.52),
]  # fmt: skip
_GREENS: list[Colour] = [
    (0.20, 0.32, 0.09),
    (0.25, 0.35, 0.10),
    (0.16, 0.28, 0.10),
    (0.30, 0.34, 0.11),
    (0.36, 0.30, 0.10),
]
GREY: Colour = (0.30, 0.31, 0.32)
_LOT_DEPTH_M = 14.0


@dataclass(frozen=True)
class Thing:
    """Static thing of the town: model number, position in town axes, heading from u, colour, vehicle or not."""

    model: int
    u: float
    v: float
    heading: float
    colour: Colour
    is_vehicle: bool = False


@dataclass(frozen=True, eq=False)
class Town:
    """All static things, and the route of the drive."""

    streets: Streets
    route: list[Node]
    ground: Ground
    models: list[Model]
    things: list[Thing]

    def to_map(self, uv: Floats) -> Floats:
        """Map coordinates (k, 3) of points on the ground, from town coordinates (k, 2)."""
        c, s = self.ground.heading
        xy = np.atleast_2d(uv) @ np.array([[c, s], [-s, c]]) + self.ground.origin
        return np.column_stack([xy, [ground_height(self.ground, x, y) for x, y in xy]])

    def place(self, thing: Thing) -> Floats:
        """x, y, z, yaw, and the shear that lets a vehicle stand on a slope: (6,)."""
        ((x, y, z),) = self.to_map(np.array([[thing.u, thing.v]]))
        yaw = thing.heading + np.arctan2(self.ground.heading[1], self.ground.heading[0])
        gx, gy = height_gradient(self.ground, x, y) if thing.is_vehicle else (0.0, 0.0)
        c, s = np.cos(yaw), np.sin(yaw)
        return np.array([x, y, z, yaw, c * gx + s * gy, c * gy - s * gx])


@dataclass(eq=False)
class Builder:
    """State of the construction of a town."""

    rng: np.random.Generator
    models: list[Model]
    trees: list[int]
    things: list[Thing] = field(default_factory=list)
    patches: list[tuple[int, list[float]]] = field(default_factory=list)

    def model(self, model: Model) -> int:
        self.models.append(model)
        return len(self.models) - 1

    def pick(self, colours: list[Colour]) -> Colour:
        base = np.array(colours[int(self.rng.integers(len(colours)))])
        r, g, b = np.clip(
            base * self.rng.uniform(0.88, 1.12) + self.rng.uniform(-0.015, 0.015, 3), 0.02, 0.95
        )
        return float(r), float(g), float(b)

    def put(
        self, side: Side, model: int, along: float, depth: float, colour: Colour, turn: float = 0.0
    ) -> None:
        u, v = side.at(along, depth)
        self.things.append(Thing(model, float(u), float(v), side.heading + turn, colour))

    def park(self, side: Side, along: float, depth: float, turn: float, model: int | None = None) -> None:
        u, v = side.at(along, depth)
        if model is None:
            model = int(self.rng.choice(5, p=[0.33, 0.22, 0.2, 0.15, 0.1]))
        heading = side.heading + turn + self.rng.normal(0.0, 0.012)
        self.things.append(Thing(model, float(u), float(v), heading, self.pick(CAR_COLOURS), True))

    def tree(self, side: Side, along: float, depth: float) -> None:
        model = self.trees[int(self.rng.integers(len(self.trees)))]
        self.put(side, model, along, depth, self.pick(_GREENS), self.rng.uniform(0, 2 * np.pi))


def build_town(seed: int, crossings: int = 3) -> Town:
    """The town of a seed, with a route over this many crossings.

    The map's origin lies on the first street, 56 m before the first crossing, where the drive begins.
    """
    rng = np.random.default_rng([seed, 1])
    streets = lay_streets(rng)
    route = random_route(streets, crossings, np.random.default_rng([seed, 3]))
    bare = _ground(streets, route, rng)
    builder = Builder(rng, [*models.cars(), models.lamp_post(), models.traffic_light(), models.sign()], [])
    builder.models += [models.bollard(), models.person(), models.cyclist()]
    for k in range(7):
        height, reach = rng.uniform(4.4, 8.5), rng.uniform(2.2, 3.1)
        builder.trees.append(builder.model(models.tree(f"tree {k}", rng, height, reach)))
    plan = _plan(route)
    for side in sides(streets, bare):
        parking, lots = plan.get((side.street, bool(side.along.sum() > 0)), ("", []))
        _line_with_lots(builder, side, bare, list(lots))
        chosen = parking or str(rng.choice(_PARKING, p=[0.42, 0.2, 0.18, 0.2]))
        _furnish(builder, side, chosen, bool(parking) or rng.random() < 0.6)
    _signals(builder, streets)
    start, rows = _patch_table(streets, builder.patches)
    ground = bare._replace(patch_start=start, patches=rows)
    return Town(streets, route, ground, builder.models, builder.things)


LAMP_POST, TRAFFIC_LIGHT, SIGN, BOLLARD, PERSON, CYCLIST = range(6, 12)
_PARKING = ["kerb", "tight", "sidewalk", "none"]


def _ground(streets: Streets, route: list[Node], rng: np.random.Generator) -> Ground:
    angle = rng.uniform(-np.pi, np.pi)
    heading = (float(np.cos(angle)), float(np.sin(angle)))
    a, b = streets.position(route[0]), streets.position(route[1])
    u, v = b + 56.0 * (a - b) / np.linalg.norm(a - b)
    origin = float(heading[1] * v - heading[0] * u), float(-heading[1] * u - heading[0] * v)
    a1, a2 = (float(a) for a in rng.uniform(-0.012, 0.012, 2))
    q1, q2, q3 = (float(q) for q in rng.uniform(-1.2e-4, 1.2e-4, 3))
    return Ground(
        origin, heading, (a1, a2), (q1, q2, q3),
        np.column_stack([streets.u, streets.half_u]), np.column_stack([streets.v, streets.half_v]),
        streets.corner_radius, streets.kerb_height, streets.sidewalk_width, *_patch_table(streets, []),
    )  # fmt: skip


def _patch_table(
    streets: Streets, patches: list[tuple[int, list[float]]]
) -> tuple[npt.NDArray[np.int32], Floats]:
    """Patches sorted by block, and where each block's begin."""
    blocks = (len(streets.u) + 1) * (len(streets.v) + 1)
    ordered = sorted(patches, key=lambda patch: patch[0])
    start = np.searchsorted([block for block, _ in ordered], np.arange(blocks + 1)).astype(np.int32)
    return start, np.array([row for _, row in ordered], float).reshape(-1, 5)


def _plan(route: list[Node]) -> dict[tuple[tuple[Node, Node], bool], tuple[str, list[str]]]:
    """Required content of the first streets of the route: (street, kerb) -> parking and first lots.

    A row of cars bumper to bumper, cars on the sidewalk, parking bays, and trees that stand against walls.
    """
    wanted = [
        [
            ("tight", ["hedge garden", "wall garden", "house"]),
            ("sidewalk", ["house", "fence garden", "hedge garden"]),
        ],
        [("kerb", ["wall garden", "court", "house"]), ("tight", ["house", "hedge garden", "house"])],
        [("tight", ["court", "house", "wall garden"]), ("kerb", ["hedge garden", "park", "house"])],
    ]
    plan = {}
    for a, b, kerbs in zip(route[:-1], route[1:], wanted, strict=False):
        low, high = sorted([a, b])
        for up, kerb in zip((True, False), kerbs, strict=True):
            plan[(low, high), up] = kerb
    return plan


def _line_with_lots(builder: Builder, side: Side, ground: Ground, first: list[str]) -> None:
    """Houses, gardens, parks and parking areas behind the sidewalk, side by side."""
    rng, w = builder.rng, ground.sidewalk_width
    along, end = (w, side.length - w) if side.deep else (w + _LOT_DEPTH_M, side.length - w - _LOT_DEPTH_M)
    while end - along > 7.0:
        names = ["house", "wall garden", "fence garden", "hedge garden", "park", "court"]
        name = first.pop(0) if first else str(rng.choice(names, p=[0.5, 0.13, 0.09, 0.10, 0.09, 0.09]))
        width = min(float(rng.uniform(10.0, 17.0)), end - along)
        if end - along - width < 7.0:
            width = end - along
        if name == "house":
            _house(builder, side, along, width, w)
        elif name == "park":
            _park(builder, side, along, width, w)
        elif name == "court":
            _court(builder, side, along, width, w)
        else:
            _garden(builder, side, along, width, w, name.split()[0])
        along += width


def _house(builder: Builder, side: Side, along: float, width: float, depth: float) -> None:
    rng = builder.rng
    storeys, reach = int(rng.integers(2, 5)), float(rng.uniform(8.5, 10.5))
    balconies = [
        (float(x), s)
        for s in range(1, storeys)
        for x in np.arange(-width / 2 + 2.5, width / 2 - 2.4, 4.8)
        if rng.random() < 0.25
    ]
    model = builder.model(models.building(width, reach, storeys, bool(rng.random() < 0.75), balconies))
    builder.put(side, model, along + width / 2, depth, builder.pick(_FACADES))


def _garden(builder: Builder, side: Side, along: float, width: float, depth: float, edge: str) -> None:
    """A house behind a front garden, with a wall, fence or hedge to the street and trees that touch it."""
    rng, middle = builder.rng, along + width / 2
    setback = float(rng.uniform(3.6, 4.8))
    edges = {"wall": models.wall, "fence": models.fence, "hedge": models.hedge}
    model = builder.model(edges[edge](width, float(rng.uniform(1.1, 1.9))))
    builder.put(side, model, middle, depth, builder.pick(_FACADES if edge == "wall" else _GREENS))
    storeys = int(rng.integers(1, 3))
    model = builder.model(models.building(width - 2.0, 8.5, storeys, True, []))
    builder.put(side, model, middle, depth + setback, builder.pick(_FACADES))
    for at in np.arange(along + 2.0, along + width - 1.5, 4.5):
        builder.tree(side, float(at + rng.uniform(-0.6, 0.6)), depth + float(rng.uniform(0.9, 1.5)))
    bush = builder.model(models.bush(float(rng.uniform(0.5, 0.9))))
    for at in rng.uniform(along + 1, along + width - 1, 2):
        builder.put(side, bush, float(at), depth + setback - 0.7, builder.pick(_GREENS))


def _park(builder: Builder, side: Side, along: float, width: float, depth: float) -> None:
    rng = builder.rng
    for _ in range(int(width / 3)):
        builder.tree(
            side, along + float(rng.uniform(1.5, width - 1.5)), depth + float(rng.uniform(1.5, 11.0))
        )
    bush = builder.model(models.bush(float(rng.uniform(0.6, 1.1))))
    for _ in range(4):
        at, inwards = rng.uniform(1, width - 1), rng.uniform(0.8, 10.0)
        builder.put(side, bush, along + float(at), depth + float(inwards), builder.pick(_GREENS))


def _court(builder: Builder, side: Side, along: float, width: float, depth: float) -> None:
    """Parking bays across the street's direction in front of a wall with trees."""
    rng = builder.rng
    a, b = side.at(along, depth), side.at(along + width, depth + 6.2)
    low, high = np.minimum(a, b), np.maximum(a, b)
    builder.patches.append((side.block, [low[0], high[0], low[1], high[1], float(Surface.PARKING)]))
    for at in np.arange(along + 1.6, along + width - 1.3, 2.45):
        if rng.random() < 0.92:
            turn = np.pi / 2 if rng.random() < 0.7 else -np.pi / 2
            builder.park(
                side, float(at), depth + 3.2 + float(rng.normal(0, 0.15)), turn, int(rng.integers(0, 4))
            )
    model = builder.model(models.wall(width, 1.8))
    builder.put(side, model, along + width / 2, depth + 6.4, builder.pick(_FACADES))
    for at in np.arange(along + 2.5, along + width - 2.0, 5.0):
        builder.tree(side, float(at), depth + 7.6)


def _furnish(builder: Builder, side: Side, parking: str, trees: bool) -> None:
    """Things along one kerb: parked cars, trees, lamps, signs, bollards."""
    rng = builder.rng
    if parking != "none":
        _park_row(builder, side, on_sidewalk=parking == "sidewalk", tight=parking == "tight")
    if parking != "sidewalk" and trees:
        for at in np.arange(9.0 + rng.uniform(0, 3), side.length - 8.0, rng.uniform(9.0, 13.0)):
            builder.tree(side, float(at), 0.85)
    depth = 2.85 if parking == "sidewalk" else 0.45  # where the cars leave room for posts
    for at in np.arange(12.5, side.length - 6.0, 27.0):
        builder.put(side, LAMP_POST, float(at), depth, GREY)
    builder.put(side, SIGN, float(rng.uniform(9.0, side.length - 9.0)), depth, GREY, np.pi)
    if parking == "none":
        for at in np.arange(14.0, min(26.0, side.length - 12.0), 1.8):
            builder.put(side, BOLLARD, float(at), 0.35, GREY)


def _park_row(builder: Builder, side: Side, on_sidewalk: bool, tight: bool) -> None:
    """Cars along the kerb, most of them in the direction of the lane; `tight`: bumper to bumper."""
    rng = builder.rng
    shares = [0.35, 0.22, 0.2, 0.13, 0.1, 0.0] if on_sidewalk else [0.32, 0.22, 0.2, 0.13, 0.1, 0.03]
    along = 10.0 + float(rng.uniform(0, 2))
    while along < side.length - 15.0:
        if rng.random() < (0.94 if tight else 0.72):
            model = int(rng.choice(6, p=shares))
            bounds = builder.models[model].bounds
            depth = 1.05 if on_sidewalk else -float(bounds[4]) - 0.06
            builder.park(side, along - float(bounds[0]), depth, np.pi if rng.random() < 0.85 else 0.0, model)
            along += float(bounds[3] - bounds[0]) + float(
                rng.uniform(0.28, 0.42) if tight else rng.uniform(0.7, 2.2)
            )
        else:
            along += float(rng.uniform(3.0, 6.5))


def _signals(builder: Builder, streets: Streets) -> None:
    """A traffic light on the right before every crossing, for each of the four approaches."""
    for i, u in enumerate(streets.u):
        for j, v in enumerate(streets.v):
            hu, hv = streets.half_u[i], streets.half_v[j]
            approaches = [
                (u + hu + 0.6, v - hv - 7.6, np.pi / 2), (u - hu - 0.6, v + hv + 7.6, -np.pi / 2),
                (u - hu - 7.6, v - hv - 0.6, 0.0), (u + hu + 7.6, v + hv + 0.6, np.pi),
            ]  # fmt: skip
            for x, y, heading in approaches:
                builder.things.append(Thing(TRAFFIC_LIGHT, float(x), float(y), heading, GREY))
