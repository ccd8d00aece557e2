"""Check of `T_imu_lidar`: the motion by LiDAR against the motion of the trajectory (hand-eye calibration).

Both sensors sit on one body: R_x turns every motion of the LiDAR into that of the IMU (hand-eye calibration). The way
driven tells its yaw and pitch, the ground its roll, turns tell all three and the lever arm, and the lengths a scale.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gnss_sem_map.errors import counted
from gnss_sem_map.preflight import scan_clock
from gnss_sem_map.preflight.findings import Finding, amber, green, red
from gnss_sem_map.preflight.lidar_motion import TURN_STDDEV_RAD, WAY_STDDEV_M, Stretch
from gnss_sem_map.preflight.sample import Sample
from gnss_sem_map.scans.deskew import EXTRAPOLATE_S
from gnss_sem_map.sensor_log import POSE_OF_LIDAR

Array = NDArray[np.float64]
GIVEN, NAME, LEVER, SCALE = (
    "T_imu_lidar",
    "T_imu_lidar rotation",
    "T_imu_lidar position",
    "scale of motion",
)
LONGEST_LEVER_M = 20.0
"""Longest vehicle on a road."""
LEAST_WAY_M, LEAST_TURN_RAD = 1.0, np.radians(3.0)
GROUND_STDDEV_RAD = np.radians(1.5)
"""How far roads and loaded vehicles tilt."""
HEADING_STDDEV_RAD = np.radians(0.5)
"""Of given poses, which say nothing of themselves."""
SAME_RAD, WRONG_RAD, SIGMAS = np.radians([4.0, 3.0, 3.0]), np.radians(10.0), 3.5
"""Differences that are no reason to warn, about x, y and z: good drives reach 2 deg, roads tilt by 2 to 3."""
SAME_SCALE, WRONG_SCALE = 0.1, 0.25
SCALES = {
    1000.0: "in mm",
    0.001: "in km",
    57.2958: "in degrees taken for radians",
    1 / 57.2958: "in radians taken for degrees",
}


@dataclass(frozen=True, eq=False)
class _Motions:
    """The same motions (n) of LiDAR and IMU: rotation vectors and ways; both from the first sweep of a stretch."""

    turns_lidar: Array
    ways_lidar: Array
    turns_imu: Array
    ways_imu: Array
    stamps: Array
    """(n, 2) s."""
    R_map_imu: Array
    """(n, 3, 3) at the first."""
    attitude_variances: Array
    """(n, 3) rad², about the axes of the imu."""


def check(sample: Sample) -> Iterator[Finding]:
    """Lever arm as a number, then scale, rotation and lever arm by motion."""
    for skip in sample.log.skips:
        if skip.what == POSE_OF_LIDAR:
            yield amber(
                GIVEN,
                skip.where,
                "the pose of the LiDAR is not given: taken as that of the IMU",
                "give T_imu_lidar in log.yaml",
            )
    p = sample.log.calibration.T_imu_lidar[:3, 3]
    length = float(np.linalg.norm(p))
    if length > LONGEST_LEVER_M:
        in_mm = length < 1000 * LONGEST_LEVER_M
        yield red(
            LEVER,
            f"the LiDAR is {length:.4g} m from the IMU, expected less than {LONGEST_LEVER_M:g} m",
            "T_imu_lidar is in mm" if in_mm else "the translation of T_imu_lidar is no length in metres",
            "give the translation of T_imu_lidar in metres",
        )
    if not sample.log.scans:
        return
    trajectory = sample.trajectory
    if trajectory is None or not sample.stretches:
        why = "no trajectory of the sample" if trajectory is None else "no scans in a row tell their motion"
        yield green(NAME, f"not observable: {why}")
        return
    motions = _motions(sample, sample.stretches)
    yield from _compare(sample, motions, p if length <= LONGEST_LEVER_M else np.zeros(3))


def _motions(sample: Sample, stretches: tuple[Stretch, ...]) -> _Motions:
    trajectory = sample.trajectory
    assert trajectory is not None
    ends = np.array([s.stamps[[0, -1]] for s in stretches])
    starts = trajectory.at(ends[:, 0], EXTRAPOLATE_S)
    imu = np.linalg.inv(starts) @ trajectory.at(ends[:, 1], EXTRAPOLATE_S)
    lidar = np.array([sample.deskewed(s)[0][-1] for s in stretches])
    variances = np.tile(HEADING_STDDEV_RAD**2 * np.ones(3), (len(ends), 1))
    if trajectory.covariances is not None:
        at = np.searchsorted(trajectory.stamps, ends[:, 0]).clip(0, len(trajectory) - 1)
        variances = np.diagonal(trajectory.covariances[at, :3, :3], axis1=1, axis2=2).copy()
    return _Motions(
        Rotation.from_matrix(lidar[:, :3, :3]).as_rotvec(),
        lidar[:, :3, 3],
        Rotation.from_matrix(imu[:, :3, :3]).as_rotvec(),
        imu[:, :3, 3],
        ends,
        starts[:, :3, :3],
        variances,
    )


def _compare(sample: Sample, motions: _Motions, p: Array) -> Iterator[Finding]:
    late = scan_clock.check(sample, p)
    if late is not None:
        yield late
        return
    R = sample.log.calibration.T_imu_lidar[:3, :3]
    ways = motions.ways_imu + _lever(motions.turns_imu) @ p
    lengths = np.linalg.norm(motions.ways_lidar, axis=1), np.linalg.norm(ways, axis=1)
    moved = np.maximum(*lengths) > LEAST_WAY_M
    if moved.any():
        scale = _scale(sample, lengths[0][moved], lengths[1][moved])
        yield scale
        if scale.mistake:
            return
    rotation, spread, seen = _rotation(sample, motions, ways, moved, R)
    turn = Rotation.from_matrix(rotation @ R.T).as_rotvec()
    yield _rotation_finding(sample, rotation, turn, spread, seen, R)
    if np.linalg.norm(turn) < WRONG_RAD:
        yield from _position(sample, motions, rotation, p)


def _scale(sample: Sample, by_lidar: Array, by_track: Array) -> Finding:
    ratios = np.log(np.maximum(by_track, 1e-6) / np.maximum(by_lidar, 1e-6))
    ratio, spread = float(np.median(ratios)), float(np.ptp(ratios))
    found = (
        f"the trajectory goes {np.exp(ratio):.3g} times as far as the LiDAR sees"
        f" ({counted(len(ratios), 'stretch', 'stretches')})"
    )
    what = sample.track_from
    if abs(ratio) <= SAME_SCALE or (abs(ratio) <= WRONG_SCALE and len(ratios) < 2):
        return green(SCALE, found)
    for factor, unit in SCALES.items():
        if abs(ratio - np.log(factor)) < SAME_SCALE + spread:
            return red(
                SCALE,
                found,
                f"{what} are {unit}",
                "give positions in metres, or latitude and longitude in degrees",
            )
    if abs(ratio + np.log(1000)) < 1 or abs(ratio - np.log(1000)) < 1:
        return red(SCALE, found, f"{what} or the points of the LiDAR are in mm", "give both in metres")
    return (red if abs(ratio) > WRONG_SCALE and spread < abs(ratio) else amber)(
        SCALE,
        found,
        f"{what} are of another scale, time or drive than the scans",
        "check the units and the stamps of the scans and of the positions",
    )


def _rotation(
    sample: Sample, motions: _Motions, ways: Array, moved: NDArray[np.bool_], R: Array
) -> tuple[Array, Array, list[str]]:
    """The rotation (3, 3) that fits best, its standard deviations (3,) about the imu's axes, and what it is seen by."""
    A, B, weights, seen = _directions(sample, motions, ways, moved, R)
    if len(A) < 1:
        return R, np.full(3, np.inf), seen
    # what nothing tells stays as given
    information = np.einsum("n,nij->ij", weights, np.eye(3) - B[:, :, None] * B[:, None, :])
    values, axes = np.linalg.eigh(information)
    known = values > 1 / np.radians(5.0) ** 2
    fitted = _wahba(A, B, weights, R)
    turn = Rotation.from_matrix(fitted @ R.T).as_rotvec()
    if not known.all():
        turn = axes[:, known] @ (axes[:, known].T @ turn)
    spread = np.sqrt(np.einsum("ij,j,ij->i", axes, 1 / np.maximum(values, 1e-9), axes))
    yaw_pitch = np.sqrt(motions.attitude_variances[:, 1:].max(axis=1))
    common = np.array([0.0, *np.repeat(np.median(yaw_pitch), 2)])
    return Rotation.from_rotvec(turn).as_matrix() @ R, np.hypot(spread, common), seen


def _directions(
    sample: Sample, motions: _Motions, ways: Array, moved: NDArray[np.bool_], R: Array
) -> tuple[Array, Array, Array, list[str]]:
    """Unit vectors (n, 3) that the LiDAR sees, the same in the imu frame, their weights (n,), and what they are."""
    a: list[Array] = []
    b: list[Array] = []
    variances: list[float] = []
    seen = []
    for k in np.flatnonzero(moved).tolist():
        way = float(np.linalg.norm(motions.ways_lidar[k]))
        a.append(motions.ways_lidar[k] / max(way, 1e-9))
        b.append(ways[k] / max(np.linalg.norm(ways[k]), 1e-9))
        variances.append((WAY_STDDEV_M / max(way, 1e-9)) ** 2)
    if moved.any():
        seen.append("the way driven")
    turning = np.linalg.norm(motions.turns_imu, axis=1)
    for k in np.flatnonzero(turning > LEAST_TURN_RAD).tolist():
        a.append(motions.turns_lidar[k] / max(np.linalg.norm(motions.turns_lidar[k]), 1e-9))
        b.append(motions.turns_imu[k] / turning[k])
        variances.append((TURN_STDDEV_RAD / turning[k]) ** 2)
    if (turning > LEAST_TURN_RAD).any():
        seen.append("turns")
    grounds = [(k, ground_normal(s, R)) for k, s in enumerate(sample.stretches)]
    for k, normal in grounds:
        if normal is not None:
            a.append(normal)
            b.append(_up(motions, ways, k, bool(moved[k]), R @ normal))
            variances.append(GROUND_STDDEV_RAD**2)
    if any(normal is not None for _, normal in grounds):
        seen.append("the ground")
    return np.array(a), np.array(b), 1 / np.array(variances), seen


def _wahba(a: Array, b: Array, weights: Array, R: Array) -> Array:
    """The rotation with b = R a (n, 3) best; a little of the given one where the vectors leave it open."""
    u, _, vt = np.linalg.svd(np.einsum("n,ni,nj->ij", weights, b, a) + 1e-3 * R)
    return np.asarray(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt)


def _up(motions: _Motions, ways: Array, k: int, moved: bool, near: Array) -> Array:
    """Away from the ground, in the imu frame: its own z or against gravity and across the way, whichever is nearer.

    A level unit tilts with the road, one that is mounted askew does not: gravity tells it.
    """
    z, up = np.array([0.0, 0.0, 1.0]), motions.R_map_imu[k][2].copy()
    if moved:
        way = ways[k] / np.linalg.norm(ways[k])
        up -= way * (way @ up)
        up /= np.linalg.norm(up)
    return z if abs(near @ z) > abs(near @ up) else up


def ground_normal(stretch: Stretch, R_imu_lidar: Array) -> Array | None:
    """Away from the road, in the lidar frame (3,); None where no plane is clearly the ground.

    The ground is the plane with hardly anything behind it that most of the near surfaces lie in; of a ground and a wall
    the one that the extrinsics put below.
    """
    sweep = stretch.sweeps[0]
    near = np.linalg.norm(sweep.p_lidar, axis=1) < 20.0
    p, n = sweep.p_lidar[near], sweep.normals[near]
    n = n * np.sign(-np.einsum("ij,ij->i", n, p))[:, None]  # towards the scanner
    usable = (n != 0).any(axis=1)
    p, n = p[usable], n[usable]
    if len(p) < 50:
        return None
    best, most = None, 0.0
    for seed in np.linspace(0, len(p) - 1, 60).astype(int):
        normal = n[seed]
        for _ in range(2):
            height = (p - p[seed]) @ normal
            inside = (np.abs(height) < 0.3) & (n @ normal > 0.9)
            if inside.sum() < 20:
                break
            offset = np.median(p[inside] @ normal)
            mean = n[inside].mean(axis=0)
            normal = mean / np.linalg.norm(mean)
        else:
            behind = float(((p @ normal) < offset - 0.5).mean())
            score = float(inside.mean()) * (1.0 if (R_imu_lidar @ normal)[2] > 0.7 else 0.7)
            if behind < 0.05 and -offset > 0.3 and score > most:
                best, most = normal, score
    return best if most > 0.1 else None


def _rotation_finding(
    sample: Sample, rotation: Array, turn: Array, spread: Array, seen: list[str], R: Array
) -> Finding:
    if not np.isfinite(spread).all() or not seen:
        return green(NAME, "not observable: the vehicle stood, and no ground was seen")
    deg, angle = np.degrees(turn), float(np.linalg.norm(turn))
    found = (
        f"{', '.join(seen)} of {counted(len(sample.stretches), 'stretch', 'stretches')} turn it by"
        f" {deg[0]:.1f}, {deg[1]:.1f}, {deg[2]:.1f} deg"
        f" about x, y, z (+- {', '.join(f'{v:.1f}' for v in np.degrees(spread))})"
    )
    if (np.abs(turn) <= np.maximum(SAME_RAD, SIGMAS * spread)).all():
        return green(NAME, found)
    given_inverse = float(Rotation.from_matrix(rotation @ R).magnitude())
    is_given = sample.log.given is not None and not sample.log.given_how
    matrix = "Tr in calib.txt" if is_given else "T_imu_lidar"
    main = int(np.argmax(np.abs(turn)))
    level = red if angle > WRONG_RAD or np.abs(turn).max() > 2 * SAME_RAD[main] else amber
    remedy = (
        "check Tr in calib.txt, and that poses.txt is of this sequence and in the camera frame"
        if is_given
        else "correct T_imu_lidar (KITTI: R of calib_imu_to_velo.txt, which is its inverse)"
    )
    if given_inverse < np.radians(5.0) and angle > np.radians(15.0):
        return level(NAME, found, f"{matrix} is inverted: it is turned the wrong way round", remedy)
    about = "xyz"[main] if abs(turn[main]) > 0.8 * angle else "a slanting axis"
    return level(NAME, found, f"{matrix} is turned by {np.degrees(angle):.0f} deg about {about}", remedy)


def _position(sample: Sample, motions: _Motions, rotation: Array, p: Array) -> Iterator[Finding]:
    """The lever arm that turns show: across their axis, where they are sharp enough."""
    turning = np.linalg.norm(motions.turns_imu, axis=1) > 3 * LEAST_TURN_RAD
    lever = _lever(motions.turns_imu)
    off = motions.ways_lidar @ rotation.T - motions.ways_imu - lever @ p
    if not turning.any():
        rest = np.sqrt(np.mean(np.sum(off**2, axis=1)))
        yield green(
            LEVER,
            f"{np.linalg.norm(p):.2f} m from the IMU; by motion not observable without turns (rest {rest:.2f} m)",
        )
        return
    J = lever[turning].reshape(-1, 3)
    track = np.repeat(np.linalg.norm(motions.ways_imu[turning], axis=1), 3)
    # a trajectory is off by some percent of the way, and by its heading
    stddevs = np.hypot(WAY_STDDEV_M, 0.04 * track)
    information = (J / stddevs[:, None] ** 2).T @ J
    values, axes = np.linalg.eigh(information)
    known = values > 1 / 0.5**2
    g = axes.T @ ((J / stddevs[:, None] ** 2).T @ off[turning].reshape(-1))
    shift = axes[:, known] @ (g[known] / values[known])
    sigma = np.sqrt(1 / values[known].min()) if known.any() else np.inf
    length = float(np.linalg.norm(shift))
    found = (
        f"turns put the LiDAR {length:.2f} +- {sigma:.2f} m from where T_imu_lidar has it"
        if known.any()
        else ("by motion not observable: no turn is sharp enough")
    )
    if not known.any() or length < max(0.7, SIGMAS * sigma):
        yield green(LEVER, found)
        return
    R = sample.log.calibration.T_imu_lidar[:3, :3]
    inverted = axes[:, known].T @ (-R.T @ p - p - shift)
    if float(np.linalg.norm(inverted)) < 0.5 * length:
        yield amber(
            LEVER, found, "T_imu_lidar is inverted: T_lidar_imu was given", "give the inverse of T_imu_lidar"
        )
        return
    yield amber(
        LEVER,
        found,
        "the translation of T_imu_lidar is wrong",
        "measure the LiDAR's place in the imu frame, m",
    )


def _lever(turns: Array) -> Array:
    """(n, 3, 3) with R_imu - 1 of each turn: what it does to a lever arm."""
    return np.asarray(Rotation.from_rotvec(turns).as_matrix() - np.eye(3))
