"""Traffic: the recording vehicle on its route, and other moving objects without collisions."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.interpolate import CubicSpline

from factor_graphs.simulation import Motion, follow
from gnss_sem_map.simulation.compiled import Floats
from gnss_sem_map.simulation.streets import LANE_M, STOP_LINE_M, Node, lane_path, straight
from gnss_sem_map.simulation.town import CAR_COLOURS, CYCLIST, PERSON, Colour, Thing, Town
from gnss_sem_map.simulation.world import Mover

IMU_HEIGHT_M = 0.93
EARLY_S, LATE_S = 0.6, 1.0  # how long before and after the drive everybody's motion is known
_GREEN_S = 10.5  # when the light at the first crossing turns green
_START_M = 56.0  # how far before the first crossing the drive begins
_WEAVE_M, _WEAVE_EVERY_M = 0.2, 25.0
_GAIN, _BRAKE, _SIDEWAYS = 1.5, 1.8, 2.0  # m/s2
_CLOTHES: list[Colour] = [
    (0.5, 0.08, 0.08),
    (0.1, 0.2, 0.45),
    (0.75, 0.72, 0.66),
    (0.12, 0.3, 0.16),
    (0.7, 0.5, 0.1),
]


@dataclass(frozen=True, eq=False)
class Path:
    """A path on the ground of the map: points (k, 3) m and their arc length (k,) m."""

    points: Floats
    way: Floats

    def beyond(self, start: float) -> Floats:
        """The points from `start` metres on."""
        at = np.concatenate([[start], self.way[self.way > start + 0.3]])
        return np.column_stack([np.interp(at, self.way, c) for c in self.points.T])

    def nearest(self, point: Floats) -> float:
        """Arc length of the point of the path nearest to a position."""
        return float(self.way[np.argmin(((self.points[:, :2] - point[:2]) ** 2).sum(1))])


def path_of(town: Town, uv: Floats) -> Path:
    points = town.to_map(uv)
    return Path(points, np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))]))


def _profile(
    path: Path,
    start: float,
    speed: float,
    limit: float,
    stops: Sequence[tuple[float, float]],
    seconds: float,
) -> tuple[Floats, Floats]:
    """Stamps and speeds on a path with a speed limit, slower in curves, with stops (arc length, until stamp)."""
    way = np.arange(start, path.way[-1] - 0.5, 0.25)
    xy = np.column_stack([np.interp(way, path.way, c) for c in path.points[:, :2].T])
    course = np.unwrap(np.arctan2(*np.gradient(xy, axis=0).T[::-1]))
    bend = np.convolve(np.abs(np.gradient(course, way)), np.ones(9) / 9, mode="same")
    v = np.minimum(limit, np.sqrt(_SIDEWAYS / np.maximum(bend, 1e-4)))
    halts = {int(np.argmin(np.abs(way - at))): until for at, until in stops if at > start + 1.0}
    v[[*halts, len(v) - 1]] = 0.0
    v[0] = min(v[0], speed)
    for k in range(1, len(v)):
        v[k] = min(v[k], np.sqrt(v[k - 1] ** 2 + 0.5 * _GAIN))
    for k in range(len(v) - 2, -1, -1):
        v[k] = min(v[k], np.sqrt(v[k + 1] ** 2 + 0.5 * _BRAKE))
    stamps, speeds, now = [-EARLY_S], [float(v[0])], -EARLY_S
    for k in range(1, len(v)):
        now += 0.5 / max(v[k - 1] + v[k], 1e-3)
        stamps.append(now)
        speeds.append(float(v[k]))
        if k in halts:
            now = max(now + 0.8, halts[k])
            stamps.append(now)
            speeds.append(0.0)
        if now > seconds + LATE_S:
            break
    if now <= seconds + LATE_S:
        stamps.append(seconds + LATE_S + 1.0)
        speeds.append(0.0)
    return np.array(stamps), np.array(speeds)


def _drive(
    path: Path,
    seconds: float,
    *,
    start: float,
    speed: float,
    limit: float,
    stops: Sequence[tuple[float, float]] = (),
    lift: float = 0.0,
    suspension_deg: float = 0.0,
) -> Motion:
    stamps, speeds = _profile(path, start, speed, limit, stops, seconds)
    return follow(path.beyond(start) + np.array([0.0, 0.0, lift]), stamps, speeds, suspension_deg)


class Crowd:
    """Moving objects placed so far; a new one that would collide with them is refused."""

    def __init__(self, town: Town, ego: Motion, seconds: float) -> None:
        self.town, self.stamps = town, np.arange(-EARLY_S, seconds + 0.5, 0.2)
        self.discs = [self._discs(ego.poses(self.stamps), 2.3)]
        self.movers: list[Mover] = []

    @staticmethod
    def _discs(T: Floats, length: float) -> Floats:
        """Circles that cover an object at every stamp: (stamps, 3, 2) centres; all have a radius of about 1 m."""
        ahead = np.array([-0.5, 0.0, 0.5]) * length
        return np.asarray(T[:, None, :2, 3] + ahead[:, None] * T[:, None, :2, 0])

    def admit(self, name: str, model: int, colour: Colour, motion: Motion) -> bool:
        """Add an object if it does not collide with any other."""
        bounds = self.town.models[model].bounds
        mine, radius = (
            self._discs(motion.poses(self.stamps), 0.75 * (bounds[3] - bounds[0])),
            0.5 * bounds[4] + 0.15,
        )
        for other in self.discs:
            gap = np.linalg.norm(mine[:, :, None] - other[:, None, :], axis=-1).min()
            if gap < radius + 1.05:
                return False
        self.discs.append(mine)
        self.movers.append(Mover(name, model, colour, motion))
        return True


def lap_length(town: Town) -> float:
    """Length of one lap of a route around the block, m."""
    rest = replace(town, route=town.route[4:])
    return float(path_of(town, _own_lane(town)).way[-1] - path_of(town, _own_lane(rest)).way[-1])


def lap_seconds(town: Town, laps: int) -> float:
    """How long so many laps around the block take, in whole tenths of a second."""
    stamps = np.arange(0.0, 120.0 * laps, 0.1)
    way = _ride(town, own_path(town), 120.0 * laps).way(stamps)
    return round(float(stamps[np.searchsorted(way, laps * lap_length(town))]), 1)


def own_path(town: Town) -> Path:
    """The path of the recording vehicle, from one crossing before its route."""
    return path_of(town, _own_lane(town))


def _own_lane(town: Town) -> Floats:
    """The lane of the recording vehicle, (k, 2) in town axes, from one crossing before its route."""
    return lane_path(town.streets, [_before(town), *town.route])


def _before(town: Town) -> Node:
    a, b = town.route[:2]
    return 2 * a[0] - b[0], 2 * a[1] - b[1]


def _weaving(uv: Floats, rng: np.random.Generator) -> Floats:
    """A way as people drive it: some decimetres to the left and right of the lane's middle."""
    course = np.gradient(uv, axis=0)
    course /= np.linalg.norm(course, axis=1, keepdims=True)
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(uv, axis=0), axis=1))])
    knots = np.arange(0.0, way[-1] + 2 * _WEAVE_EVERY_M, _WEAVE_EVERY_M)
    aside = CubicSpline(knots, np.clip(rng.normal(0.0, _WEAVE_M, len(knots)), -0.4, 0.4))(way)
    return np.asarray(uv + aside[:, None] * course[:, ::-1] * [-1.0, 1.0])


def start_and_line(town: Town, own: Path) -> tuple[float, float]:
    """Where on its path the recording vehicle starts, and where the stop line of the first crossing is, m."""
    before = _before(town)
    first = own.nearest(town.to_map(town.streets.position(town.route[1])[None])[0])
    approach = _length(town, town.route[0], town.route[1])
    length = _length(town, before, town.route[0]) + approach
    start = length - _START_M
    line = length - town.streets.crossing_edge(town.route[0], town.route[1]) - STOP_LINE_M
    if not start < line < first + 20.0:
        raise ValueError(
            f"route {town.route[:2]}: the stop line at {line:.1f} m is not behind the start {start:.1f} m"
        )
    return start, line


def _ride(town: Town, own: Path, seconds: float) -> Motion:
    """The motion of the recording vehicle on its path."""
    start, line = start_and_line(town, own)
    cruise = {"speed": 7.0, "limit": 8.5}
    return _drive(
        own, seconds, start=start, stops=_stops(line - 10.2), lift=IMU_HEIGHT_M, suspension_deg=0.25, **cruise
    )


def drive_through(
    town: Town, seconds: float, day: int, *, laps: int = 1, weaves: bool = False
) -> tuple[Town, Motion, list[Mover]]:
    """The town (without the car that leaves its bay), the recording vehicle's exact motion, and all other movers.

    They are: one who drives ahead, one behind, some who wait at the light of the first crossing and some who pass it,
    oncoming and stop-and-go traffic, a car that creeps out of a bay, cyclists and people on foot. `day` is the seed of
    them all. A vehicle that weaves does not come back to the very same points.
    """
    rng = np.random.default_rng([day, 4])
    own = own_path(town)
    usual = ego = _ride(town, own, seconds)
    if weaves:
        own = path_of(town, _weaving(_own_lane(town), np.random.default_rng([day, 6])))
        ego = _ride(town, own, seconds)
    start, line = start_and_line(town, own)
    crowd = Crowd(town, ego, seconds)
    ahead = _drive(own, seconds, start=start + 14.0, stops=_stops(line - 2.6, -1.0), speed=7.0, limit=9.5)
    crowd.admit("leader", 4, CAR_COLOURS[0], ahead)
    behind = _drive(own, seconds, start=start - 13.0, stops=_stops(line - 18.0, 1.3), speed=7.0, limit=8.0)
    crowd.admit("follower", 1, CAR_COLOURS[5], behind)
    _meet_at_the_light(town, crowd, seconds, rng)
    town = _creep(town, crowd, usual, seconds)  # the same car every day
    _oncoming(town, crowd, seconds, rng, laps)
    on_foot(town, crowd, seconds, rng, laps)
    return town, ego, crowd.movers


def _stops(at: float, later: float = 0.0) -> list[tuple[float, float]]:
    return [(at, _GREEN_S + later)]


def _length(town: Town, a: Node, b: Node) -> float:
    return float(np.linalg.norm(town.streets.position(b) - town.streets.position(a)))


def _meet_at_the_light(town: Town, crowd: Crowd, seconds: float, rng: np.random.Generator) -> None:
    """A vehicle waits on the other side until the light is green, and others cross before."""
    before, here = town.route[0], town.route[1]
    step = (here[0] - before[0], here[1] - before[1])
    across = (-step[1], step[0])
    opposite = towards_us(town)
    path = path_of(town, lane_path(town.streets, opposite))
    line = _length(town, opposite[0], opposite[1]) * (len(opposite) == 4)
    line += (
        _length(town, opposite[-3], here) - town.streets.crossing_edge(opposite[-3], here) - STOP_LINE_M - 2.6
    )
    for late in (0.7, 4.0, 7.0, 10.0):
        stop = [(line, _GREEN_S + late)]
        motion = _drive(path, seconds, start=line - 16.0, speed=4.0, limit=8.5, stops=stop)
        if crowd.admit("waits opposite", 0, CAR_COLOURS[2], motion):
            break
    for side in (1, -1):
        nodes = [(here[0] + k * side * across[0], here[1] + k * side * across[1]) for k in (-2, -1, 0, 1, 2)]
        path = path_of(town, lane_path(town.streets, _within(town, nodes)))
        middle = path.nearest(town.to_map(town.streets.position(here)[None])[0])
        for back in (24.0, 36.0, 52.0, 66.0):
            if middle - back < 0:
                continue
            motion = _drive(path, seconds, start=middle - back, speed=7.5, limit=8.5)
            crowd.admit("crosses", int(rng.integers(0, 6)), _colour(rng), motion)


def towards_us(town: Town) -> list[Node]:
    """The crossings of those who come towards the first street of the route, and drive on along it."""
    (a, b), (c, d) = town.route[:2]
    step = c - a, d - b
    return _within(town, [(c + k * step[0], d + k * step[1]) for k in (2, 1, 0, -1)])


def _within(town: Town, nodes: list[Node]) -> list[Node]:
    return [node for node in nodes if town.streets.holds(node)]


def _colour(rng: np.random.Generator) -> Colour:
    return CAR_COLOURS[int(rng.integers(len(CAR_COLOURS)))]


def _oncoming(town: Town, crowd: Crowd, seconds: float, rng: np.random.Generator, laps: int) -> None:
    """Traffic against the drive on every street of the route, some of it stop and go; a cyclist on the first.

    Who is to be met in a later lap comes from so much farther away.
    """
    for number, (a, b) in enumerate(pairwise(town.route[1:])):
        step = (b[0] - a[0], b[1] - a[1])
        nodes = _within(town, [(b[0] + k * step[0], b[1] + k * step[1]) for k in (2, 1, 0, -1, -2)])
        lane = lane_path(town.streets, nodes)
        if number == 0:
            edge = path_of(town, _shifted(lane, town.streets.half_width(a, b) - 2.6 - LANE_M))
            for share in np.linspace(0.15, 0.75, 13):
                motion = _drive(edge, seconds, start=float(share * edge.way[-1]), speed=4.0, limit=4.2)
                if crowd.admit("cyclist", CYCLIST, _CLOTHES[1], motion):
                    break
        later = seconds / laps * ((number + 1) // 4) if laps > 1 else 0.0
        far = 7.0 * later
        path = path_of(town, _from_afar(lane, far))
        for k in range(8):
            start = float(rng.uniform(0.05, 0.7) * (path.way[-1] - far))
            halt = (start + far + float(rng.uniform(15, 40)), later + float(rng.uniform(6, 14)))
            stops = [halt, (halt[0] + 9.0, halt[1] + 5.0)] if k % 3 == 0 else []
            speed = float(rng.uniform(5.5, 8.5))
            motion = _drive(path, seconds, start=start, speed=speed, limit=speed + 1.0, stops=stops)
            crowd.admit("stop and go" if stops else "oncoming", int(rng.integers(0, 6)), _colour(rng), motion)


def _from_afar(uv: Floats, metres: float) -> Floats:
    """A straight way that begins so much earlier."""
    course = (uv[-1] - uv[0]) / np.linalg.norm(uv[-1] - uv[0])
    return np.concatenate([straight(uv[0] - metres * course, uv[0], 1.5), uv]) if metres else uv


def _shifted(uv: Floats, right: float) -> Floats:
    """A straight way moved to its right."""
    course = (uv[-1] - uv[0]) / np.linalg.norm(uv[-1] - uv[0])
    return np.asarray(uv + right * np.array([course[1], -course[0]]))


def _creep(town: Town, crowd: Crowd, ego: Motion, seconds: float) -> Town:
    """One car rolls out of its bay for a metre and a half as the drive passes: a trail hardly longer than the car."""
    track = ego.poses(np.arange(0.0, seconds, 0.5))[:, :3, 3]
    best: tuple[float, int, float] | None = None
    for k, thing in enumerate(town.things):
        if not thing.is_vehicle or thing.model > 3 or not _stands_across(town, thing):
            continue
        gaps = np.linalg.norm(track[:, :2] - town.place(thing)[:2], axis=1)
        if best is None or gaps.min() < best[0]:
            best = (float(gaps.min()), k, 0.5 * float(gaps.argmin()))
    if best is None or best[0] > 40.0:
        return town
    _, k, passing = best
    thing = town.things[k]
    ahead = np.array([np.cos(thing.heading), np.sin(thing.heading)])
    path = path_of(town, np.array([thing.u, thing.v]) + np.arange(0.0, 5.0, 0.5)[:, None] * ahead)
    begin = max(passing - 5.0, 1.0)
    stamps = np.array([-EARLY_S - 0.1, begin, begin + 0.8, begin + 4.0, begin + 4.8, seconds + 30.0])
    speeds = np.array([0.0, 0.0, 0.38, 0.38, 0.0, 0.0])
    if not crowd.admit("creeps", thing.model, thing.colour, follow(path.points, stamps, speeds)):
        return town
    rest = [other for j, other in enumerate(town.things) if j != k]
    return Town(town.streets, town.route, town.ground, town.models, rest)


def _stands_across(town: Town, thing: Thing) -> bool:
    """Whether a car stands in a bay with its front to the street."""
    ahead = np.array([np.cos(thing.heading), np.sin(thing.heading)])
    depth, front = (_depth(town, np.array([thing.u, thing.v]) + reach * ahead) for reach in (0.0, 5.0))
    return depth > 5.0 and front < depth - 4.0


def _depth(town: Town, uv: Floats) -> float:
    """How far behind the kerb of the nearest street a point is."""
    u, v = town.streets, uv
    return float(min((np.abs(v[0] - u.u) - u.half_u).min(), (np.abs(v[1] - u.v) - u.half_v).min()))


def on_foot(town: Town, crowd: Crowd, seconds: float, rng: np.random.Generator, laps: int) -> None:
    """People on both sidewalks of the route, and one on the zebra while the drive waits."""
    route, reach = (town.route, 60.0) if laps == 1 else (town.route[:5], 60.0 + 1.5 * seconds)
    for a, b in pairwise(route):
        pa, pb = town.streets.position(a), town.streets.position(b)
        course = (pb - pa) / np.linalg.norm(pb - pa)
        right = np.array([course[1], -course[0]])
        for k in range(6):
            out = town.streets.half_width(a, b) + float(rng.uniform(2.2, 2.8))
            way = float(rng.uniform(14.0, np.linalg.norm(pb - pa) - 16.0))
            here = pa + course * way + (right if k % 2 else -right) * out
            towards = course if rng.random() < 0.5 else -course
            line = here + np.arange(0.0, reach, 1.5)[:, None] * towards
            speed = float(rng.uniform(1.0, 1.5))
            motion = _drive(path_of(town, line), seconds, start=0.0, speed=speed, limit=speed)
            crowd.admit("walks", PERSON, _CLOTHES[k % 5], motion)
    a, b = town.route[0], town.route[1]
    pa, pb = town.streets.position(a), town.streets.position(b)
    course = (pb - pa) / np.linalg.norm(pb - pa)
    right = np.array([course[1], -course[0]])
    zebra = pb - course * (town.streets.crossing_edge(a, b) + 5.7)
    half = town.streets.half_width(a, b) + 1.6
    line = zebra + right * half - np.arange(0.0, 2 * half + 12.0, 1.5)[:, None] * right
    crowd.admit(
        "crosses on foot",
        PERSON,
        _CLOTHES[0],
        _drive(path_of(town, line), seconds, start=0.0, speed=1.4, limit=1.4),
    )
