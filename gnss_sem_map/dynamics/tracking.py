"""Tracking: segments of one object over time, associated with predictions of constant velocity."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.dynamics.sweep_delays import SweepDelays

LONGEST_GAP = 5
"""A track ends after more scans than this without a segment."""
LONGEST_GAP_S = 1.5
"""A track ends when the sensor pauses for longer: the next car at the place is another one."""
NEW_SHARE = 0.3
"""Weight of a new step in the velocity of a track (exponential smoothing)."""
FASTEST_M_S = 45.0
"""Gate of a track with a single segment that is mostly free: this speed times the time between scans."""


@dataclass(frozen=True, eq=False)
class Segment:
    """The points of one object in one scan."""

    scan: int
    """Position of the scan in time."""
    stamp: float
    centroid: NDArray[np.float64]
    """(2,) m, east and north in the map frame."""
    points: int
    shown: bool
    """An image labels some of its points as vehicle."""
    truncated: bool
    """It is cut off by the edge of the image or hidden in part: its box is not that of the object."""
    outline: Callable[[], NDArray[np.floating]]
    """(v, 2) m: the points of its voxels on average, which tell its extent in any direction.

    It is made when it is asked for: those of a chunk of scans take 27 MB.
    """
    seen_from: NDArray[np.float64]
    """(2,) m: where the LiDAR was."""
    levels: tuple[float, float] = (0.0, 0.0)
    """Lowest and highest of its voxels, by the means of their points, m."""
    labelled: int = 0
    """Points that the image labels as movable."""
    delays: SweepDelays | None = None
    """When the sweep met what; None: all at the stamp."""
    is_covered: bool = False
    """Something nearer hides what is above or below: what is seen of it may be seen through a gap."""


@dataclass(eq=False)
class Track:
    """One object: its segments, at most one per scan, in time order."""

    segments: list[int] = field(default_factory=list)
    """Indices in the list of all segments."""
    last: Segment | None = None
    velocity: NDArray[np.float64] = field(default_factory=lambda: np.zeros(2))

    def predict(self, stamp: float) -> NDArray[np.float64]:
        """Predicted centroid (2,) m at constant velocity."""
        if self.last is None:
            raise ValueError("a track without segments has no position")
        return np.asarray(self.last.centroid + self.velocity * (stamp - self.last.stamp))

    def extend(self, number: int, segment: Segment, first_share: float = 0.5) -> None:
        """Append a segment and update the velocity.

        The first step counts half: its two centroids may be of different parts of the object.
        """
        if self.last is not None:
            step = (segment.centroid - self.last.centroid) / (segment.stamp - self.last.stamp)
            share = NEW_SHARE if len(self.segments) > 1 else first_share
            self.velocity = (1 - share) * self.velocity + share * step
        self.segments.append(number)
        self.last = segment


def track(segments: list[Segment], gate_m: float, mostly_free: NDArray[np.bool_]) -> list[Track]:
    """Tracks of segments in time order: those of a scan are assigned to the nearest prediction, greedily.

    `mostly_free` (s,): other scans saw through the segment more often than they hit it. A fast object is farther from
    its prediction than the gate, because a new track has no velocity yet: of the remaining segments, those that are
    mostly free are assigned to new tracks of mostly free segments of the scan before, within the distance that the
    fastest vehicle covers. Static segments are not mostly free, and are never assigned in this way.
    """
    tracks: list[Track] = []
    by_scan: dict[int, list[int]] = {}
    for number, segment in enumerate(segments):
        by_scan.setdefault(segment.scan, []).append(number)
    alive: list[Track] = []
    for scan, numbers in by_scan.items():
        stamp = segments[numbers[0]].stamp
        alive = [t for t in alive if t.last is not None and _goes_on(t.last, scan, stamp)]
        free, taken = set(numbers), set()
        for number, row in _nearest_first(segments, numbers, alive, gate_m):
            if number in free and row not in taken:
                free.remove(number)
                taken.add(row)
                alive[row].extend(number, segments[number])
        for number, t in _fast_pairs(
            segments, [n for n in sorted(free) if mostly_free[n]], alive, mostly_free, scan
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


def _goes_on(last: Segment, scan: int, stamp: float) -> bool:
    """Whether a track with this last segment may go on in a scan: none goes on after a pause of the sensor."""
    return scan - last.scan <= LONGEST_GAP + 1 and stamp - last.stamp <= LONGEST_GAP_S


def _fast_pairs(
    segments: list[Segment],
    numbers: list[int],
    alive: list[Track],
    mostly_free: NDArray[np.bool_],
    scan: int,
) -> list[tuple[int, Track]]:
    """Pairs of a segment and a track with one mostly free segment, from the scan before; nearest first."""
    begun = [
        t
        for t in alive
        if len(t.segments) == 1 and mostly_free[t.segments[0]] and t.last and t.last.scan == scan - 1
    ]
    if not begun or not numbers or begun[0].last is None:
        return []
    reach_m = FASTEST_M_S * (segments[numbers[0]].stamp - begun[0].last.stamp)
    return [(n, begun[row]) for n, row in _nearest_first(segments, numbers, begun, reach_m)]


def _nearest_first(
    segments: list[Segment], numbers: list[int], alive: list[Track], gate_m: float
) -> list[tuple[int, int]]:
    """Pairs (segment, index of the track in `alive`) within the gate, nearest first."""
    if not alive or not numbers:
        return []
    stamp = segments[numbers[0]].stamp
    predicted = np.array([t.predict(stamp) for t in alive])
    centroids = np.array([segments[n].centroid for n in numbers])
    distances = np.linalg.norm(centroids[:, None] - predicted[None], axis=2)
    near = np.argwhere(distances <= gate_m)
    order = np.argsort(distances[near[:, 0], near[:, 1]], kind="stable")
    return [(numbers[i], int(j)) for i, j in near[order]]
