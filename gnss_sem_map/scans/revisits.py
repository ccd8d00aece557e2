"""Revisits: a place that is passed again is registered to its first pass, surface to surface.

Places lie along the track of each drive; two that are close, by their poses and the accuracy of these, but far apart in
time or of different drives, are a pair. The registration goes from coarse voxels to fine ones, so it finds a pass that
is metres away. What the pairs are worth in the end, the graph decides (`factor_graphs.sessions`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import numpy as np
import small_gicp
from numpy.typing import NDArray
from pydantic import Field

from factor_graphs.condensing import CondensedDrive
from factor_graphs.sessions import AnchorPairs
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.process.machine import threads
from gnss_sem_map.process.prefetch import prefetch
from gnss_sem_map.scans import registration
from gnss_sem_map.scans.base_cloud import BaseCloud
from gnss_sem_map.scans.local_maps import LocalMaps, normals, way_along
from gnss_sem_map.scans.registration import DegenerateSettings
from gnss_sem_map.scans.thinned_sweeps import ThinnedSweeps

Array = NDArray[np.float64]

LEVELS = ((4.0, 4.0, 0.1), (2.0, 2.0, 0.05), (1.0, 1.0, 0.01), (0.5, 0.5, 0.01), (0.5, 0.25, 0.001))
"""Edge of the voxels, correspondence distance and least step of every registration, m. On simulated passes, all that
begin 2.5 m away come to less than 2 cm, and 9 of 10 that begin 4 m away."""
JUDGED = 3
"""The level by whose residuals a match is judged: the last one leaves out what does not fit."""
THREADS = min(threads(), 4)
"""Each registers a pair, with two local maps in memory."""
SAMPLED = 300
"""Points of a local map by which the distance of surfaces is told."""


class RevisitSettings(DegenerateSettings):
    """How places that are passed again are found and registered."""

    enabled: bool = Field(True, description="Bind places that are passed again, of one drive or of several.")
    every_m: float = Field(10.0, gt=0, description="Places are so far apart along the track.")
    within_m: float = Field(12.0, gt=0, description="Farther places are not registered to each other.")
    apart_s: float = Field(30.0, gt=0, description="In one drive, what is passed sooner again is no revisit.")
    passes: int = Field(3, gt=0, description="A place is registered to at most so many earlier passes.")
    min_inlier_share: float = Field(
        0.4, gt=0, le=1, description="Least share of points with a correspondence."
    )
    # errors of a registration beside noise: simulated passes show 1 to 10 mm
    translation_stddev_m: float = Field(0.005, gt=0, description="Least standard deviation of translation.")
    rotation_stddev_rad: float = Field(0.0005, gt=0, description="Least standard deviation of rotation.")


@dataclass(frozen=True, eq=False)
class Pass:
    """A drive with its places: `anchors` (p,) numbers of anchors, at poses `T_map_imu` (p, 4, 4) and `stamps` (p,)."""

    anchors: NDArray[np.intp]
    stamps: Array
    T_map_imu: Array
    maps: LocalMaps


def pass_of(
    sweeps: ThinnedSweeps, trajectory: Trajectory, condensed: CondensedDrive, settings: RevisitSettings
) -> Pass:
    """The places of a drive: anchors within its scans, `every_m` apart. `sweeps` are those along its track."""
    scans = sweeps.log.scans
    inside = np.flatnonzero((condensed.stamps >= scans[0].stamp) & (condensed.stamps <= scans[-1].stamp))
    places, last = [], -np.inf
    way = way_along(trajectory, condensed.stamps)
    for anchor in inside.tolist():
        if way[anchor] - last >= settings.every_m:
            places.append(anchor)
            last = way[anchor]
    anchors = np.array(places, np.intp)
    stamps = condensed.stamps[anchors]
    return Pass(anchors, stamps, trajectory.at(stamps), LocalMaps(sweeps, trajectory, stamps))


Pair = tuple[int, int, int, int]
"""Drive and place of an earlier pass, then of a later one."""


def candidates(passes: Sequence[Pass], settings: RevisitSettings) -> Iterator[Pair]:
    """Pairs to register.

    A place is paired with the nearest place of every earlier pass, of the nearest `passes`. Drives come in their order;
    in one drive, another pass is what lies `apart_s` before, and each time that the vehicle comes again.
    """
    for later, drive in enumerate(passes):
        for j, (stamp, T) in enumerate(zip(drive.stamps, drive.T_map_imu, strict=True)):
            found = []
            for earlier, other in enumerate(passes[: later + 1]):
                distance = np.linalg.norm(other.T_map_imu[:, :3, 3] - T[:3, 3], axis=1)
                near = distance <= settings.within_m
                if earlier == later:
                    near &= other.stamps <= stamp - settings.apart_s
                found += [
                    (distance[i], earlier, i)
                    for i in _nearest_of_each(near, distance, other.stamps, settings)
                ]
            for _, earlier, i in sorted(found)[: settings.passes]:
                yield earlier, i, later, j


def _nearest_of_each(
    near: NDArray[np.bool_], distance: Array, stamps: Array, settings: RevisitSettings
) -> Iterator[int]:
    """Of the places that are near, the nearest of each time that the vehicle came by."""
    there = np.flatnonzero(near)
    if len(there):
        for group in np.split(there, np.flatnonzero(np.diff(stamps[there]) > settings.apart_s) + 1):
            yield int(group[distance[group].argmin()])


@dataclass(frozen=True, eq=False)
class Revisits:
    """Pairs that were registered; `guesses` (p, 4, 4): the relative poses before; `refused`: pairs that did not match.

    `samples`: some points of each second local map and their normals, (n, 3) each.
    """

    pairs: AnchorPairs
    guesses: Array
    samples: list[tuple[Array, Array]]
    refused: int

    def of(self, rows: NDArray[np.bool_]) -> Revisits:
        """Some of the pairs."""
        samples = [self.samples[n] for n in np.flatnonzero(rows)]
        return Revisits(self.pairs[rows], self.guesses[rows], samples, self.refused)

    def __add__(self, more: Revisits) -> Revisits:
        pairs = AnchorPairs(
            *(
                np.concatenate([getattr(self.pairs, part.name), getattr(more.pairs, part.name)])
                for part in fields(AnchorPairs)
            )
        )
        guesses = np.concatenate([self.guesses, more.guesses])
        return Revisits(pairs, guesses, self.samples + more.samples, self.refused + more.refused)

    def numbered(self, number: NDArray[np.intp]) -> Revisits:
        """The same pairs, drive n being called number[n]."""
        return replace(self, pairs=replace(self.pairs, drives=number[self.pairs.drives]))

    def distances(self, pair: int, T: Array) -> Array:
        """How far the surfaces of the second pass are from where they match the first, with T_first_second, (n,) m."""
        points, across = self.samples[pair]
        off = registration.inverse(self.pairs.T[pair]) @ T
        found: Array = np.abs(np.sum((points @ off[:3, :3].T + off[:3, 3] - points) * across, axis=1))
        return found


class Found(NamedTuple):
    """A pair that was registered: T_first_second (4, 4), its covariance (6, 6), and points of the second local map."""

    T: Array
    covariance: Array
    sample: tuple[Array, Array]


Registrar = Callable[[Sequence[Pass], Sequence[Pair]], Iterable[Found | None]]
"""Registers pairs, see `register_pair`; gives the results in their order."""


def register_passes(
    passes: Sequence[Pass], settings: RevisitSettings, registrar: Registrar | None = None
) -> Revisits:
    """Register all places that were passed again: here on threads, or by a registrar."""
    pairs = list(candidates(passes, settings))
    if registrar is not None:
        found = registrar(passes, pairs)
    else:
        made = prefetch(lambda pair: register_pair(passes, pair, settings), pairs, THREADS)
        found = (result for _, result in made)

    def row(pair: Pair, result: Found | None) -> _Row | None:
        earlier, i, later, j = pair
        anchors = int(passes[earlier].anchors[i]), int(passes[later].anchors[j])
        return None if result is None else _Row((earlier, later), anchors, *result, _guess(passes, pair))

    return _revisits([row(pair, result) for pair, result in zip(pairs, found, strict=True)])


def register_pair(passes: Sequence[Pass], pair: Pair, settings: RevisitSettings) -> Found | None:
    """Register the local maps of two places; None where they do not match."""
    earlier, i, later, j = pair
    surfaces = passes[later].maps.at(j)
    match = register(passes[earlier].maps.at(i), surfaces, _guess(passes, pair), settings)
    return None if match is None else Found(*match, _sample(surfaces))


def _guess(passes: Sequence[Pass], pair: Pair) -> Array:
    earlier, i, later, j = pair
    first, second = passes[earlier].T_map_imu[i], passes[later].T_map_imu[j]
    return registration.rigid(registration.inverse(first) @ second)


def register_to_base(
    base: BaseCloud, number: int, passes: Sequence[Pass], settings: RevisitSettings
) -> Revisits:
    """Register all places to a cloud that stands: it has one anchor, at the origin, and this number as a drive."""

    def registered(place: tuple[int, int, small_gicp.PointCloud]) -> _Row | None:
        later, j, around = place
        surfaces = passes[later].maps.at(j)
        match = register(around, surfaces, np.eye(4), settings)
        if match is None:
            return None
        (T_here, covariance), T = match, passes[later].T_map_imu[j]
        anchors = 0, int(passes[later].anchors[j])
        return _Row(
            (number, later), anchors, registration.rigid(T @ T_here), covariance, _sample(surfaces), T
        )

    places = (
        (later, j, around)
        for later, drive in enumerate(passes)
        for j, T in enumerate(drive.T_map_imu)
        if (around := base.around(T)).size()
    )
    return _revisits([found for _, found in prefetch(registered, places, THREADS)])


class _Row(NamedTuple):
    drives: tuple[int, int]
    anchors: tuple[int, int]
    T: Array
    covariance: Array
    sample: tuple[Array, Array]
    guess: Array


def _revisits(results: Sequence[_Row | None]) -> Revisits:
    found = [one for one in results if one is not None]
    pairs = AnchorPairs(
        np.array([one.drives for one in found], np.intp).reshape(-1, 2),
        np.array([one.anchors for one in found], np.intp).reshape(-1, 2),
        np.array([one.T for one in found]).reshape(-1, 4, 4),
        np.array([one.covariance for one in found]).reshape(-1, 6, 6),
    )
    guesses = np.array([one.guess for one in found]).reshape(-1, 4, 4)
    return Revisits(pairs, guesses, [one.sample for one in found], len(results) - len(found))


def _sample(surfaces: small_gicp.PointCloud) -> tuple[Array, Array]:
    every = max(surfaces.size() // SAMPLED, 1)
    return np.asarray(surfaces.points())[::every, :3].copy(), normals(surfaces, every)


def register(
    first: small_gicp.PointCloud, second: small_gicp.PointCloud, guess: Array, settings: RevisitSettings
) -> tuple[Array, Array] | None:
    """T_first_second (4, 4) of two local maps and its covariance (6, 6); None where they do not match."""
    if not (first.size() and second.size()):
        return None
    T, results, voxels = guess, [], {}
    for edge_m, within_m, step_m in LEVELS:
        if edge_m not in voxels:
            voxels[edge_m] = small_gicp.GaussianVoxelMap(edge_m)
            voxels[edge_m].insert(first, np.eye(4))
        result = small_gicp.align(
            voxels[edge_m], second, T, max_correspondence_distance=within_m,
            max_iterations=registration.MAX_ITERATIONS, translation_epsilon=step_m,
        )  # fmt: skip
        T = registration.rigid(result.T_target_source)
        results.append(result)
    judged = results[JUDGED]
    if judged.num_inliers < settings.min_inlier_share * second.size():
        return None
    if not all(map(registration.has_converged, results[JUDGED:])):
        return None
    T, covariance, _ = registration.remap_solution(guess, T, judged, second, settings)
    least = np.repeat([settings.rotation_stddev_rad**2, settings.translation_stddev_m**2], 3)
    return T, (covariance + covariance.T) / 2 + np.diag(least)
