"""How much an axle slides, by the residuals of a graph that holds it: variance components (Förstner 1979).

The constraint shrinks the slip that its own solution shows: of the variance of means over ten seconds, residuals keep
a half sideways, or less. What the model expects of such means is the slip that the graph believes in, less what the
solution takes of it, and both are known. Their ratio to what is seen corrects the belief.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from factor_graphs.covariances import SumVariance, keyframe_covariances
from factor_graphs.elimination import SIZE
from factor_graphs.problem import Fit, Problem
from factor_graphs.slip import BLOCK_S, CUT, DRIFT_S, LEFT, Slip
from factor_graphs.vehicle import Vehicle, body_motion, where_seen

Array = NDArray[np.float64]

# Blocks in a window over which drift of heading is taken from what is seen sideways; of pitch, gravity tells. The means
# of each block are sideways and vertical.
BLOCKS, AXES = round(DRIFT_S / BLOCK_S), 2
# With fewer blocks nothing is changed. A solution is taken to leave at least this share of the slip.
LEAST_BLOCKS, LEAST_SHARE = 12, 0.2
# Density that is never gone below, m/s/√Hz: 0.05° of the direction of travel at 6 m/s, for a second.
LEAST_DENSITY = 0.005
# Found, a density is good enough when it would change by less than the first; its square grows by the second at most.
ENOUGH, MOST = 1.2, 4.0


@dataclass(frozen=True, eq=False)
class SlipSums:
    """Sums of slip over blocks, sideways without the drift of heading: as seen, and what slip makes of their variance.

    `seen` and `of_slip` (w, 2 BLOCKS) m², by window, block and axis; `variance` what the solution takes of it.
    """

    seen: Array
    of_slip: Array
    variance: SumVariance


def found_slip(problem: Problem, fit: Fit, vehicle: Vehicle) -> tuple[Slip, Slip]:
    """The slip that a solution shows in which the vehicle constraint is held as the vehicle says, or its own."""
    sums = slip_sums(problem, fit, vehicle)
    if sums is None:
        return vehicle.slip
    keyframe_covariances(fit.graph, fit.values, len(problem.intervals.keyframes), sums.variance)
    return corrected(vehicle.slip, sums)


def slip_sums(problem: Problem, fit: Fit, vehicle: Vehicle) -> SlipSums | None:
    """The sums of a solution in which the vehicle constraint is held; None where too little is seen of it."""
    motion = body_motion(problem, fit)
    where = np.flatnonzero(where_seen(problem, fit, motion) & ~vehicle.skids.any(axis=1))
    spacing, ahead = motion.spacing[where], motion.velocity[where, 0]
    block = (np.cumsum(spacing) / BLOCK_S).astype(int)
    if len(block) == 0 or block[-1] < LEAST_BLOCKS:
        return None
    window, block = block // BLOCKS, block % BLOCKS
    count = window[-1] + 1
    # of every value its time, sideways less the mean slope of its window: (n, BLOCKS, AXES)
    own = np.zeros((len(where), BLOCKS))
    own[np.arange(len(where)), block] = spacing
    leaning, lever = np.zeros((count, BLOCKS)), np.bincount(window, ahead**2)
    np.add.at(leaning, window, own * ahead[:, None])
    straight = own - (leaning / np.maximum(lever, 1e-12)[:, None])[window] * ahead[:, None]
    share = np.stack([straight, own], axis=2)

    def summed(values: Array) -> Array:
        total = np.zeros((count, *values.shape[1:]))
        np.add.at(total, window, values)
        return total

    sliding, believed = motion.sliding(vehicle.mounting)[where], vehicle.slip_stddevs(motion)[where]
    seen = summed(share * sliding[:, None]).reshape(count, -1)
    of_slip = summed(share**2 * believed[:, None] ** 2).reshape(count, -1)
    by_state = motion.by_state(motion.by_velocity(vehicle.mounting))[where]
    by_mounting = -motion.by_mounting()[where]
    rows = np.zeros((len(motion.spacing), BLOCKS * AXES, SIZE))
    rows[where, :, :9] = (share[:, :, :, None] * by_state[:, None]).reshape(len(where), -1, 9)
    of_all = summed(
        (share[:, :, :, None] * by_mounting[:, None]).reshape(len(where), -1, by_mounting.shape[2])
    )
    windows = np.full(len(rows), -1)
    windows[where] = window
    return SlipSums(seen, of_slip, SumVariance(rows, windows, of_all))


def corrected(slip: tuple[Slip, Slip], sums: SlipSums) -> tuple[Slip, Slip]:
    """The slip that the sums show, sideways and vertical; the same objects where it is as it is believed to be.

    Of slip of variance R, a solution that knows the motion with variance P without it leaves the share s = R / (P + R).
    If its residuals are r s R, the slip is R (1 + (r - 1) / s); below one that may be negative, so there it is Newton's
    step for its logarithm. Squares are cut, for a clock or axes that are a little wrong look like slip that lasts.
    """
    left = np.maximum(sums.of_slip - sums.variance.found, LEAST_SHARE * sums.of_slip)
    squares = np.minimum(sums.seen**2, CUT**2 * left) / LEFT
    of_slip, left, squares = (each.reshape(-1, AXES).sum(axis=0) for each in (sums.of_slip, left, squares))
    share, ratio = left / of_slip, squares / left
    more, less = 1 + (ratio - 1) / share, ratio ** (1 / share)
    found = []
    for one, change in zip(slip, np.where(ratio > 1, np.minimum(more, MOST), less), strict=True):
        lasting_s = max(one.lasting_s * float(change), (LEAST_DENSITY / one.typical) ** 2)
        is_as_believed = 1 / ENOUGH < np.sqrt(lasting_s / one.lasting_s) < ENOUGH
        found.append(one if is_as_believed else replace(one, lasting_s=lasting_s))
    return found[0], found[1]
