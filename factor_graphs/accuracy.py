"""How good a trajectory is: its error against a reference, and whether its covariance tells the truth."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from factor_graphs.chi_square import quantile
from factor_graphs.errors import MeasurementError
from factor_graphs.trajectory import Trajectory

Array = NDArray[np.float64]

# Ellipsoids in which errors are counted hold these shares of them when covariances are true.
SHARES = (0.5, 0.9, 0.95)


@dataclass(frozen=True, eq=False)
class Errors:
    """Error at every compared stamp: `position` (k, 3) m east, north, up; `rotation` (k, 3) rad about those."""

    stamps: Array
    position: Array
    rotation: Array

    @property
    def horizontal_rms_m(self) -> float:
        """Root mean square of the horizontal distance."""
        return _rms(self.position[:, :2])

    @property
    def vertical_rms_m(self) -> float:
        """Root mean square of the height error."""
        return _rms(self.position[:, 2:])

    @property
    def ate_m(self) -> float:
        """Absolute trajectory error: root mean square of the distance, nothing aligned (evo: APE, translation)."""
        return _rms(self.position)

    @property
    def heading_rms_deg(self) -> float:
        """Root mean square of the heading error."""
        return float(np.degrees(_rms(self.rotation[:, 2:])))

    @property
    def tilt_rms_deg(self) -> float:
        """Root mean square of roll and pitch error, per axis."""
        return float(np.degrees(_rms(self.rotation[:, :2]) / np.sqrt(2)))

    def within(self, spans: ArrayLike) -> "Errors":
        """Only the stamps inside any of the spans, (s, 2) s: inside outages, for example."""
        inside = np.zeros(len(self.stamps), dtype=bool)
        for first, last in np.reshape(np.asarray(spans, dtype=np.float64), (-1, 2)):
            inside |= (self.stamps >= first) & (self.stamps <= last)
        return Errors(self.stamps[inside], self.position[inside], self.rotation[inside])


def errors(estimate: Trajectory, reference: Trajectory) -> Errors:
    """The estimate against the reference, at the stamps of the reference that the estimate covers.

    Raises MeasurementError when they do not overlap.
    """
    shared = (reference.stamps >= estimate.start) & (reference.stamps <= estimate.end)
    if not shared.any():
        raise MeasurementError(
            f"estimate {estimate.start:.3f}..{estimate.end:.3f} s and reference "
            f"{reference.start:.3f}..{reference.end:.3f} s do not overlap"
        )
    stamps, wanted = reference.stamps[shared], reference.T_map_imu[shared]
    found = estimate.at(stamps)
    turned = Rotation.from_matrix(found[:, :3, :3] @ np.swapaxes(wanted[:, :3, :3], 1, 2)).as_rotvec()
    return Errors(stamps, found[:, :3, 3] - wanted[:, :3, 3], turned)


@dataclass(frozen=True)
class RelativeError:
    """Root mean square error of the motion over one step: metres, degrees, and metres per metre driven."""

    translation_m: float
    rotation_deg: float
    translation_share: float


def relative_error(estimate: Trajectory, reference: Trajectory, step: int = 1) -> RelativeError:
    """RPE: the motion between stamps `step` apart, estimate against reference (evo: RPE, delta in frames).

    Both are taken at the reference's stamps. Raises MeasurementError when fewer than `step` + 1 are shared.
    """
    stamps = reference.stamps[(reference.stamps >= estimate.start) & (reference.stamps <= estimate.end)]
    if step < 1 or len(stamps) <= step:
        raise MeasurementError(f"{len(stamps)} shared stamps; expected more than the step of {step}")
    moved = []
    for T in (estimate.at(stamps), reference.at(stamps)):
        moved.append(np.linalg.inv(T[:-step]) @ T[step:])
    off = np.linalg.inv(moved[1]) @ moved[0]
    distance = np.linalg.norm(moved[1][:, :3, 3], axis=1)
    angle = np.atleast_1d(Rotation.from_matrix(off[:, :3, :3]).magnitude())
    share = np.sqrt(np.sum(off[:, :3, 3] ** 2) / max(float(np.sum(distance**2)), 1e-12))
    return RelativeError(_rms(off[:, :3, 3]), float(np.degrees(_rms(angle[:, None]))), float(share))


def nees(error: ArrayLike, covariance: ArrayLike) -> Array:
    """Normalised estimation error squared of each error (n, d) under its covariance (n, d, d): (n,)."""
    e, P = np.asarray(error, dtype=np.float64), np.asarray(covariance, dtype=np.float64)
    solved = np.linalg.solve(P, e[..., None])[..., 0]
    return np.asarray(np.sum(e * solved, axis=-1), dtype=np.float64)


@dataclass(frozen=True, eq=False)
class PoseNees:
    """NEES of `position` (k,), 3 degrees of freedom, its `horizontal` part (k,), 2, and `orientation` (k,), 3."""

    position: Array
    horizontal: Array
    orientation: Array


def pose_nees(estimate: Trajectory, reference: Trajectory) -> PoseNees:
    """NEES of poses at the stamps that `errors` compares.

    The covariance is that of the nearest stamp of the estimate. Raises MeasurementError without covariances, or when
    the two do not overlap.
    """
    if estimate.covariances is None:
        raise MeasurementError("the estimate has no covariances: nothing says how large its errors may be")
    off = errors(estimate, reference)
    after = np.searchsorted(estimate.stamps, off.stamps).clip(max=len(estimate) - 1)
    before = np.maximum(after - 1, 0)
    nearer = off.stamps - estimate.stamps[before] < estimate.stamps[after] - off.stamps
    covariances = estimate.covariances[np.where(nearer, before, after)]
    R_map_imu = estimate.at(off.stamps)[:, :3, :3]  # covariances are in the axes of the imu
    rotation, position = (
        R_map_imu @ of_part @ np.swapaxes(R_map_imu, 1, 2)
        for of_part in (covariances[:, :3, :3], covariances[:, 3:, 3:])
    )
    return PoseNees(
        position=nees(off.position, position),
        horizontal=nees(off.position[:, :2], position[:, :2, :2]),
        orientation=nees(off.rotation, rotation),
    )


@dataclass(frozen=True)
class Coverage:
    """How true covariances are.

    `inside`: of the errors, the shares inside the ellipsoids that should hold SHARES of them. `scale_gap`: the median
    NEES over its expected value; above 1 the variances are so many times too small, below 1 too large.
    """

    inside: tuple[float, ...]
    scale_gap: float


def coverage(squares: ArrayLike, dof: int) -> Coverage:
    """How true covariances are, by the NEES (k,) of errors with `dof` degrees of freedom each."""
    found = np.asarray(squares, dtype=np.float64)
    inside = tuple(float(np.mean(found <= quantile(share, dof))) for share in SHARES)
    return Coverage(inside, float(np.median(found)) / quantile(0.5, dof))


def anees_band(dof: int, runs: int, confidence: float = 0.99) -> tuple[float, float]:
    """Where the mean NEES of independent runs must lie if the covariances are right (Bar-Shalom 2001, 5.4)."""
    tail = (1 - confidence) / 2
    return quantile(tail, dof * runs) / runs, quantile(1 - tail, dof * runs) / runs


def state_error(
    T: Array, velocity: Array, biases: Array, T_true: Array, velocity_true: Array, biases_true: Array
) -> Array:
    """The 15 errors of one state, truth minus estimate, in the order and axes of its covariance: (15,).

    Pose tangent (rotation, translation, in imu axes: T_true = T Exp(tangent), first order in translation),
    velocity in the map frame, accelerometer bias, gyroscope bias.
    """
    R = T[:3, :3]
    turn = Rotation.from_matrix(R.T @ T_true[:3, :3]).as_rotvec()
    move = R.T @ (T_true[:3, 3] - T[:3, 3])
    return np.concatenate([turn, move, velocity_true - velocity, biases_true - biases])


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.sum(np.square(values), axis=-1)))) if len(values) else float("nan")
