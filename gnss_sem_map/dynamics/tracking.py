"""Segments of one object through time, by where it should be next."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

LONGEST_GAP = 5
"""A track that was not seen for more scans than this has ended."""
NEW_SHARE = 0.3
"""How much a new step counts in the velocity of a track."""
LEAST_ENDS = 4
"""Fewer segments than this show no motion."""
SMOOTHED = 5
"""Segments in the running median of a track's boxes."""
SPEED_OVER_S = 0.5
FASTEST_M_S = 45.0
"""Of what was seen once, and whose place was found empty: next it may be as far away as this speed takes it."""


@dataclass(frozen=True, eq=False)
class Segment:
    """The points of one object in one scan."""

    scan: int
    """Position of the scan in time."""
    stamp: float
    centroid: NDArray[np.float64]
    """(2,) m, east and north in the map frame."""
    lowest: NDArray[np.float64]
    """(2,) m: corner of the box around it."""
    highest: NDArray[np.float64]
    """(2,) m: the opposite corner."""
    points: int
    shown: bool
    """An image calls some of it a vehicle."""
    cut: bool
    """The edge of the view cuts it: its ends are not its own."""


@dataclass(eq=False)
class Track:
    """One object: its segments, at most one per scan, in time order."""

    segments: list[int] = field(default_factory=list)
    """Positions in the list of all segments."""
    last: Segment | None = None
    velocity: NDArray[np.float64] = field(default_factory=lambda: np.zeros(2))

    def predict(self, stamp: float) -> NDArray[np.float64]:
        """Where its centroid should be, (2,) m."""
        if self.last is None:
            raise ValueError("a track without segments is nowhere")
        return np.asarray(self.last.centroid + self.velocity * (stamp - self.last.stamp))

    def extend(self, number: int, segment: Segment, first_share: float = 0.5) -> None:
        """Take the next segment; the first step counts half, for its two centroids saw different parts."""
        if self.last is not None:
            step = (segment.centroid - self.last.centroid) / (segment.stamp - self.last.stamp)
            share = NEW_SHARE if len(self.segments) > 1 else first_share
            self.velocity = (1 - share) * self.velocity + share * step
        self.segments.append(number)
        self.last = segment


def track(segments: list[Segment], gate_m: float, fleeting: NDArray[np.bool_]) -> list[Track]:
    """Tracks of the segments, which come in time order: each scan's are joined to the nearest prediction, greedily.

    A segment is `fleeting` (s,) if other scans found its place empty, more often than not. What drives fast is nowhere
    near where it was: among what is left, fleeting segments are joined to fleeting ones of the scan before, as far as
    the fastest could have come. What stands is not fleeting, and is never joined so.
    """
    tracks: list[Track] = []
    by_scan: dict[int, list[int]] = {}
    for number, segment in enumerate(segments):
        by_scan.setdefault(segment.scan, []).append(number)
    alive: list[Track] = []
    for scan, numbers in by_scan.items():
        alive = [t for t in alive if t.last is not None and scan - t.last.scan <= LONGEST_GAP + 1]
        free, taken = set(numbers), set()
        for number, place in _nearest_first(segments, numbers, alive, gate_m):
            if number in free and place not in taken:
                free.remove(number)
                taken.add(place)
                alive[place].extend(number, segments[number])
        for number, t in _fast_ones(
            segments, [n for n in sorted(free) if fleeting[n]], alive, fleeting, scan
        ):
            if number in free and len(t.segments) == 1:
                free.remove(number)
                t.extend(number, segments[number], first_share=1.0)
        for number in sorted(free):
            started = Track()
            started.extend(number, segments[number])
            tracks.append(started)
            alive.append(started)
    return tracks


def _fast_ones(
    segments: list[Segment],
    numbers: list[int],
    alive: list[Track],
    fleeting: NDArray[np.bool_],
    scan: int,
) -> list[tuple[int, Track]]:
    """Pairs of a segment and a track of one fleeting segment of the scan before, nearest first."""
    begun = [
        t
        for t in alive
        if len(t.segments) == 1 and fleeting[t.segments[0]] and t.last and t.last.scan == scan - 1
    ]
    if not begun or not numbers or begun[0].last is None:
        return []
    reach_m = FASTEST_M_S * (segments[numbers[0]].stamp - begun[0].last.stamp)
    return [(n, begun[place]) for n, place in _nearest_first(segments, numbers, begun, reach_m)]


def _nearest_first(
    segments: list[Segment], numbers: list[int], alive: list[Track], gate_m: float
) -> list[tuple[int, int]]:
    """Pairs (segment, place of the track) within the gate, nearest first."""
    if not alive or not numbers:
        return []
    stamp = segments[numbers[0]].stamp
    predicted = np.array([t.predict(stamp) for t in alive])
    centroids = np.array([segments[n].centroid for n in numbers])
    distances = np.linalg.norm(centroids[:, None] - predicted[None], axis=2)
    near = np.argwhere(distances <= gate_m)
    order = np.argsort(distances[near[:, 0], near[:, 1]], kind="stable")
    return [(numbers[i], int(j)) for i, j in near[order]]


@dataclass(frozen=True)
class Displacement:
    """How far and how fast an object went."""

    shift_m: float
    """By how much both of its ends moved, at least, between the two times at which it was farthest apart."""
    speed_m_s: float
    """Its highest speed over half a second."""


def displacement_of(segments: list[Segment]) -> Displacement | None:
    """The displacement of a track from both ends of its boxes: one end alone moves when more of it comes in view.

    It may stand before or after: the two times are those at which its centroids, smoothed by a running median, are
    farthest apart. None for a track of few segments; those that the edge of the view cuts do not count.
    """
    whole = [s for s in segments if not s.cut]
    if len(whole) < LEAST_ENDS:
        return None
    stamps = np.array([s.stamp for s in whole])
    centroids, low, high = (
        median_filter(np.array(values), size=(SMOOTHED, 1), mode="nearest")
        for values in zip(*((s.centroid, s.lowest, s.highest) for s in whole), strict=True)
    )
    distances = np.linalg.norm(centroids[:, None] - centroids[None], axis=2)
    start, end = np.unravel_index(distances.argmax(), distances.shape)
    if distances[start, end] == 0:
        return Displacement(0.0, 0.0)
    along = (centroids[end] - centroids[start]) / distances[start, end]
    middle, half = (low + high) / 2 @ along, (high - low) / 2 @ abs(along)
    shift = min(side[end] - side[start] for side in (middle - half, middle + half))
    later = np.minimum(np.searchsorted(stamps, stamps + SPEED_OVER_S), len(whole) - 1)
    spans = stamps[later] - stamps
    speeds = distances[np.arange(len(whole)), later] / np.maximum(spans, SPEED_OVER_S)
    return Displacement(float(shift), float(speeds.max()))
