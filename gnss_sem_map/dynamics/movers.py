"""Movers of a drive: what moved, each with its track, size, speed, class and the evidence that it moved.

A drive is searched chunk by chunk and LiDAR by LiDAR, so one object may have several tracks. Tracks of different chunks
or LiDARs that lie on each other are of one object. What is within the outline of another one, scan after scan, is a
part of it that was a segment of its own: the front of a lorry, of which a pole hides the middle.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from factor_graphs.sessions import components
from gnss_sem_map.dynamics.clusters import LONGEST_M
from gnss_sem_map.dynamics.constant_acceleration import SmoothedTrack, smooth
from gnss_sem_map.dynamics.motion_state import GONE, TrackedObject
from gnss_sem_map.dynamics.object_track import CAR_M, LORRY_M, SMALL_M, ObjectTrack, courses

Array = NDArray[np.float64]

SAME_M = 1.0
"""Tracks whose median distance is smaller than this are of one object."""
LEAST_COMMON_S = 0.25
"""Tracks that have less time in common are not compared."""
LEAST_WAY_M, SIGNIFICANT = 0.5, 3.0
"""What moved went so far, and so many standard deviations of that."""
PART_SHARE, PART_MARGIN_M = 0.8, 0.5
"""A part of something larger is within its outline in so large a share of the scans, and no farther before or behind
its middle than half of its length and so much."""
SHORTEST_M = 2.5
"""Length of the shortest car: no second one is nearer than this in its lane."""
OUTLINE_STDDEV_M, OUTLINE_STDDEV_RATIO = 0.1, 0.05
"""The middle of an object is known to this, plus this share of its size: no scan shows all its sides, and it turns."""
HIGHEST_CAR_M = 2.0
"""A higher vehicle, of which an end is seen, may be as long as a lorry."""
GROUND_PLACES = 9
"""The ground under a place is the median of so many."""
LEAST_LABELLED = 0.2
"""With this share of its points labelled, an object is what its labels say; with less, what its shape says."""
VEHICLE, UNKNOWN = "vehicle", "unknown"
SHAPES = (
    ("person", 0.0, 1.2, 1.2, 0.8, 2.3),
    ("cyclist", 1.2, 2.3, 1.2, 0.8, 2.3),
    (VEHICLE, 2.3, LONGEST_M, 3.2, 0.6, 4.5),
)
"""Classes by shape: least and greatest length, greatest width, least and greatest height, m."""
FASTEST_WALK_MPS, WIDEST_RIDER_M = 2.5, 1.2
"""What drives and is wider than this is a vehicle, of which only the front or the rear is seen."""


@dataclass(frozen=True, eq=False)
class Mover:
    """One object that moved."""

    lidars: tuple[str, ...]
    """LiDARs that saw it, by name."""
    name: str
    """Its class."""
    kind: str
    """What that is: the role of the class, or one of `SHAPES`."""
    is_labelled: bool
    """Labels tell its class; else its shape does."""
    labelled: float
    """Share of its points that an image labels as movable."""
    motion: str
    probability: float
    """That it moved."""
    evidence: str
    points: int
    size_m: tuple[float, float, float]
    """Length, width and height."""
    stamps: Array
    """(k,) s."""
    heights: Array
    """(k,) m: the ground under it."""
    track: SmoothedTrack

    @property
    def positions(self) -> Array:
        """(k, 3) m: the middle of its footprint."""
        return np.column_stack([self.track.positions, self.heights])

    @property
    def position_stddevs(self) -> Array:
        """(k, 2) m of east and north, of the middle of the whole object, relative to the trajectory of the drive.

        To the scatter of the track comes what all its scans have in common: the sides that none of them shows.
        """
        length, width, height = self.size_m
        possible = LORRY_M if height > HIGHEST_CAR_M else CAR_M
        unseen = max(possible - length, 0.0) / 2 if self.kind in (VEHICLE, UNKNOWN) else 0.0
        outline = OUTLINE_STDDEV_M**2 + (OUTLINE_STDDEV_RATIO * max(length, width)) ** 2
        ahead = courses(self.track.positions)
        return np.asarray(np.sqrt(self.track.position_variances + outline + (unseen * ahead) ** 2))

    @property
    def went_somewhere(self) -> bool:
        """Whether it was seen to move, not only to be there at one time and not at another."""
        off = self.track.positions - self.track.positions[0]
        stddevs = np.sqrt((self.track.position_variances + self.track.position_variances[0]).max(axis=1))
        return bool((np.linalg.norm(off, axis=1) > np.maximum(LEAST_WAY_M, SIGNIFICANT * stddevs)).any())

    @property
    def way_m(self) -> float:
        """How far it went."""
        return float(np.linalg.norm(np.diff(self.track.positions, axis=0), axis=1).sum())

    @property
    def mean_speed(self) -> tuple[float, float]:
        """Over the time that it was seen, m/s, and the standard deviation of that."""
        seconds, ends = float(self.stamps[-1] - self.stamps[0]), self.track.position_variances[[0, -1]]
        return self.way_m / seconds, float(np.sqrt(ends.max(axis=1).sum())) / seconds

    @property
    def speeds(self) -> Array:
        """(k,) m/s."""
        return np.asarray(np.linalg.norm(self.track.velocities, axis=1))

    @property
    def speed_stddevs(self) -> Array:
        """(k,) m/s."""
        speeds = self.speeds[:, None]
        ahead = np.divide(
            self.track.velocities, speeds, np.full_like(self.track.velocities, 0.5**0.5), where=speeds > 0
        )
        return np.asarray(np.sqrt((ahead**2 * self.track.velocity_variances).sum(axis=1)))

    @property
    def headings_deg(self) -> Array:
        """(k,) from north over east."""
        return np.asarray(np.degrees(np.arctan2(*self.track.velocities.T)) % 360)


def movers_of(objects: Sequence[TrackedObject], movable: Mapping[str, str]) -> tuple[Mover, ...]:
    """The movers among tracked objects, by the time when they were first seen.

    `movable` are the classes of the class set that may move, with their roles.
    """
    moved = [one for one in objects if one.motion in GONE and one.track is not None]
    movers = [_mover([moved[n] for n in group], movable) for group in _same(moved)]
    seen_to_move = _without_parts([one for one in movers if one.went_somewhere])
    return tuple(sorted(seen_to_move, key=lambda one: (one.stamps[0], *one.positions[0])))


def _without_parts(movers: Sequence[Mover]) -> list[Mover]:
    """The movers that are no parts of others."""
    starts, ends, points = (
        np.array([(one.stamps[0], one.stamps[-1], one.points) for one in movers]).reshape(-1, 3).T
    )
    is_large = np.array([one.kind == VEHICLE or max(one.size_m[:2]) > SMALL_M for one in movers], np.bool_)

    def is_part(one: Mover) -> bool:
        may_hold = (starts < one.stamps[-1]) & (ends > one.stamps[0]) & (points > one.points) & is_large
        return any(_holds(movers[n], one) for n in np.flatnonzero(may_hold).tolist())

    return [one for one in movers if not is_part(one)]


def _holds(whole: Mover, part: Mover) -> bool:
    """Whether the middle of a part is within the outline of the whole in most scans of the part.

    Of a vehicle the outline may be that of one end, so what is nearer in its lane than a car could be is a part, too.
    """
    at, places = part.stamps, whole.track.positions
    off = part.track.positions - np.column_stack([np.interp(at, whole.stamps, axis) for axis in places.T])
    east, north = courses(places)[np.searchsorted(whole.stamps, at).clip(max=len(places) - 1)].T
    along, across = abs(east * off[:, 0] + north * off[:, 1]), abs(east * off[:, 1] - north * off[:, 0])
    length, width, _ = whole.size_m
    reach_m = length / 2 + PART_MARGIN_M
    if whole.kind == VEHICLE and part.kind in (VEHICLE, UNKNOWN):
        reach_m = max(reach_m, SHORTEST_M)
    inside = (at >= whole.stamps[0]) & (at <= whole.stamps[-1])
    inside &= (along <= reach_m) & (across <= width / 2)
    return bool(inside.mean() >= PART_SHARE)


def _same(objects: Sequence[TrackedObject]) -> list[list[int]]:
    """Groups of objects that are one, each in the order of time."""
    order = sorted(range(len(objects)), key=lambda n: float(_track(objects[n]).stamps[0]))
    ones: list[tuple[int, int]] = []
    alive: list[int] = []
    for place, n in enumerate(order):
        start = _track(objects[n]).stamps[0]
        alive = [m for m in alive if _track(objects[order[m]]).stamps[-1] >= start]
        ones += [(m, place) for m in alive if _are_one(objects[order[m]], objects[n])]
        alive.append(place)
    groups = components(len(objects), np.array(ones, np.intp).reshape(-1, 2))
    return [[order[place] for place in group] for group in groups]


def _track(one: TrackedObject) -> ObjectTrack:
    assert one.track is not None
    return one.track


def _are_one(first: TrackedObject, second: TrackedObject) -> bool:
    """Whether two tracks, of different chunks or LiDARs, lie on each other."""
    if (first.chunk, first.lidar) == (second.chunk, second.lidar):
        return False
    a, b = _track(first), _track(second)
    start, end = max(a.stamps[0], b.stamps[0]), min(a.stamps[-1], b.stamps[-1])
    if end - start < LEAST_COMMON_S:
        return False
    times = np.linspace(start, end, 20)
    off = [
        np.interp(times, a.stamps, a.positions[:, k]) - np.interp(times, b.stamps, b.positions[:, k])
        for k in (0, 1)
    ]
    return bool(np.median(np.hypot(*off)) < SAME_M)


def _mover(objects: Sequence[TrackedObject], movable: Mapping[str, str]) -> Mover:
    """One mover of its tracks; what chunks have in common counts once."""
    tracks = [_track(one) for one in objects]
    stamps = np.concatenate([t.stamps for t in tracks])
    lidars = np.repeat([one.lidar for one in objects], [len(t.stamps) for t in tracks])
    positions, variances = (
        np.concatenate([getattr(t, name) for t in tracks]) for name in ("positions", "variances")
    )
    _, first = np.unique(np.rec.fromarrays([stamps, lidars]), return_index=True)
    stamps, positions, variances = stamps[first], positions[first], variances[first]
    of_tracks = np.array([one.points for one in objects], np.float64)
    labelled = float(np.average([t.labelled for t in tracks], weights=of_tracks))
    main = objects[int(of_tracks.argmax())]
    length, width, height = (max(sizes) for sizes in zip(*(t.size_m for t in tracks), strict=True))
    size = length, width, height
    is_labelled = labelled >= LEAST_LABELLED and len(movable) == 1
    track = smooth(stamps, positions[:, :2], variances)
    speed_mps = float(np.median(np.linalg.norm(track.velocities, axis=1)))
    name = kind = class_by_shape(size, speed_mps)
    if is_labelled:
        [(name, kind)] = movable.items()
    return Mover(
        lidars=tuple(sorted({one.lidar for one in objects})),
        name=name,
        kind=kind,
        is_labelled=is_labelled,
        labelled=labelled,
        motion=main.motion,
        probability=max(one.probability for one in objects),
        evidence=main.reason,
        points=int(np.concatenate([t.points for t in tracks])[first].sum()),
        size_m=size,
        stamps=stamps,
        # reflected: "nearest" repeats the first place, which then is its own median
        heights=np.asarray(median_filter(positions[:, 2], GROUND_PLACES, mode="reflect")),
        track=track,
    )


def class_by_shape(size_m: tuple[float, ...], speed_mps: float) -> str:
    """What an object of this length, width and height, m, is at this speed."""
    length, width, height = size_m
    if width >= WIDEST_RIDER_M and speed_mps > FASTEST_WALK_MPS:
        length = max(length, SHORTEST_M)
    for name, shortest, longest, widest, lowest, highest in SHAPES:
        if (
            shortest <= max(length, width) < longest
            and min(length, width) < widest
            and lowest <= height < highest
        ):
            return name
    return UNKNOWN
