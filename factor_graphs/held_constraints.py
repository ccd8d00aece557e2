"""What a road vehicle cannot do, and what its wheels say, held in the graph, linearised until that is good enough."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import M, W
from numpy.typing import NDArray

from factor_graphs.constraints import (
    CREEPING_SPEED,
    creeping,
    non_holonomic_factors,
    quiet_intervals,
    resting,
    standing,
)
from factor_graphs.covariances import keyframe_covariances
from factor_graphs.fitting import FITTING_CHI2, fit_noise_from
from factor_graphs.heading import stddevs_of_heading
from factor_graphs.measurements import WheelSpeeds
from factor_graphs.model import from_values, zero_motion_factors, zero_velocity_factors
from factor_graphs.problem import RELATIVE_TOLERANCE, ROUGH, Fit, Problem
from factor_graphs.side_measurements import Observed, factors_of
from factor_graphs.slip import Slip
from factor_graphs.slip_variance import found_slip
from factor_graphs.vehicle import BodyMotion, Vehicle, body_motion, observe
from factor_graphs.wheels import Wheels, observe_wheels, wheel_factors

Array = NDArray[np.float64]

# A course that may be so far off the heading, rad, shows no slip: a boat that drifts looks like a car. Only a motion
# with less horizontal acceleration, m/s², nearly always, leaves the heading so unknown.
MOST_OF_HEADING, GENTLE = 0.05, 0.5
# The constraints are linear enough when the velocity in the imu's axes moves less than this, m/s, slip of wheels by
# this share. Until then a rough solution will do.
ROUNDS, SETTLED_MPS, SETTLED_SLIP = 4, 0.3, 0.2


@dataclass(frozen=True, eq=False)
class _Held:
    """What a solution shows of the vehicle, to be held in the next one; None for what is not held.

    `mounting` (5,) is that of the axle. `slips`: once it is held, the slip that the axle was held with first, and the
    one that is found by its residuals. `settled`: the next solution would hardly move.
    """

    motion: BodyMotion
    mounting: Array
    axle: Vehicle | None
    wheels: Wheels | None
    settled: bool
    slips: tuple[tuple[Slip, Slip], tuple[Slip, Slip]] | None = None

    @property
    def tolerance(self) -> float:
        """As in `optimise`, for the next solution."""
        return RELATIVE_TOLERANCE if self.axle is None and self.wheels is None else ROUGH

    def stands(self, problem: Problem, fit: Fit, quiet: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """The keyframes (k,) at which the vehicle stands by the solution, by fixes that fit it, and by its wheels."""
        slow, fits = standing(quiet, self.motion.velocity, CREEPING_SPEED), fit.weights > 0.5
        creeps = creeping(slow, problem.fixes[fits], problem.at[fits])
        still: NDArray[np.bool_] = standing(quiet, self.motion.velocity) & ~creeps
        return still if self.wheels is None else still & ~self.wheels.readings.moving

    def with_shared(self, problem: Problem, fit: Fit) -> Fit:
        """The same solution with what all keyframes share among its values."""
        k, values, shared = len(problem.intervals.keyframes), gtsam.Values(fit.values), {}
        if self.axle is not None:
            shared[M(k)] = self.axle.mounting
        if self.wheels is not None:
            shared[W(k)] = self.wheels.calibration
        for key, value in shared.items():
            if values.exists(key):
                values.erase(key)
            values.insert(key, value)
        return replace(fit, values=values)

    def factors(self, problem: Problem, fit: Fit, stands: NDArray[np.bool_]) -> list[gtsam.NonlinearFactor]:
        """What holds where it stands, and of axle and wheels, linearised at a solution."""
        settings, keyframes = problem.settings, problem.intervals.keyframes
        R_map_imu = np.swapaxes(self.motion.R_imu_map, 1, 2)
        density = problem.noise.gyroscope_noise_density * fit.inflation
        rests = resting(stands, R_map_imu, keyframes, density) & (
            not problem.is_bound
        )  # LiDAR odometry knows better
        still = settings.standing_stddev_mps or 1.0
        factors: list[gtsam.NonlinearFactor] = [
            *zero_velocity_factors(stands, still),
            *zero_motion_factors(rests, np.diff(keyframes), settings.standing_stddev_radps, still),
        ]
        if self.axle is not None:
            factors += non_holonomic_factors(fit.values, self.motion, self.axle.slip_stddevs(self.motion))
        if self.wheels is not None:
            factors += wheel_factors(fit.values, self.motion, self.mounting, self.wheels)
        return factors

    def is_bent(self, fit: Fit, start: Fit) -> bool:
        """Whether the IMU fits no longer with the slip that was found: the constraint is stiffer than the axle."""
        if self.axle is None or self.slips is None or self.slips[0] == self.slips[1]:
            return False
        return fit.inflation > start.inflation or fit.chi2_per_dof > FITTING_CHI2[1]

    def with_first_slip(self) -> "_Held":
        """The same with the slip that the axle was held with first, for good."""
        assert self.axle is not None
        assert self.slips is not None
        first = self.slips[0]
        return replace(self, axle=replace(self.axle, slip=first), slips=(first, first))

    def seen_in(self, problem: Problem, fit: Fit, speeds: WheelSpeeds | None) -> "_Held":
        """What the solution shows in which this was held."""
        k, motion = len(problem.intervals.keyframes), body_motion(problem, fit)
        mounting, axle, wheels, slips = self.mounting, self.axle, self.wheels, self.slips
        settled = self.settled
        if axle is not None or wheels is not None:
            settled = bool(np.abs(motion.velocity - self.motion.velocity).max() < SETTLED_MPS)
        if axle is not None:
            mounting, guessed = fit.values.atVector(M(k)), axle
            axle = replace(observe(problem, fit, motion), mounting=mounting, held=True)
            if guessed.held and slips is None:  # held once, the axle is where it belongs
                slips = guessed.slip, found_slip(problem, fit, replace(guessed, mounting=mounting))
            if slips is not None:
                axle = replace(axle, slip=slips[1])
            settled &= axle.slip == guessed.slip
        if speeds is not None and wheels is not None:
            calibration, noise = fit.values.atVector(W(k)), wheels.noise.typical
            wheels = replace(observe_wheels(speeds, problem, fit, motion, mounting, calibration), held=True)
            settled &= np.allclose(noise, wheels.noise.typical, rtol=SETTLED_SLIP)
        return _Held(motion, mounting, axle, wheels, settled, slips)


def constrain(
    problem: Problem,
    by_fixes: Fit,
    speeds: WheelSpeeds | None = None,
    beside: Sequence[Observed] = (),
) -> tuple[Fit, list[gtsam.NonlinearFactor], Vehicle | None, Wheels | None]:
    """Add what a road vehicle cannot do, and what its wheels say, linearised at the solution, and again at the next.

    Measurements `beside` are held in `by_fixes` already, and stay.

    Slip is looked at again once it is held, for a heading that drifts looks like slip until then; and the IMU's noise,
    which a vehicle that is known to stand shows better. Vehicle and wheels are None where they are not wanted.
    """
    settings, fit, quiet = problem.settings, by_fixes, _quiet(problem)
    motion = body_motion(problem, fit)
    vehicle, wheels, mounting = _observed(problem, fit, motion, speeds)
    axle = vehicle if vehicle and (settings.vehicle_constraint == "on" or not vehicle.doubt) else None
    rolling = wheels if wheels and (settings.wheel_speed == "on" or not wheels.doubt) else None
    held = _Held(motion, mounting, axle, rolling, settled=axle is None and rolling is None)
    factors: list[gtsam.NonlinearFactor] = []
    stood: NDArray[np.bool_] | None = None
    for _ in range(ROUNDS):
        stands = held.stands(problem, fit, quiet)
        if held.settled and stood is not None and np.array_equal(stands, stood):
            break
        start, stood = held.with_shared(problem, fit), stands
        factors = [*held.factors(problem, start, stands), *factors_of(beside, start)]
        if not factors:
            break
        fit = fit_noise_from(start, problem, factors, held.tolerance)
        if held.is_bent(fit, start):
            fit, held = start, held.with_first_slip()
        else:
            held = held.seen_in(problem, fit, speeds)
    # wheels that fitted only until they were held
    if held.wheels is not None and held.wheels.doubt and settings.wheel_speed != "on":
        return *constrain(problem, by_fixes, beside=beside)[:3], replace(held.wheels, held=False)
    return fit, factors, held.axle or vehicle, held.wheels or wheels


def hold_beside(problem: Problem, fit: Fit, beside: Sequence[Observed]) -> Fit:
    """The solution with measurements beside the fixes; the same where none of them is used."""
    factors = factors_of(beside, fit)
    return fit_noise_from(fit, problem, factors, RELATIVE_TOLERANCE) if factors else fit


def _observed(
    problem: Problem, fit: Fit, motion: BodyMotion, speeds: WheelSpeeds | None
) -> tuple[Vehicle | None, Wheels | None, Array]:
    """Vehicle and wheels as the solution shows them, None where they are not wanted, and the mounting (5,) of the IMU.

    The axle adds nothing that LiDAR odometry does not know better: on a drive of 480 s it changes no digit of the
    error, and takes 70 % more time. So `auto` does not want it there.
    """
    wanted = problem.settings.vehicle_constraint
    with_axle = wanted == "on" or (wanted == "auto" and not problem.is_bound)
    with_wheels = speeds is not None and problem.settings.wheel_speed != "off"
    if not with_axle and not with_wheels:
        return None, None, np.zeros(5)
    shown = observe(problem, fit, motion)
    if not shown.doubt and (heading := _heading_if_gentle(problem, fit)) > MOST_OF_HEADING:
        doubt = (
            f"its heading is known to {np.degrees(heading):.0f}° only: it hardly turns or changes its speed"
        )
        shown = replace(shown, doubt=doubt)
    mounting = np.zeros(5) if shown.doubt and wanted != "on" else shown.mounting
    vehicle = shown if with_axle else None
    if speeds is None or not with_wheels:
        return vehicle, None, mounting
    return vehicle, observe_wheels(speeds, problem, fit, motion, mounting), mounting


def _heading_if_gentle(problem: Problem, fit: Fit) -> float:
    """Usual standard deviation of the heading, rad; 0 where it is certainly small, for turns and braking show it."""
    k = len(problem.intervals.keyframes)
    T, velocities, _ = from_values(fit.values, k)
    changes = np.diff(velocities[:, :2], axis=0) / np.diff(problem.intervals.keyframes)[:, None]
    if np.quantile(np.linalg.norm(changes, axis=1), 0.9) > GENTLE:
        return 0.0
    covariances, _ = keyframe_covariances(fit.graph, fit.values, k)
    return float(np.median(stddevs_of_heading(T[:, :3, :3], covariances)))


def _quiet(problem: Problem) -> NDArray[np.bool_]:
    """The intervals (k - 1,) in which the vehicle may be held still."""
    if problem.settings.standing_stddev_mps is None:
        return np.zeros(len(problem.intervals.keyframes) - 1, dtype=bool)
    return quiet_intervals(problem.intervals)
