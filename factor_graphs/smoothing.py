"""The batch smoother: IMU, GNSS and what else there is in, the most probable trajectory out, with covariance."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from factor_graphs.alignment import AttitudePrior
from factor_graphs.antenna_heading import observe_headings
from factor_graphs.calibration import Calibration, in_order, scale_error, upright_axis
from factor_graphs.clock_check import checked, stamps_are_ends
from factor_graphs.condensing import CondensedDrive, condense
from factor_graphs.consistent_fixes import with_consistent_fixes
from factor_graphs.covariances import keyframe_covariances
from factor_graphs.dense import densify
from factor_graphs.doubts import correlation, doubts
from factor_graphs.errors import MeasurementError
from factor_graphs.fitting import (
    calibrate,
    fit_noise,
    fit_noise_by_components,
    reject,
)
from factor_graphs.geodesy import LocalFrame
from factor_graphs.gnss_velocity import observe_velocities
from factor_graphs.gyroscope_bias import large_gyroscope_bias
from factor_graphs.heading import of_any_heading, stddevs_of_heading, turned_to, with_heading
from factor_graphs.held_constraints import constrain, hold_beside
from factor_graphs.measurements import (
    AntennaHeadings,
    GnssFixes,
    GnssVelocities,
    ImuNoise,
    ImuSamples,
    WheelSpeeds,
    measured,
)
from factor_graphs.model import from_values
from factor_graphs.problem import (
    NOWHERE,
    REJECTION,
    RELATIVE_REJECTION,
    Fit,
    Problem,
    fit_as_expected,
    pose_problem,
)
from factor_graphs.relative_poses import NO_RELATIVE_POSES, RelativePoses
from factor_graphs.screening import are_drifting, are_new
from factor_graphs.separation import Separation, separation_of
from factor_graphs.settings import SmootherSettings as SmootherSettings
from factor_graphs.side_measurements import Observed
from factor_graphs.surveyed_points import (
    PointResidual,
    SurveyedPoints,
    observe_points,
    residuals_of,
)
from factor_graphs.trajectory import Trajectory
from factor_graphs.variance import BiasSteps, imu_noise_shown
from factor_graphs.vehicle import Vehicle
from factor_graphs.wheels import Wheels

Array = NDArray[np.float64]

Also = GnssVelocities | AntennaHeadings | SurveyedPoints
"""What may be known beside IMU and fixes."""

# A fix with less weight than this is taken for an outlier.
HALF = 0.5
# So far apart are the poses of a solution in short, s.
IN_SHORT_S = 0.1
# The scale of the gyroscope is corrected so many times at most: the first time, the noise of the IMU is not right yet.
SCALE_ROUNDS = 4


@dataclass(frozen=True, eq=False)
class Solution:
    """What the smoother found, and how far to believe it.

    `trajectory`: dense, at every IMU stamp; `keyframes` (k): the graph's own states; `biases` (k, 6), accelerometer
    m/s² then gyroscope rad/s; `state_covariances` (k, 15, 15) of (pose tangent, velocity, biases) as the graph has
    them: with the fixes of an inertial unit, which drift together, `keyframes` and `trajectory` say more. For every
    fix given (m,): `fix_weights`, from 0 to 1; `fix_residuals` (m, 3) m, fix minus antenna, NaN outside the IMU's
    span; `rejected`: does not fit or could not be used. For every relative pose given (r,): `relative_weights` and
    `relative_rejected`, likewise. `chi2_per_dof` is about 1 when the standard deviations are honest. `imu_noise` is
    the noise used, `inflation` times the one expected, its walk aside; fixes have `fix_inflation` times the
    standard deviations that they say; `calibration` the time offset and lever arm used; `vehicle` how the IMU sits
    on it and what its axle slides, None where the vehicle constraint was not asked for or LiDAR odometry took its
    place; `wheels` scale, offset, latency and slip of the wheels, None where none were given or asked for;
    `condensed` the drive in short, None where it was not asked for; `beside` what became of measurements beside IMU
    and fixes, in words; `points` the surveyed points against the trajectory; `notes` says in words what was
    repaired or is in doubt; `separation` of forward and backward solution, None where it was not asked for.
    """

    trajectory: Trajectory
    keyframes: Trajectory
    biases: Array
    state_covariances: Array
    fix_weights: Array
    fix_residuals: Array
    rejected: NDArray[np.bool_]
    relative_weights: Array
    relative_rejected: NDArray[np.bool_]
    chi2_per_dof: float
    inflation: float
    fix_inflation: float
    imu_noise: ImuNoise
    calibration: Calibration
    iterations: int
    vehicle: Vehicle | None = None
    wheels: Wheels | None = None
    condensed: CondensedDrive | None = None
    beside: tuple[str, ...] = ()
    points: tuple[PointResidual, ...] = ()
    notes: tuple[str, ...] = ()
    separation: Separation | None = None

    @property
    def outside_imu(self) -> NDArray[np.bool_]:
        """Which of the fixes given (m,) are of a time without IMU: not used, and `rejected` for no fault of theirs."""
        return np.asarray(np.isnan(self.fix_residuals[:, 0]))

    def in_short(self) -> "Solution":
        """The same with ten poses a second, enough for a plot, and without the covariances of the states."""
        stamps = self.trajectory.stamps
        rows = np.searchsorted(stamps, np.arange(stamps[0], stamps[-1], IN_SHORT_S))
        rows = np.unique([*rows.tolist(), len(stamps) - 1])
        return replace(self, trajectory=self.trajectory[rows], state_covariances=np.empty((0, 15, 15)))


def smooth(
    imu: ImuSamples,
    fixes: GnssFixes,
    frame: LocalFrame,
    settings: SmootherSettings | None = None,
    p_imu_antenna: ArrayLike = (0.0, 0.0, 0.0),
    initial_attitude: AttitudePrior | None = None,
    relative_poses: RelativePoses | None = None,
    wheels: WheelSpeeds | None = None,
    condensed: bool = False,
    also: Sequence[Also] = (),
) -> Solution:
    """Estimate the trajectory of a road vehicle from its IMU and GNSS fixes.

    `p_imu_antenna` (3,) m is the lever arm. `initial_attitude` is what is known of the attitude at the first IMU
    stamp, `relative_poses` how the vehicle moved between moments (LiDAR odometry or the like), `wheels` how fast
    its wheels rolled, `also` what else the receiver says; none of them need be given. What fills gaps of the IMU
    with straight lines is not believed. With `condensed` the solution says what is needed to bind it to other
    drives or to itself (`sessions.bind`). Raises MeasurementError with fewer than three usable fixes, and
    EstimationError when the optimiser stops at its limit.
    """
    settings, relative = settings or SmootherSettings(), relative_poses or NO_RELATIVE_POSES
    given = np.asarray(p_imu_antenna, dtype=np.float64)
    if given.shape != (3,) or not np.isfinite(given).all():
        raise MeasurementError(f"p_imu_antenna is {given.tolist()}; expected three finite values, m")
    inertial = _Inertial.of(imu, fixes, settings)
    log = _Log(fixes, frame, settings, given, initial_attitude, relative, wheels, also)
    for _ in range(SCALE_ROUNDS):
        problem, held, calibration, beside, inertial = log.solved(inertial)
        is_asked = calibration.scale_in_question and not problem.is_bound
        scale = scale_error(problem, held.fit) if is_asked else 0.0
        if scale == 0.0:
            break
        inertial = inertial.scaled(scale)
    found = _solution(problem, held, fixes, replace(calibration, gyroscope_scale=inertial.scale))
    found = replace(
        found,
        biases=found.biases + np.append(np.zeros(3), inertial.bias),
        points=_point_residuals(beside, found.keyframes, calibration),
        beside=tuple(one.verdict for one in beside),
        notes=(*inertial.notes(), *found.notes, *(one.verdict for one in beside if one.doubtful)),
    )
    if settings.forward_backward:
        graph, values = held.fit.graph, held.fit.values
        found = replace(found, separation=separation_of(graph, values, found.keyframes.stamps, problem.noise))
    if not condensed:
        return found
    R = found.keyframes.T_map_imu[:, :3, :3]
    lacking = _lacking(problem, fixes[problem.used], held.covariances[:, :6, :6], R)
    return replace(found, condensed=condense(problem, held.fit, lacking))


@dataclass(frozen=True, eq=False)
class _Log:
    """What is known beside the IMU."""

    fixes: GnssFixes
    frame: LocalFrame
    settings: SmootherSettings
    given: Array
    """The lever arm (3,) m as the user gave it."""
    attitude: AttitudePrior | None
    relative: RelativePoses
    wheels: WheelSpeeds | None
    also: Sequence[Also]

    def solved(
        self, inertial: "_Inertial"
    ) -> tuple[Problem, "_Constrained", Calibration, list[Observed], "_Inertial"]:
        """The solution with all that is held in it; the IMU's samples, their stamps moved where they are ends."""
        problem, fit, estimated = self._calibrated(inertial)
        if self.settings.imu_sample_instant is None and stamps_are_ends(estimated, inertial.samples):
            inertial = inertial.at_middle()
            problem, fit, estimated = self._calibrated(inertial)
        of_noise, fitting = max(fit.inflation, problem.of_fixes), self.fixes[problem.used][fit.weights > HALF]
        stepped = replace(
            fitting, stamps=in_order(replace(estimated, time_offset_s=0.0).on_imu_clock(fitting.stamps))
        )
        calibration = checked(estimated, inertial.samples, stepped, of_noise)
        if calibration.refused:
            problem, fit = self._fit_to(inertial, calibration)
        beside = [_observe(one, problem, fit, calibration) for one in self.also]
        problem, fit = turned_to(problem, fit, sum(one.turn for one in beside))
        return problem, _constrained(problem, fit, self.wheels, beside), calibration, beside, inertial

    def _calibrated(self, inertial: "_Inertial") -> tuple[Problem, Fit, Calibration]:
        return calibrate(partial(self._fit_to, inertial), self.settings, self.given)

    def _fit_to(
        self, inertial: "_Inertial", calibration: Calibration, all_fixes: bool = False
    ) -> tuple[Problem, Fit]:
        shifted = replace(self.fixes, stamps=in_order(calibration.on_imu_clock(self.fixes.stamps)))
        also_at = np.concatenate([NOWHERE, *(calibration.on_imu_clock(one.stamps) for one in self.also)])

        def pose(some: GnssFixes) -> Problem:
            lever, known = calibration.p_imu_antenna, (self.attitude, self.relative, also_at)
            return pose_problem(inertial.samples, some, self.frame, self.settings, lever, *known)

        if all_fixes:
            return (posed := with_heading(pose(shifted))), fit_as_expected(posed)
        return fit_noise(with_heading(with_consistent_fixes(pose(shifted), shifted, pose)))


@dataclass(frozen=True, eq=False)
class _Inertial:
    """The samples of the IMU as the graph has them, and what was done to them."""

    samples: ImuSamples
    filled: int
    """So many samples filled gaps."""
    bias: Array
    """(3,) rad/s, taken from the gyroscope."""
    are_ends: bool = False
    """The fixes show that the stamps were the ends of intervals."""
    scale: float = 0.0
    """The gyroscope turned by this share too much about its upright axis: taken out."""

    @classmethod
    def of(cls, imu: ImuSamples, fixes: GnssFixes, settings: SmootherSettings) -> "_Inertial":
        samples = measured(imu)
        filled, bias = len(imu) - len(samples), large_gyroscope_bias(samples, fixes[are_new(fixes)])
        if bias.any():
            samples = ImuSamples(samples.stamps, samples.specific_force, samples.angular_rate - bias)
        return cls(samples.at_middle() if settings.imu_sample_instant == "end" else samples, filled, bias)

    def at_middle(self) -> "_Inertial":
        """The same with stamps that are found to be ends moved to the middle."""
        return replace(self, samples=self.samples.at_middle(), are_ends=True)

    def scaled(self, error: float) -> "_Inertial":
        """The same with another error of the gyroscope's scale taken out."""
        imu, rates = self.samples, self.samples.angular_rate.copy()
        rates[:, upright_axis(imu.specific_force)] /= 1 + error
        samples = ImuSamples(imu.stamps, imu.specific_force, rates)
        return replace(self, samples=samples, scale=(1 + error) * (1 + self.scale) - 1)

    def notes(self) -> Iterator[str]:
        """In words."""
        if self.scale:
            axis = "xyz"[upright_axis(self.samples.specific_force)]
            yield f"the gyroscope turns by {100 * self.scale:+.2f} % too much about its {axis} axis: taken out"
        if self.are_ends:
            yield "stamps of the IMU are the ends of its intervals, as the fixes show (imu_sample_instant: end)"
        if self.filled:
            count = self.filled + len(self.samples)
            yield f"{self.filled} of {count} samples of the IMU fill gaps with straight lines: not believed"
        if self.bias.any():
            said = ", ".join(f"{value:.2f}" for value in np.degrees(self.bias))
            yield f"the gyroscope turns by ({said}) deg/s at rest: taken out"


@dataclass(frozen=True, eq=False)
class _Constrained:
    """The fit with all that is held in it, covariances (k, 15, 15) of its states and of what all of them share."""

    fit: Fit
    vehicle: Vehicle | None
    wheels: Wheels | None
    covariances: Array
    of_shared: Array


def _constrained(
    problem: Problem, fit: Fit, speeds: WheelSpeeds | None, beside: Sequence[Observed]
) -> _Constrained:
    """Hold vehicle, wheels and all measurements beside the fixes, and reject what does not fit.

    Where the IMU then shows other noise than it is believed to have, the noise is estimated, by the fixes alone, and
    everything is held again.
    """
    may_inflate = problem.settings.inflate_imu_noise and len(problem.relative) == 0
    by_fixes, k = fit, len(problem.intervals.keyframes)
    for is_last in (not may_inflate, True):
        held = hold_beside(problem, by_fixes, beside)
        fit, constraints, vehicle, wheels = constrain(problem, held, speeds, beside)
        fit, steps = reject(problem, fit, constraints), BiasSteps(k)
        covariances, of_shared = keyframe_covariances(fit.graph, fit.values, k, None if is_last else steps)
        if is_last or imu_noise_shown(problem, fit, covariances, steps) == (fit.inflation, fit.of_walk):
            break
        by_fixes = fit_noise_by_components(problem, by_fixes)
    return _Constrained(fit, vehicle, wheels, covariances, of_shared)


def _point_residuals(
    beside: Sequence[Observed], keyframes: Trajectory, calibration: Calibration
) -> tuple[PointResidual, ...]:
    """Of all surveyed points."""
    placed = [one.points for one in beside if one.points is not None]
    return tuple(
        residual for one in placed for residual in residuals_of(*one, keyframes, calibration.p_imu_antenna)
    )


def _observe(one: Also, problem: Problem, fit: Fit, calibration: Calibration) -> Observed:
    stamps = calibration.on_imu_clock(one.stamps)
    if isinstance(one, SurveyedPoints):
        return observe_points(replace(one, stamps=stamps), problem, fit)
    if isinstance(one, AntennaHeadings):
        return observe_headings(replace(one, stamps=in_order(stamps)), problem, fit)
    return observe_velocities(replace(one, stamps=in_order(stamps)), problem, fit)


def _solution(problem: Problem, held: _Constrained, fixes: GnssFixes, calibration: Calibration) -> Solution:
    fit, vehicle, wheels, covariances = held.fit, held.vehicle, held.wheels, held.covariances
    T, velocities, biases = from_values(fit.values, len(problem.intervals.keyframes))
    shared_stddevs = np.sqrt(held.of_shared.diagonal())
    if vehicle is not None and vehicle.held:
        vehicle = replace(vehicle, mounting_stddevs=shared_stddevs[:5])
    if wheels is not None and wheels.held:
        wheels = replace(wheels, stddevs=shared_stddevs[-4:])
    R, of_poses = T[:, :3, :3], covariances[:, :6, :6].copy()
    of_poses[:, 3:, 3:] += np.swapaxes(R, 1, 2) * _lacking(problem, fixes[problem.used], of_poses, R) @ R
    of_poses += _of_calibration(calibration, problem.settings, problem.intervals.keyframes, R, velocities)
    if problem.heading_in_doubt:
        of_poses += of_any_heading(R, problem.p_imu_antenna)
    keyframes = Trajectory(problem.intervals.keyframes, T, velocities, of_poses)
    noise = problem.noise.scaled(fit.inflation, fit.of_walk)
    trajectory = densify(problem.intervals, keyframes, biases, problem.intervals.noise(noise), problem.frame)
    weights, rejected = np.zeros(len(fixes)), ~problem.used
    weights[problem.used], rejected[problem.used] = fit.weights, fit.squares > REJECTION
    residuals = _residuals(keyframes, fixes, calibration)
    relative_weights, relative_rejected = np.zeros(len(problem.relative_used)), ~problem.relative_used
    relative_weights[problem.relative_used] = fit.relative_weights
    relative_rejected[problem.relative_used] = fit.relative_squares > RELATIVE_REJECTION
    return Solution(
        trajectory=trajectory,
        keyframes=keyframes,
        biases=biases,
        state_covariances=covariances,
        fix_weights=weights,
        fix_residuals=residuals,
        rejected=rejected,
        relative_weights=relative_weights,
        relative_rejected=relative_rejected,
        chi2_per_dof=fit.chi2_per_dof,
        inflation=fit.inflation,
        fix_inflation=problem.of_fixes,
        imu_noise=noise,
        calibration=calibration,
        iterations=fit.iterations,
        vehicle=vehicle,
        wheels=wheels,
        notes=(
            *problem.notes,
            *doubts(problem, fit, keyframes, calibration),
            *correlation(problem, fit, fixes[problem.used], residuals[problem.used]),
        ),
    )


def _of_calibration(
    calibration: Calibration, settings: SmootherSettings, stamps: Array, R_map_imu: Array, velocities: Array
) -> Array:
    """Covariance (k, 6, 6) that poses have of what was estimated beside them: clock and lever arm.

    Where the clock is d s off, the trajectory is so much further on its way; where the antenna is dl m off, so is it.
    """
    covariances, of_clock = np.zeros((len(stamps), 6, 6)), np.zeros(len(stamps))
    if settings.estimate_time_offset or calibration.time_offset_s or calibration.refused:
        of_clock += (calibration.time_offset_stddev_s or 0.0) ** 2
    for begin, _, stddev in calibration.clock_steps:
        of_clock[stamps >= begin] += stddev**2
    in_imu = np.einsum("kij,ki->kj", R_map_imu, velocities) * np.sqrt(of_clock)[:, None]
    covariances[:, 3:, 3:] += in_imu[:, :, None] * in_imu[:, None]
    if calibration.p_imu_antenna_stddevs is not None:
        covariances[:, 3:, 3:] += np.diag(calibration.p_imu_antenna_stddevs**2)
    return covariances


def _lacking(problem: Problem, fixes: GnssFixes, covariances: Array, R_map_imu: Array) -> Array:
    """Variance (3,) m² by which all poses, of covariances (k, 6, 6), may be wrong together beside them.

    Fixes that drift together are wrong together: the more of them, the better the shape, not the place. So the track is
    nowhere better placed than by one fix. What its best placed keyframe lacks in variance of a fix, all of them lack:
    so their differences stay as sure as they are.
    """
    common = np.square(problem.common_stddevs)
    if not are_drifting(fixes):
        return common
    in_map = np.einsum("kij,kjl,kil->ki", R_map_imu, covariances[:, 3:, 3:], R_map_imu)
    lacking: Array = np.maximum(np.median(fixes.stddevs, axis=0) ** 2 - in_map.min(axis=0), 0.0)
    return lacking + common


def _residuals(keyframes: Trajectory, fixes: GnssFixes, calibration: Calibration) -> Array:
    stamps = calibration.on_imu_clock(fixes.stamps)
    inside = (stamps >= keyframes.start) & (stamps <= keyframes.end)
    T = keyframes.at(stamps[inside])
    off = np.full((len(fixes), 3), np.nan)
    off[inside] = fixes.positions[inside] - T[:, :3, 3] - T[:, :3, :3] @ calibration.p_imu_antenna
    return off


def heading_stddevs(trajectory: Trajectory) -> Array:
    """Standard deviation of the heading, (k,) rad."""
    assert trajectory.covariances is not None
    return stddevs_of_heading(trajectory.T_map_imu[:, :3, :3], trajectory.covariances)
