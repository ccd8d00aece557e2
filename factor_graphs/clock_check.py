"""Which time offsets of the fixes does the motion support? Dead reckoning of the IMU against them, without the graph.

The graph estimates its offset beside everything else, so another mistake (axes, units, fixes that are no measurements)
can move it far. What the motion excludes is not taken.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from factor_graphs.calibration import Calibration
from factor_graphs.chi_square import quantile
from factor_graphs.dead_reckoning import agreement, way_of, windows_of
from factor_graphs.measurements import GnssFixes, ImuSamples

Array = NDArray[np.float64]

# Offsets tried, s: as far as the message of a receiver may be late, and beyond the one in question. Dead reckoning does
# not judge what is smaller than the last.
FARTHEST_S, BEYOND_S, STEP_S, JUDGED_S = 3.0, 1.0, 0.05, 0.1
# Twice the logarithm of the likelihood that the right offset lacks against the best in one of 16,000 drives (4 sigma).
LACKING = quantile(1 - 1 / 16_000, 1)
# Where so many times the noise is needed, the graph does not explain the drive: then the motion itself has to tell the
# offset, to this span, s.
UNFIT, TOLD_S = 3.0, 1.0
# Steps of IMU samples that are means are shorter than this, s; and an offset so many standard deviations nearer to half
# a step than to none shows it.
OFTEN_S, SURELY = 0.02, 2.0


def checked(found: Calibration, imu: ImuSamples, fixes: GnssFixes, of_noise: float) -> Calibration:
    """The calibration as it is where the motion supports its time offset; else without the offset, but in doubt by it.

    `fixes` are those that fit, with the stamps that they were given; `of_noise`: how many times the expected noise the
    graph needed. The deviation that a refused offset leaves is the root mean square of those that the motion supports,
    and at most the refused one.
    """
    offset = found.time_offset_s
    if abs(offset) <= JUDGED_S:
        return found
    supported = supported_offsets(imu, fixes, found.p_imu_antenna, abs(offset) + BEYOND_S)
    if not len(supported):
        return found
    if np.abs(supported - offset).min() > STEP_S:
        why = f"the motion supports {supported.min():+.2f} to {supported.max():+.2f} s only"
    elif of_noise > UNFIT and np.ptp(supported) > TOLD_S:
        why = "IMU and fixes do not fit each other, and the motion does not tell it"
    else:
        return found
    return replace(
        found,
        time_offset_s=0.0,
        time_offset_stddev_s=min(float(np.sqrt(np.mean(supported**2))), abs(offset)),
        refused=f"the graph finds the fixes {offset:+.2f} s after their stamps, but {why}",
    )


def stamps_are_ends(found: Calibration, imu: ImuSamples) -> bool:
    """Whether the stamps of IMU samples are the ends of the intervals that they are means of, by the time offset found.

    Then the fixes look late by half an interval, which no receiver is: what takes time to send comes after its moment.
    Slower units than OFTEN_S write what is of one moment.
    """
    step = float(np.median(np.diff(imu.stamps)))
    near = abs(found.time_offset_s - step / 2) < step / 4
    return step < OFTEN_S and near and (found.time_offset_stddev_s or np.inf) < step / 4 / SURELY


def supported_offsets(imu: ImuSamples, fixes: GnssFixes, p_imu_antenna: Array, farthest_s: float) -> Array:
    """The time offsets, s, up to `farthest_s` at least, that dead reckoning does not exclude; none in a short log."""
    farthest_s = max(FARTHEST_S, farthest_s)
    windows = windows_of(fixes, imu.stamps[0] + farthest_s, imu.stamps[-1] - farthest_s)
    if windows is None:
        return np.zeros(0)
    R = Rotation.align_vectors([[0.0, 0.0, 1.0]], [imu.specific_force.mean(axis=0)])[0].as_matrix()
    upright = ImuSamples(imu.stamps, imu.specific_force @ R.T, imu.angular_rate @ R.T)
    way, steps = way_of(upright, complex(*(R @ p_imu_antenna)[:2])), np.ceil(farthest_s / STEP_S)
    offsets = STEP_S * np.arange(-steps, steps + 1)
    tried = [agreement(windows, imu.stamps, way, offset) for offset in offsets.tolist()]
    rests = np.array([one.rest for one in tried])
    best = int(rests.argmin())
    lacking = 2 * tried[best].independent * np.log(rests / max(rests[best], 1e-9))
    return np.asarray(offsets[lacking <= LACKING])
