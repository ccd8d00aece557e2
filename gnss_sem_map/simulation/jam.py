"""Slow traffic: the recording vehicle in a queue that stops and goes, another queue beside it, and tankers."""

from dataclasses import replace

import numpy as np
from scipy.interpolate import PchipInterpolator

from factor_graphs.simulation import Motion, follow
from gnss_sem_map.simulation import models
from gnss_sem_map.simulation.compiled import Floats
from gnss_sem_map.simulation.streets import lane_path
from gnss_sem_map.simulation.town import CAR_COLOURS, Thing, Town
from gnss_sem_map.simulation.traffic import (
    EARLY_S,
    IMU_HEIGHT_M,
    Crowd,
    Path,
    on_foot,
    own_path,
    path_of,
    start_and_line,
    towards_us,
)
from gnss_sem_map.simulation.world import Mover

_FASTEST = 1.0, 2.7  # m/s, of one go
_GO_S, _STAND_S = (3.0, 9.0), (1.5, 5.0)
_LATER_S = 1.1  # who follows goes so much later, and so never comes nearer
_GAP_M = 2.0, 4.0  # between bumpers
_BEHIND, _AHEAD, _BESIDE = 2, 4, 9  # vehicles
_TANKER, _SHORT_GO = 1, 3  # places in the queue beside: the first goes far, the other one metres only
_SHORT_GO_M = 3.7
_LEAST_OFF_M = 2.8  # of the middle of a parked vehicle, from that of a lane
_ROOM_M = 60.0  # and more, that a street is longer for those who leave it


def drive_through_jam(town: Town, seconds: float, day: int) -> tuple[Town, Motion, list[Mover]]:
    """The town, the recording vehicle's exact motion in slow traffic, and all other movers.

    The queue of the recording vehicle and the one that comes towards it stop and go, one vehicle after the
    other. One vehicle of the other queue is a tanker that passes close by. Another one goes 3.7 m and then stands, and
    so do those behind it.
    """
    rng = np.random.default_rng([day, 8])
    tanker = len(town.models)
    town = replace(town, models=[*town.models, models.tanker()])
    own, beside = own_path(town), _path_beside(town)
    town = replace(town, things=[thing for thing in town.things if _leaves_room(town, thing, beside)])
    start, line = start_and_line(town, own)
    knots = _stop_and_go(seconds, rng)
    ego = _along(own, start, knots, IMU_HEIGHT_M)
    crowd = Crowd(town, ego, seconds)
    kinds = [tanker, 1, 4, 0] if rng.random() < 0.5 else [4, 0, tanker, 3]
    at, half = start, 2.2
    for k, model in enumerate(kinds[:_AHEAD], 1):
        at, half = _next(town, model, at, half, rng)
        if at > line + 10.0:
            break
        crowd.admit("queues ahead", model, CAR_COLOURS[k], _in_queue(own, at, knots, -k))
    at, half = start, 2.2
    for k in range(1, _BEHIND + 1):
        at, half = _next(town, k, at, half, rng, -1.0)
        crowd.admit("queues behind", k, CAR_COLOURS[k + 4], _in_queue(own, at, knots, k))
    _queue_beside(crowd, beside, ego.poses([0.5 * seconds])[0, :3, 3], tanker, seconds, rng)
    on_foot(town, crowd, seconds, rng, 1)
    return town, ego, crowd.movers


def _queue_beside(
    crowd: Crowd, path: Path, here: Floats, tanker: int, seconds: float, rng: np.random.Generator
) -> None:
    """The queue towards the recording vehicle; the tanker in it begins behind the place `here` and passes it."""
    knots = _stop_and_go(seconds, rng)
    at, half = path.nearest(here) + 8.0, 2.2
    for k in range(_BESIDE):
        model = tanker if k == _TANKER else int(rng.integers(0, 6))
        at, half = _next(crowd.town, model, at, half, rng, -1.0)
        if at < half:
            break
        if k == _SHORT_GO:
            knots = _later(_first_metres(_later(knots, k * _LATER_S), _SHORT_GO_M), -k * _LATER_S)
        name = "goes 3.7 m" if k >= _SHORT_GO else "tanker" if k == _TANKER else "queues beside"
        crowd.admit(name, model, CAR_COLOURS[k], _in_queue(path, at, knots, k))


def _path_beside(town: Town) -> Path:
    """The path of the queue towards the recording vehicle."""
    lane = lane_path(town.streets, towards_us(town))
    beyond = lane[-1] + (lane[-1] - lane[-2]) * np.arange(1, _ROOM_M)[:, None]
    return path_of(town, np.concatenate([lane, beyond]))


def _leaves_room(town: Town, thing: Thing, path: Path) -> bool:
    """Whether a tanker may pass: a parked vehicle is not in its way."""
    off = np.linalg.norm(path.points[:, :2] - town.place(thing)[:2], axis=1)
    return not thing.is_vehicle or bool(off.min() > _LEAST_OFF_M)


def _next(
    town: Town, model: int, at: float, half: float, rng: np.random.Generator, ahead: float = 1.0
) -> tuple[float, float]:
    """Where the middle of the next vehicle of a queue is, m, and half of its length."""
    bounds = town.models[model].bounds
    length = float(bounds[3] - bounds[0])
    return at + ahead * (half + float(rng.uniform(*_GAP_M)) + length / 2), length / 2


def _stop_and_go(seconds: float, rng: np.random.Generator) -> Floats:
    """Stamps and speeds (k, 2) of somebody who stands, goes, and stands again."""
    knots, now = [(-60.0, 0.0)], -20.0 + float(rng.uniform(0.0, 5.0))
    while now < seconds + 5.0:
        go, speed = float(rng.uniform(*_GO_S)), float(rng.uniform(*_FASTEST))
        slower = speed * float(rng.uniform(0.3, 1.0))
        knots += [(now, 0.0), (now + 0.3 * go, speed), (now + 0.7 * go, slower), (now + go, 0.0)]
        now += go + float(rng.uniform(*_STAND_S))
    return np.array([*knots, (now + 60.0, 0.0)])


def _later(knots: Floats, seconds: float) -> Floats:
    return np.asarray(knots + np.array([seconds, 0.0]))


def _first_metres(knots: Floats, metres: float) -> Floats:
    """The same until it has gone so far since the drive began; then it stands. It stands before, too."""
    begins = np.arange(1, len(knots) - 1, 4)
    first = begins[knots[begins, 0] > 0][0]
    goes = knots[first : first + 4].copy()
    way = np.sum(np.diff(goes[:, 0]) * (goes[1:, 1] + goes[:-1, 1]) / 2)
    goes[:, 1] *= metres / way
    return np.concatenate([[(-60.0, 0.0)], goes, [(knots[-1, 0], 0.0)]])


def _in_queue(path: Path, at: float, knots: Floats, place: int) -> Motion:
    """The motion of the vehicle of this place behind the first, which would stand at `at` m if all stood."""
    mine = _later(knots, place * _LATER_S)
    ways = [float(PchipInterpolator(*some.T).integrate(some[0, 0], -EARLY_S)) for some in (mine, knots)]
    return _along(path, at + ways[0] - ways[1], mine)


def _along(path: Path, start: float, knots: Floats, lift: float = 0.0) -> Motion:
    """The motion along a path that is at `start` m when the drive begins."""
    until = np.searchsorted(knots[:, 0], -EARLY_S)
    speed = np.interp(-EARLY_S, *knots.T)
    mine = np.concatenate([[(-EARLY_S, speed)], knots[until:]])
    return follow(path.beyond(start) + np.array([0.0, 0.0, lift]), *mine.T)
