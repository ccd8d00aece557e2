"""The same town on other days: which parked cars came and went, what was built and what was torn down."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from gnss_sem_map.simulation import models
from gnss_sem_map.simulation.compiled import Floats
from gnss_sem_map.simulation.ground import inside_block
from gnss_sem_map.simulation.models import Model
from gnss_sem_map.simulation.shapes import SHAPE_COLUMNS
from gnss_sem_map.simulation.streets import Side, sides
from gnss_sem_map.simulation.surfaces import RAW_IDS, Surface
from gnss_sem_map.simulation.town import GREY, SIGN, Builder, Colour, Thing, Town, build_town

_LEAVE = 0.3  # share of the cars at the kerb and on the sidewalk
_TAKEN_DOWN = {"sign": 0.25, "bollard": 0.1, "wall": 0.1, "fence": 0.1}
_CARS, _SIGNS = 3, 0.4  # that come to each kerb, where there is room
_YELLOW: Colour = (0.62, 0.35, 0.08)


@dataclass(frozen=True, eq=False)
class Change:
    """An object that stands in one session and not in another one, as a box of the simulation's own axes."""

    appeared: bool
    cause: Literal["parked", "built"]
    name: str
    labels: tuple[int, ...]
    """SemanticKITTI ids of its parts."""
    centre: Floats
    """(3,) m"""
    yaw: float
    """Of its length, rad from east."""
    size: Floats
    """(3,) m, length, width, height above the ground."""


def changes_between(seed: int, before: int, after: int) -> list[Change]:
    """What another session of the same seed shows that one does not, and the reverse, in the whole town."""
    town = build_town(seed)
    return changes(session_of(town, seed, before), session_of(town, seed, after))


def changes(before: Town, after: Town) -> list[Change]:
    """What vanished, then what appeared, from one session's town to another one's."""
    there, here = _objects(before), _objects(after)
    gone = [_change(before, thing, appeared=False) for key, thing in there.items() if key not in here]
    return gone + [_change(after, thing, appeared=True) for key, thing in here.items() if key not in there]


def _objects(town: Town) -> dict[tuple[str, float, float, float], Thing]:
    return {
        (town.models[thing.model].name, thing.u, thing.v, thing.heading): thing
        for thing in town.things
        if len(town.models[thing.model].shapes)
    }


def _change(town: Town, thing: Thing, appeared: bool) -> Change:
    model, (x, y, z, yaw, _, _) = town.models[thing.model], town.place(thing)
    low, high = model.bounds[:3].copy(), model.bounds[3:]
    low[2] = max(low[2], 0.0)  # what is in the ground is not seen
    along, across, up = 0.5 * (low + high)
    c, s = np.cos(yaw), np.sin(yaw)
    centre = np.array([x + c * along - s * across, y + s * along + c * across, z + up])
    labels = tuple(np.unique(RAW_IDS[0, model.shapes[:, 13].astype(int)]).tolist())
    cause: Literal["parked", "built"] = "parked" if thing.is_vehicle else "built"
    return Change(
        appeared, cause, model.name, labels, centre, float((yaw + np.pi) % (2 * np.pi) - np.pi), high - low
    )


def session_of(town: Town, seed: int, session: int) -> Town:
    """The town of a session; that of session 0 is the town of the seed itself.

    What is gone leaves a thing without shapes, and what is new comes last: the leaves of a tree and the windows of a
    house are drawn from its place in the list. Cars in bays stay.
    """
    if session == 0:
        return town
    builder = Builder(np.random.default_rng([seed, 7, session]), list(town.models), [], list(town.things))
    taken = [_footprint(town, thing) for thing in town.things if _is_at_kerb(town, thing)]
    _clear(builder, town)
    smooth = [thing for thing in town.things if _is_smooth(town.models[thing.model])]
    container, kerbs = builder.model(models.container()), sides(town.streets, town.ground)
    for street in zip(kerbs[::2], kerbs[1::2], strict=True):
        any(_stand(builder, side, container, _YELLOW, taken) for side in street)  # one of the two
        _extend(builder, street, smooth, taken)
        for side in street:
            _line(builder, side, taken)
    return replace(town, models=builder.models, things=builder.things)


def _is_at_kerb(town: Town, thing: Thing) -> bool:
    return inside_block(town.ground, thing.u, thing.v)[0] < 0.9 * town.streets.sidewalk_width


def _footprint(town: Town, thing: Thing) -> Floats:
    """Where it stands, and half its length and width: (4,) m; of a tree or a lamp, what is on the ground."""
    half = town.models[thing.model].bounds[3:]
    return np.array([thing.u, thing.v, *(half[:2] if half[2] < 4.0 else (0.3, 0.3))])


def _clear(builder: Builder, town: Town) -> None:
    """Take away cars, signs, bollards, walls and fences."""
    nothing = builder.model(Model("nothing", np.empty((0, SHAPE_COLUMNS))))
    for k, (thing, chance) in enumerate(zip(town.things, builder.rng.random(len(town.things)), strict=True)):
        share = _TAKEN_DOWN.get(town.models[thing.model].name, 0.0)
        if thing.is_vehicle and _is_at_kerb(town, thing):
            share = _LEAVE
        if chance < share:
            builder.things[k] = replace(thing, model=nothing, is_vehicle=False)


def _line(builder: Builder, side: Side, taken: list[Floats]) -> None:
    """Put cars and a sign along one kerb."""
    rng = builder.rng
    for model in rng.integers(0, 5, _CARS).tolist():
        along, depth = _room(builder, side, model, taken)
        if along > 0.0:
            builder.park(side, along, depth, np.pi if rng.random() < 0.85 else 0.0, model)
    if rng.random() < _SIGNS:
        _stand(builder, side, SIGN, GREY, taken)


def _stand(builder: Builder, side: Side, model: int, colour: Colour, taken: list[Floats]) -> bool:
    """Put something up at a kerb; whether there is room for it."""
    along, depth = _room(builder, side, model, taken)
    if along > 0.0:
        builder.put(side, model, along, depth, colour, np.pi)
    return along > 0.0


def _room(builder: Builder, side: Side, model: int, taken: list[Floats]) -> tuple[float, float]:
    """A place along a kerb and behind it where nothing stands and nothing stood in session 0; (0, 0) if none is found.

    It is taken from then on.
    """
    length, width = builder.models[model].bounds[3:5].tolist()
    depth = 0.45 if model == SIGN else -width - 0.06
    for along in builder.rng.uniform(10.0, side.length - 12.0, 20).tolist():
        place = side.at(along, depth)
        if _is_free(side, place, length, width, taken):
            taken.append(np.array([*place, length, width]))
            return along, depth
    return 0.0, 0.0


def _is_free(side: Side, place: Floats, length: float, width: float, taken: list[Floats]) -> bool:
    """Whether something of this half length along the kerb and half width has room there."""
    others = np.array(taken)
    gap_along = np.abs((others[:, :2] - place) @ side.along) - others[:, 2] - length
    gap_across = np.abs((others[:, :2] - place) @ side.inwards) - others[:, 3] - width
    return bool(np.all((gap_along > 0.5) | (gap_across > 0.1)))


def _extend(builder: Builder, street: tuple[Side, Side], houses: list[Thing], taken: list[Floats]) -> None:
    """Give one of the houses along a street an oriel, where no lamp stands before it."""
    rng, candidates = builder.rng, []
    for side in street:
        for house in houses:
            place, half = np.array([house.u, house.v]), float(builder.models[house.model].bounds[3])
            along, depth = (place - side.corner) @ side.along, (place - side.corner) @ side.inwards
            faces = house.heading == side.heading and 0.0 < along < side.length and 0.0 < depth < 9.0
            if faces and _is_free(side, place, 0.6 * half, 0.5, taken):
                candidates.append(house)
    if candidates:
        house = candidates[int(rng.integers(len(candidates)))]
        model = builder.models[house.model]
        width, depth = rng.uniform([2.5, 0.8], [1.2 * model.bounds[3], 1.2]).tolist()
        oriel = models.oriel(width, depth, _eaves(model) - 0.4)
        builder.things.append(replace(house, model=builder.model(oriel)))


def _is_smooth(model: Model) -> bool:
    """Whether it is a house of two storeys or more without balconies."""
    has_balconies = bool(np.any(model.shapes[:, 12] == Surface.STEEL))
    return model.name == "building" and not has_balconies and _eaves(model) > 6.0


def _eaves(model: Model) -> float:
    """How high the facade of a house is, m."""
    return float(model.shapes[0, 2] + model.shapes[0, 5])
