"""Vehicles in the map: which voxels are one (support by road), and, the paper's way, which of them moved."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numba import njit
from numpy.typing import NDArray
from pydantic import Field

from gnss_sem_map.dynamics.motion_state import Motion
from gnss_sem_map.labels.roles import Role
from gnss_sem_map.refinement.figures import Sums
from gnss_sem_map.refinement.state import (
    MapState,
    NotApplicable,
    StepSettings,
    VehicleObject,
    classes_of,
)
from gnss_sem_map.voxels.dbscan import NOISE, TIE, dbscan
from gnss_sem_map.voxels.tile_files import TILE_BITS
from gnss_sem_map.voxels.voxel_map import limits_of

LOWEST_M, HIGHEST_M = 0.1, 3.5
"""Heights over the ground between which a voxel may be a vehicle: lower is the ground, higher no truck reaches."""
REACH_M = 5.0
"""A car's length."""
REJECTED_NAT = 6.0
"""What the rules count against a voxel that they reject: odds of 400 to 1."""


class VehicleSettings(StepSettings):
    """What a vehicle looks like in the map."""

    method: Literal["evidence", "paper"] = Field(
        default="evidence", description="Support by road object by object, or eq. 12 and 13 of the paper."
    )
    eps_m: float = Field(
        default=0.5, gt=0, le=3, description="Voxels of one vehicle are at most this far apart, m (DBSCAN)."
    )
    min_voxels: int = Field(
        default=3,
        ge=1,
        description="A voxel with this many within `eps_m`, itself included, is inside a vehicle (DBSCAN).",
    )
    road_reach_m: float = Field(
        default=1.0, ge=0, description="A voxel is over road when road is this near in x and y, m."
    )
    road_share: float = Field(
        default=0.3, ge=0, le=1, description="A vehicle stands with more than this share over road."
    )
    largest_parked_voxels: int = Field(
        default=1500, ge=1, description="Method `paper`: a group of this many voxels moved (eta_D of eq. 13)."
    )
    longest_parked_m: float = Field(
        default=6.0, gt=0, description="Method `paper`: a group this long moved, m (eta_L of eq. 13)."
    )


def reach_m(settings: VehicleSettings, voxel_size_m: float) -> float:
    """Of a group of voxels that is longer, the part within reach is judged."""
    return REACH_M


def apply(state: MapState, settings: VehicleSettings) -> MapState:
    """Which voxels are vehicles, and, with `method: paper`, which of those moved (section 3.3.2)."""
    voxels = state.voxels
    vehicle, road = classes_of(voxels.label_set, Role.VEHICLE, Role.ROAD)
    vehicles = voxels.label_set.having(Role.VEHICLE)
    # one object may have voxels of several classes
    labels = np.where(np.isin(state.labels, vehicles), np.int8(vehicle), state.labels)
    if settings.method == "paper":
        found = paper(voxels.indices, labels, vehicle, road, settings, voxels.voxel_size_m)
        return replace(state, removed=state.removed | found.moving | found.rejected, vehicles=found.objects)
    if not state.figures.has_road:  # nothing is known of any vehicle: a camera that looks aside sees no road
        raise NotApplicable("the map has no road to stand on")
    found = supported(voxels.indices, labels, state.heights, vehicle, road, settings, voxels.voxel_size_m)
    scores = state.scores.copy()
    for one in vehicles:
        scores[found.rejected, one] -= np.float32(REJECTED_NAT)
    return replace(state, scores=scores, vehicles=found.objects)


def measure(state: MapState, settings: VehicleSettings, own: NDArray[np.bool_]) -> Sums:
    """How many of a map's `own` voxels (v,) are road."""
    (road,) = classes_of(state.voxels.label_set, Role.ROAD)
    return Sums(roads=int(np.count_nonzero(own & (state.labels == road))))


@dataclass(frozen=True, eq=False)
class VehicleDecision:
    """What the rules say about every voxel, and the objects that they found."""

    rejected: NDArray[np.bool_]
    """(v,) called vehicle, but are none."""
    moving: NDArray[np.bool_]
    """(v,) belong to something that moved."""
    objects: tuple[VehicleObject, ...]


def paper(
    indices: NDArray[np.int32], labels: NDArray[np.int8], vehicle: int, road: int, settings: VehicleSettings,
    voxel_size_m: float,
) -> VehicleDecision:  # fmt: skip
    """Eq. 12 and 13 to the letter: no vehicle without road in its column, and large or long groups moved.

    `indices` (v, 3) and `labels` (v,). A group's length is its extent along its principal axis in x and y;
    voxels that DBSCAN calls noise are no group and stay.
    """
    is_vehicle = labels == vehicle
    over_road = is_vehicle & _over(indices, indices[labels == road], reach_voxels=0.0)
    members = np.flatnonzero(over_road)
    clusters = dbscan(indices[members], settings.eps_m / voxel_size_m, settings.min_voxels)
    moving = np.zeros(len(labels), np.bool_)
    objects = []
    for number, group in enumerate(groups(clusters)):
        voxels = members[group]
        length = _length(indices[voxels]) * voxel_size_m
        moved = len(voxels) >= settings.largest_parked_voxels or length >= settings.longest_parked_m
        moving[voxels] = moved
        reason = f"{len(voxels)} voxels, {length:.1f} m long (eq. 13)"
        motion = Motion.MOVING if moved else Motion.PARKED
        objects.append(_describe(number, motion, reason, indices[voxels], length, voxel_size_m))
    return VehicleDecision(is_vehicle & ~over_road, moving, tuple(objects))


def supported(
    indices: NDArray[np.int32], labels: NDArray[np.int8], heights: NDArray[np.float32], vehicle: int, road: int,
    settings: VehicleSettings, voxel_size_m: float,
) -> VehicleDecision:  # fmt: skip
    """Road support by object: a vehicle stands as a whole on or beside road, and at a vehicle's height.

    `heights` (v,) m over ground. Eq. 12 asks every voxel for road in its own column, but under a parked car
    there is none: the car hides it. Here a group is a vehicle when enough of it is within `road_reach_m` of
    road.
    """
    is_vehicle = labels == vehicle
    at_height = (heights >= LOWEST_M) & (heights <= HIGHEST_M)
    members = np.flatnonzero(is_vehicle & at_height)
    over_road = _over(indices[members], indices[labels == road], settings.road_reach_m / voxel_size_m)
    clusters = dbscan(indices[members], settings.eps_m / voxel_size_m, settings.min_voxels)
    kept = np.zeros(len(labels), np.bool_)
    objects = []
    for number, group in enumerate(groups(clusters)):
        voxels, share = members[group], over_road[group].mean()
        stands = share > settings.road_share
        kept[voxels] = stands
        motion, reason = (
            Motion.UNKNOWN if stands else Motion.UNSUPPORTED,
            f"{share:.0%} of its voxels are over road",
        )
        length = _length(indices[voxels]) * voxel_size_m
        objects.append(_describe(number, motion, reason, indices[voxels], length, voxel_size_m))
    return VehicleDecision(is_vehicle & ~kept, np.zeros(len(labels), np.bool_), tuple(objects))


def _describe(
    number: int,
    motion: Motion,
    reason: str,
    indices: NDArray[np.int32],
    length_m: float,
    voxel_size_m: float,
) -> VehicleObject:
    centre = (indices.mean(axis=0) + 0.5) * voxel_size_m
    x, y = indices[:, :2].T >> TILE_BITS
    first = int(x.min()), int(y[x == x.min()].min())
    return VehicleObject(number, motion, reason, len(indices), centre, float(length_m), first)


def groups(clusters: NDArray[np.int32]) -> list[NDArray[np.int64]]:
    """The members of every cluster, noise left out."""
    order = np.argsort(clusters, kind="stable")
    starts = np.searchsorted(clusters[order], np.arange(clusters.max(initial=NOISE) + 1))
    return np.split(order, starts)[1:]


def _length(indices: NDArray[np.int32]) -> float:
    """Extent along the principal axis in x and y, in voxels; one voxel is one long."""
    xy = indices[:, :2] - indices[:, :2].mean(axis=0)
    along = xy @ np.linalg.eigh(xy.T @ xy)[1][:, -1]
    return float(np.ptp(along)) + 1.0


def _over(indices: NDArray[np.int32], road: NDArray[np.int32], reach_voxels: float) -> NDArray[np.bool_]:
    """Which voxels (v, 3) have a road voxel (r, 3) within a distance in x and y."""
    if len(indices) == 0 or len(road) == 0:
        return np.zeros(len(indices), np.bool_)
    reach = int(reach_voxels + TIE)
    x, y = (one.ravel() for one in np.meshgrid(*2 * [np.arange(-reach, reach + 1)], indexing="ij"))
    order = np.argsort(np.hypot(x, y), kind="stable")  # the nearest first: most have road there
    disc = np.stack([x, y], axis=1)[order][np.hypot(x, y)[order] <= reach_voxels + TIE]
    low, high = zip(limits_of(indices[:, :2]), limits_of(road[:, :2]), strict=True)
    origin = np.minimum(*low) - reach
    is_road = np.zeros(np.maximum(*high) - origin + reach + 1, np.bool_)
    is_road[tuple((road[:, :2] - origin).T)] = True
    found = np.zeros(len(indices), np.bool_)
    _near_marked(is_road, indices[:, :2] - origin, disc, found)
    return found


@njit(cache=True, nogil=True)
def _near_marked(marked, cells, offsets, found):
    """Which of the cells (n, 2) have a marked one at one of the offsets."""
    for i in range(len(cells)):
        for k in range(len(offsets)):
            if marked[cells[i, 0] + offsets[k, 0], cells[i, 1] + offsets[k, 1]]:
                found[i] = True
                break
