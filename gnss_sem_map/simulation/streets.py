"""The street network: a grid of streets with uneven spacing, routes through it, and the kerbs of its blocks."""

import itertools
from dataclasses import dataclass, field

import numpy as np

from gnss_sem_map.simulation.compiled import Floats
from gnss_sem_map.simulation.ground import Ground, inside_block

Node = tuple[int, int]

LANE_M = 1.65  # from the centre line to the middle of the lane
STOP_LINE_M = 8.4  # from a crossing's edge
_RIGHT_TURN_M, _LEFT_TURN_M = 7.5, 10.0


@dataclass(frozen=True, eq=False)
class Streets:
    """Where the streets run, in town axes (metres): one along v at every `u`, one along u at every `v`."""

    u: Floats
    half_u: Floats
    v: Floats
    half_v: Floats
    corner_radius: float = 4.0
    kerb_height: float = 0.12
    sidewalk_width: float = 3.2

    def half_width(self, a: Node, b: Node) -> float:
        """Half the width of the street between two neighbouring crossings."""
        return float(self.half_u[a[0]] if a[0] == b[0] else self.half_v[a[1]])

    def crossing_edge(self, a: Node, b: Node) -> float:
        """How far from the middle of crossing `b` its edge is, for those who come from `a`."""
        return float(self.half_v[b[1]] if a[0] == b[0] else self.half_u[b[0]])

    def position(self, node: Node) -> Floats:
        """The middle of a crossing."""
        return np.array([self.u[node[0]], self.v[node[1]]])

    def holds(self, node: Node) -> bool:
        """Whether there is such a crossing."""
        return 0 <= node[0] < len(self.u) and 0 <= node[1] < len(self.v)


@dataclass(frozen=True, eq=False)
class Side:
    """One kerb of a block: `along` runs with the block on its left, `inwards` into the block."""

    corner: Floats
    along: Floats
    inwards: Floats
    length: float
    deep: bool  # whether its lots reach to the corners
    block: int
    street: tuple[Node, Node] = field(default=((0, 0), (0, 0)))

    def at(self, along: float, depth: float) -> Floats:
        """Town coordinates of a point of this side."""
        return self.corner + along * self.along + depth * self.inwards

    @property
    def heading(self) -> float:
        """Angle of `along` from u, rad."""
        return float(np.arctan2(self.along[1], self.along[0]))


def lay_streets(rng: np.random.Generator, count: int = 6) -> Streets:
    """A grid of `count` by `count` streets, blocks of 60 to 90 m."""

    def lines() -> Floats:
        at = np.cumsum(rng.uniform(62.0, 90.0, count))
        return np.asarray(at - at.mean())

    return Streets(lines(), rng.uniform(5.2, 6.0, count), lines(), rng.uniform(5.2, 6.0, count))


def sides(streets: Streets, ground: Ground) -> list[Side]:
    """All kerbs between two crossings, each seen from its block."""
    found = []
    for i in range(len(streets.u) - 1):  # streets along u, both kerbs
        for j in range(len(streets.v)):
            west, east = streets.u[i] + streets.half_u[i], streets.u[i + 1] - streets.half_u[i + 1]
            for towards in (1.0, -1.0):
                corner = np.array([west if towards > 0 else east, streets.v[j] + towards * streets.half_v[j]])
                along, inwards = np.array([towards, 0.0]), np.array([0.0, towards])
                inner = corner + 0.5 * (east - west) * along + 5.0 * inwards
                block = inside_block(ground, *inner)[1]
                found.append(Side(corner, along, inwards, east - west, True, block, ((i, j), (i + 1, j))))
    for j in range(len(streets.v) - 1):  # streets along v
        for i in range(len(streets.u)):
            south, north = streets.v[j] + streets.half_v[j], streets.v[j + 1] - streets.half_v[j + 1]
            for towards in (1.0, -1.0):
                corner = np.array(
                    [streets.u[i] + towards * streets.half_u[i], north if towards > 0 else south]
                )
                along, inwards = np.array([0.0, -towards]), np.array([towards, 0.0])
                inner = corner + 0.5 * (north - south) * along + 5.0 * inwards
                block = inside_block(ground, *inner)[1]
                found.append(Side(corner, along, inwards, north - south, False, block, ((i, j), (i, j + 1))))
    return found


def random_route(streets: Streets, crossings: int, rng: np.random.Generator) -> list[Node]:
    """A way through the network: it turns at its first two crossings (one left, one right), then mostly turns."""
    middle = len(streets.u) // 2
    heading = [(1, 0), (0, 1), (-1, 0), (0, -1)][int(rng.integers(4))]
    route = [(middle - heading[0], middle - heading[1])]
    route.append((middle, middle))
    turn = int(rng.choice([-1, 1]))
    while len(route) < crossings + 1:
        here = route[-1]
        options = [_turned(heading, k) for k in (turn, -turn, 0)]
        fit = [h for h in options if _inside(streets, (here[0] + h[0], here[1] + h[1]))]
        pick = 0 if len(route) < 4 or rng.random() < 0.6 else int(rng.integers(len(fit)))
        heading = fit[pick]
        route.append((here[0] + heading[0], here[1] + heading[1]))
        turn = -turn
    return route


def around_the_block(route: list[Node], laps: int) -> list[Node]:
    """The first two streets of a route and the two that lead back: so many laps, and one more that nobody finishes."""
    a, b, c = route[:3]
    return [a, b, c, (a[0] + c[0] - b[0], a[1] + c[1] - b[1])] * (laps + 1)


def _inside(streets: Streets, node: Node) -> bool:
    """Whether a crossing is inside the town, not on its rim."""
    return 0 < node[0] < len(streets.u) - 1 and 0 < node[1] < len(streets.v) - 1


def _turned(heading: Node, quarter: int) -> Node:
    return (-quarter * heading[1], quarter * heading[0]) if quarter else heading


def lane_path(streets: Streets, route: list[Node], step_m: float = 1.5) -> Floats:
    """The middle of the right-hand lane along a route, (k, 2) town coordinates, from and to the ends of the route."""
    spots = [streets.position(node) for node in route]
    courses = [(b - a) / np.linalg.norm(b - a) for a, b in itertools.pairwise(spots)]
    rights = [np.array([c[1], -c[0]]) for c in courses]
    pieces, begin = [], spots[0] + LANE_M * rights[0]
    for k in range(1, len(courses)):
        cross = courses[k - 1][0] * courses[k][1] - courses[k - 1][1] * courses[k][0]
        if abs(cross) < 0.5:
            continue  # straight on: the next turn draws the line to it
        corner = spots[k] + LANE_M * (rights[k - 1] + rights[k])
        radius = _LEFT_TURN_M if cross > 0 else _RIGHT_TURN_M
        entry, centre = (
            corner - radius * courses[k - 1],
            corner - radius * courses[k - 1] + radius * courses[k],
        )
        pieces.append(straight(begin, entry, step_m))
        angles = np.linspace(0, np.pi / 2, max(4, round(radius * np.pi / 2 / step_m)) + 1)[:-1]
        pieces.append(
            centre
            - radius * (np.outer(np.cos(angles), courses[k]) - np.outer(np.sin(angles), courses[k - 1]))
        )
        begin = corner + radius * courses[k]
    pieces.append(straight(begin, spots[-1] + LANE_M * rights[-1], step_m))
    return np.concatenate(pieces)


def straight(a: Floats, b: Floats, step_m: float) -> Floats:
    """Points from a towards b, without b."""
    count = max(1, round(float(np.linalg.norm(b - a)) / step_m))
    return a + np.linspace(0, 1, count + 1)[:-1, None] * (b - a)
