"""Surveyed points: control points hold the trajectory, check points judge it.

A point is where the antenna was, at a moment, or when the vehicle stood there. Points that do not fit a solution
without them are not held: another datum or exchanged columns would bend the trajectory.
"""

from dataclasses import dataclass
from functools import partial

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from factor_graphs.chi_square import BEYOND_DOUBT
from factor_graphs.constraints import STANDING_SPEED
from factor_graphs.covariances import keyframe_covariances
from factor_graphs.errors import MeasurementError
from factor_graphs.geodesy import LocalFrame
from factor_graphs.model import from_values
from factor_graphs.problem import CARRIED_S, Fit, Problem
from factor_graphs.side_measurements import Observed
from factor_graphs.trajectory import Trajectory

Array = NDArray[np.float64]

# A point fits where neither its nor the solution's standard deviations leave a doubt, per axis, and this, m.
LEAST_FITTING_M = 0.1
# A stop belongs to a point that is no farther from it than this, m.
FARTHEST_STOP_M = 5.0
# A drive has no points farther away than this, m.
FARTHEST_M = 100_000.0
# Stated by nobody: what a total station or a static receiver reaches, m.
USUAL_STDDEV_M = 0.02


@dataclass(frozen=True, eq=False)
class SurveyedPoints:
    """Where the antenna was, by a survey: points in the map frame.

    `names` (n,); `positions` (n, 3) m; `stddevs` (n, 3) m, positive; `stamps` (n,) s on the clock of the fixes, NaN:
    when it stood there; `control` (n,): whether a point holds the trajectory. Raises MeasurementError for other values,
    and for a point that is too far from the map's origin for any drive.
    """

    names: tuple[str, ...]
    positions: Array
    stddevs: Array
    stamps: Array
    control: NDArray[np.bool_]

    def __post_init__(self) -> None:
        if not (np.isfinite(self.positions).all() and (self.stddevs > 0).all()):
            raise MeasurementError("SurveyedPoints: expected finite positions and stddevs above 0")
        far = np.linalg.norm(self.positions, axis=1)
        if len(far) and far.max() > FARTHEST_M:
            raise MeasurementError(
                f"point {self.names[int(far.argmax())]} lies {far.max() / 1000:.0f} km from the drive, expected less"
                f" than {FARTHEST_M / 1000:.0f} km: are its columns exchanged, or of another CRS (epsg)?"
            )

    def __len__(self) -> int:
        return len(self.names)


@dataclass(frozen=True)
class PointResidual:
    """A surveyed point against the trajectory: estimated less surveyed, m; NaN where the drive was never there."""

    name: str
    kind: str
    used: bool
    stamp_s: float
    d_east_m: float
    d_north_m: float
    d_up_m: float


def to_points(
    table: dict[str, Array], names: tuple[str, ...], kinds: tuple[str, ...], frame: LocalFrame, where: str
) -> SurveyedPoints:
    """Points of the columns of a CSV file: lat_deg, lon_deg, alt_m, or easting_m, northing_m, height_m with epsg.

    Heights are above the ellipsoid. `stamp_s` and `std_e_m`, `std_n_m`, `std_u_m` may lack. Raises MeasurementError for
    other columns, a type that is neither control nor check, and as `SurveyedPoints` does.
    """
    if wrong := [kind for kind in kinds if kind not in ("control", "check")]:
        raise MeasurementError(f"{where}: found type {wrong[0]!r}, expected control or check")
    nothing = np.full(len(names), np.nan)
    stddevs = np.column_stack([table.get(f"std_{axis}_m", nothing) for axis in "enu"])
    try:
        lat, lon, up = _geodetic(table)
        positions = frame.to_map(lat, lon, up)
        return SurveyedPoints(
            names, positions, np.where(np.isnan(stddevs), USUAL_STDDEV_M, stddevs), table.get("stamp_s", nothing),
            np.array([kind == "control" for kind in kinds]),
        )  # fmt: skip
    except KeyError as error:
        raise MeasurementError(
            f"{where}: column {error.args[0]} is missing; expected lat_deg, lon_deg, alt_m, or easting_m, northing_m,"
            " height_m and epsg"
        ) from None
    except MeasurementError as error:
        raise MeasurementError(f"{where}: {error}") from None


def _geodetic(table: dict[str, Array]) -> tuple[Array, Array, Array]:
    from pyproj import Transformer
    from pyproj.exceptions import CRSError

    if "lat_deg" in table:
        return table["lat_deg"], table["lon_deg"], table["alt_m"]
    east, north, codes = table["easting_m"], table["northing_m"], table["epsg"]
    lat, lon = np.empty(len(east)), np.empty(len(east))
    for code in np.unique(codes):
        rows = codes == code
        try:
            to_wgs84 = Transformer.from_crs(int(code), 4326, always_xy=True)
        except (CRSError, ValueError):
            raise MeasurementError(
                f"found epsg {code:g}, expected the EPSG code of a projected CRS"
            ) from None
        lon[rows], lat[rows] = to_wgs84.transform(east[rows], north[rows])
    if not (np.isfinite(lat).all() and np.isfinite(lon).all()):
        raise MeasurementError("a point lies outside its CRS: are easting_m and northing_m exchanged?")
    return lat, lon, table["height_m"]


def observe_points(points: SurveyedPoints, problem: Problem, fit: Fit) -> Observed:
    """What a solution by the fixes shows of points, their stamps on the clock of the IMU."""
    at, late = _keyframes(points, problem, fit, points.stamps)
    there = np.flatnonzero(at >= 0)
    off = _off(points, problem, fit, at, late)
    fits = np.zeros(len(points), np.bool_)
    if len(there):
        covariances, _ = keyframe_covariances(fit.graph, fit.values, len(problem.intervals.keyframes))
        R = from_values(fit.values, len(covariances))[0][at[there], :3, :3]
        of_place = np.einsum("kij,kjl,kil->ki", R, covariances[at[there], 3:6, 3:6], R)
        limits = BEYOND_DOUBT * np.sqrt(of_place + points.stddevs[there] ** 2) + LEAST_FITTING_M
        fits[there] = (np.abs(off[there]) < limits).all(axis=1)
    held = points.control & fits
    stamps = problem.intervals.keyframes[at] + late
    known = SurveyedPoints(
        points.names, points.positions, points.stddevs, np.where(at >= 0, stamps, np.nan), points.control
    )
    verdict = f"surveyed points: {held.sum()} of {points.control.sum()} control points hold the trajectory, "
    verdict += f"{np.sum(~points.control)} check points"
    if len(there) < len(points):
        verdict += f"; {len(points) - len(there)} of a time or place without the drive"
    if not len(there) and not np.isfinite(points.stamps).any():
        nearest = np.min(cKDTree(_antennas(problem, fit)[:, :2]).query(points.positions[:, :2])[0])
        verdict += f", the nearest lies {nearest:.0f} m from the way: of another datum, CRS or drive?"
    if not fits[there].all():
        verdict += f"; {_mistake(points, off, there[~fits[there]], len(there))}"
    factors = partial(_factors, known, problem, np.flatnonzero(held), at, late)
    doubtful = len(there) < len(points) or not fits[there].all()
    return Observed(verdict, factors, doubtful, points=(known, held))


def residuals_of(
    known: SurveyedPoints,
    held: NDArray[np.bool_],
    keyframes: Trajectory,
    p_imu_antenna: Array,
) -> tuple[PointResidual, ...]:
    """The points against a trajectory; `known` are those with the moments that were found, `held` (n,) those used."""
    rows = []
    for n, name in enumerate(known.names):
        d, stamp = np.full(3, np.nan), float(known.stamps[n])
        if keyframes.start <= stamp <= keyframes.end:
            T = keyframes.at([stamp])[0]
            d = T[:3, 3] + T[:3, :3] @ p_imu_antenna - known.positions[n]
        kind = "control" if known.control[n] else "check"
        rows.append(PointResidual(name, kind, bool(held[n]), stamp, *map(float, d)))
    return tuple(rows)


def _keyframes(
    points: SurveyedPoints, problem: Problem, fit: Fit, stamps: Array
) -> tuple[NDArray[np.intp], Array]:
    """The keyframe (n,) of every point, -1 for none, and how late (n,) s it was there."""
    keyframes = problem.intervals.keyframes
    velocities = from_values(fit.values, len(keyframes))[1]
    antennas = _antennas(problem, fit)
    stands = np.flatnonzero(np.linalg.norm(velocities, axis=1) < STANDING_SPEED)
    at, late = np.full(len(points), -1), np.zeros(len(points))
    for n, stamp in enumerate(stamps.tolist()):
        if np.isfinite(stamp):
            nearest = int(np.abs(keyframes - stamp).argmin())
            if abs(stamp - keyframes[nearest]) <= CARRIED_S:
                at[n], late[n] = nearest, stamp - keyframes[nearest]
        elif len(stands):
            distances = np.linalg.norm((antennas[stands] - points.positions[n])[:, :2], axis=1)
            if distances.min() < FARTHEST_STOP_M:
                at[n] = stands[distances.argmin()]
    return at, late


def _antennas(problem: Problem, fit: Fit) -> Array:
    """Where the antenna was at the keyframes, (k, 3) m."""
    T = from_values(fit.values, len(problem.intervals.keyframes))[0]
    return np.asarray(T[:, :3, 3] + T[:, :3, :3] @ problem.p_imu_antenna)


def _off(points: SurveyedPoints, problem: Problem, fit: Fit, at: NDArray[np.intp], late: Array) -> Array:
    """Estimated less surveyed, (n, 3) m; at keyframe -1 of no meaning."""
    velocities = from_values(fit.values, len(problem.intervals.keyframes))[1]
    return np.asarray(_antennas(problem, fit)[at] + velocities[at] * late[:, None] - points.positions)


def _mistake(points: SurveyedPoints, off: Array, unfit: NDArray[np.intp], n: int) -> str:
    """What points that do not fit are, of n."""
    names = ", ".join(points.names[k] for k in unfit[:5])
    if len(unfit) < 2 or 2 * len(unfit) < n:
        east, north, up = off[unfit[0]]
        by = f"{east:+.2f} east, {north:+.2f} north, {up:+.2f} up m"
        return f"{names} not fitting (the first is off by {by}): not held"
    middle = np.median(off[unfit], axis=0)
    alike = np.abs(off[unfit] - middle).max() < max(0.1 * np.abs(middle).max(), LEAST_FITTING_M)
    swapped = off[unfit] + points.positions[unfit] - points.positions[unfit][:, [1, 0, 2]]
    text = f"{len(unfit)} of {n} do not fit and are not held, {middle[0]:+.2f} east, {middle[1]:+.2f} north"
    text += f", {middle[2]:+.2f} up m in the middle"
    if np.abs(swapped[:, :2]).max() < 0.1 * np.abs(off[unfit, :2]).max():
        return f"{text}: are their east and north exchanged?"
    if alike and np.abs(middle[2]) > 10 * np.abs(middle[:2]).max():
        return f"{text}: are their heights above the geoid, not the ellipsoid?"
    return f"{text}: " + ("of another datum or CRS?" if alike else "of another drive or CRS?")


def _factors(
    known: SurveyedPoints,
    problem: Problem,
    rows: NDArray[np.intp],
    at: NDArray[np.intp],
    late: Array,
    fit: Fit,
) -> list[gtsam.NonlinearFactor]:
    """Every control point that is held holds the antenna of its keyframe."""
    velocities = from_values(fit.values, len(problem.intervals.keyframes))[1]
    places = known.positions - velocities[at] * late[:, None]
    return [
        gtsam.GPSFactorArm(
            X(int(at[n])),
            places[n],
            problem.p_imu_antenna,
            gtsam.noiseModel.Diagonal.Sigmas(known.stddevs[n]),
        )
        for n in rows.tolist()
    ]
