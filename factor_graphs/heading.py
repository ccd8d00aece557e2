"""Which way does a slow vehicle look? Its course hardly tells, so several first guesses are tried.

The optimiser goes to the nearest valley, and a covariance knows of no other. Where another heading fits as well, it is
not known at all.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from factor_graphs.chi_square import quantile
from factor_graphs.covariances import keyframe_covariances
from factor_graphs.errors import EstimationError
from factor_graphs.model import from_values, motion_from, to_values
from factor_graphs.problem import Fit, Problem, fit_as_expected

Array = NDArray[np.float64]

# Slower than this, m/s, over so many s, nearly always, the course does not tell the heading; a prior below this, rad,
# does.
SLOW_MPS, COURSE_S, UNKNOWN = 3.0, 20.0, 1.0
TURNS_DEG = (0.0, 90.0, 180.0, 270.0)
# Another heading, so far away, rad, fits as well when its cost is that of a good one of 999 in a thousand.
APART, AS_GOOD = 0.5, quantile(0.999, 1)
# Within so many standard deviations a heading is sure.
SURELY = 3.0
# Standard deviation of a heading that may be any, rad.
ANY = np.pi / np.sqrt(3)


def with_heading(problem: Problem) -> Problem:
    """The problem with the first guess of which the solution is best, and with the doubt whether another is as good."""
    if problem.is_bound or problem.attitude.heading_stddev < UNKNOWN or not _is_slow(problem):
        return problem
    tried = [_solved(_turned(problem, turn)) for turn in TURNS_DEG]
    found = [one for one in tried if one is not None]
    if not found:
        return problem
    middle = len(problem.intervals.keyframes) // 2
    costs = np.array([2 * fit.graph.error(fit.values) for _, fit in found])
    R_map_imu = np.stack([motion_from(fit.values)[0][middle, :3, :3] for _, fit in found])
    best, best_fit = found[int(costs.argmin())]
    off = Rotation.from_matrix(R_map_imu @ R_map_imu[int(costs.argmin())].T).as_rotvec()[:, 2]
    as_good = costs - costs.min() < AS_GOOD
    in_doubt = bool(np.any(as_good & (np.abs(off) > APART)))
    if len(found) < len(tried):  # a guess without solution excludes no heading
        T, _ = motion_from(best_fit.values)
        covariances, _ = keyframe_covariances(best_fit.graph, best_fit.values, len(T))
        in_doubt |= bool(SURELY * stddevs_of_heading(T[:, :3, :3], covariances).min() > APART)
    return replace(best, guess=motion_from(best_fit.values), heading_in_doubt=in_doubt)


def stddevs_of_heading(R_map_imu: Array, covariances: Array) -> Array:
    """Standard deviation of the heading (k,) rad by covariances (k, n, n), whose first three are of the rotation.

    The rotation of the tangent, in the axes that R_map_imu (k, 3, 3) turns to the map, about the map's up axis.
    """
    up = R_map_imu[:, 2]
    variances: Array = np.einsum("ki,kij,kj->k", up, covariances[:, :3, :3], up)
    return np.sqrt(variances)


def turned_to(problem: Problem, fit: Fit, turn: float) -> tuple[Problem, Fit]:
    """A solution that does not know its heading, turned by `turn` rad about up: another measurement knows it."""
    if turn == 0.0:
        return problem, fit
    T, velocities, biases = from_values(fit.values, len(problem.intervals.keyframes))
    turned = _turned(replace(problem, guess=(T, velocities)), float(np.degrees(turn)))
    found = replace(fit, values=to_values(turned.guess[0], velocities, biases))
    return replace(turned, heading_in_doubt=False), found


def _is_slow(problem: Problem) -> bool:
    """Whether it gets nowhere fast: a speed from fix to fix is mostly their noise."""
    stamps, level = problem.intervals.keyframes, problem.guess[0][:, :2, 3]
    first = np.flatnonzero(stamps <= max(stamps[-1] - COURSE_S, stamps[0]))
    last = np.minimum(np.searchsorted(stamps, stamps[first] + COURSE_S), len(stamps) - 1)
    speeds = np.linalg.norm(level[last] - level[first], axis=1) / (stamps[last] - stamps[first])
    return bool(np.quantile(speeds, 0.9) < SLOW_MPS)


def of_any_heading(R_map_imu: Array, p_imu_antenna: Array) -> Array:
    """Covariance (k, 6, 6) of poses with rotations (k, 3, 3) that may look anywhere: the antenna is where it is."""
    up = R_map_imu[:, 2]
    vertical = up[:, :, None] * up[:, None]
    radius = np.linalg.norm(np.cross(up, p_imu_antenna), axis=1)
    covariances = np.zeros((len(up), 6, 6))
    covariances[:, :3, :3] = ANY**2 * vertical
    covariances[:, 3:, 3:] = radius[:, None, None] ** 2 * (np.eye(3) - vertical)
    return covariances


def _turned(problem: Problem, turn_deg: float) -> Problem:
    """The same with another heading of the first guess, the antenna where it was."""
    turn = Rotation.from_euler("z", turn_deg, degrees=True).as_matrix()
    T, velocities = problem.guess[0].copy(), problem.guess[1]
    antenna = T[:, :3, 3] + T[:, :3, :3] @ problem.p_imu_antenna
    T[:, :3, :3] = turn @ T[:, :3, :3]
    T[:, :3, 3] = antenna - T[:, :3, :3] @ problem.p_imu_antenna
    attitude = replace(problem.attitude, R_map_imu=turn @ problem.attitude.R_map_imu)
    return replace(problem, guess=(T, velocities), attitude=attitude)


def _solved(problem: Problem) -> tuple[Problem, Fit] | None:
    """A guess and its solution, if there is one."""
    try:
        return problem, fit_as_expected(problem)
    except EstimationError:
        return None
