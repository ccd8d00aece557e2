"""What wheel speeds say at keyframes: the value, how it changes, and the direction where they do not tell it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from factor_graphs.measurements import WheelSpeeds

Array = NDArray[np.float64]

# A keyframe takes the samples within this, s, or within so many usual steps of a slow sensor, but no farther than that.
WINDOW_S, STEPS, FARTHEST_S = 0.15, 1.2, 1.5
# Below this, m/s, sensors are blind or say zero, and a vehicle may turn back; above that one, it does not stand.
SLOW, CREEP = 0.5, 0.1
# A way between two stops leads where the solution says, when that agrees with this share of the wheels' own.
SURE = 0.5


@dataclass(frozen=True, eq=False)
class Readings:
    """Wheel speeds at k keyframes, without sign: `speeds` (k,) m/s, their `changes` (k,) m/s².

    `rolling` (k,): they say a speed; `stopped` (k,): they say zero; where neither holds, they say nothing but that they
    are `moving` (k,).
    `directions` (k,): 1 or -1, what the speed is to be multiplied with; 0 where they say none.
    """

    speeds: Array
    changes: Array
    rolling: NDArray[np.bool_]
    stopped: NDArray[np.bool_]
    moving: NDArray[np.bool_]
    directions: Array

    def grows_with(self) -> Array:
        """What the variance of slip grows with: nothing, speed squared, acceleration squared, (k, 3)."""
        return np.column_stack([np.ones(len(self.speeds)), self.speeds**2, self.changes**2])


def read(wheels: WheelSpeeds, stamps: Array, ahead: Array) -> Readings:
    """The wheels at keyframes: a straight line through the samples around each of `stamps` (k,) s.

    Its errors are less than a sample's, and there are no more of them than keyframes. `ahead` (k,) m/s is the forward
    speed of a solution: many sensors do not tell forwards from backwards.
    """
    k, reach = len(stamps), WINDOW_S
    if len(wheels) > 1:
        reach = float(np.clip(STEPS * np.median(np.diff(wheels.stamps)), WINDOW_S, FARTHEST_S))
    first = np.searchsorted(wheels.stamps, stamps - reach)
    count = np.searchsorted(wheels.stamps, stamps + reach, side="right") - first
    row = np.repeat(np.arange(k), count)
    sample = np.arange(len(row)) + np.repeat(first - np.cumsum(count) + count, count)
    t, w = wheels.stamps[sample] - stamps[row], wheels.speeds[sample]
    n, t1, t2, w1, tw, before, after, slow, still, zero = (
        np.bincount(row, values, k)
        for values in (
            np.ones(len(t)), t, t * t, w, t * w, t <= 0, t >= 0, np.abs(w) < SLOW, np.abs(w) < CREEP, w == 0,
        )
    )  # fmt: skip
    spread = n * t2 - t1**2
    known = (before > 0) & (after > 0) & (spread > 1e-9)
    changes = np.where(known, (n * tw - t1 * w1) / np.where(known, spread, 1.0), 0.0)
    speeds = np.where(known, (w1 - changes * t1) / np.maximum(n, 1.0), 0.0)
    rolling = known & (slow == 0)
    sign = np.where(speeds < 0, -1.0, 1.0)
    directions = sign * rolling
    if len(wheels) and wheels.speeds.min() > -SLOW:
        directions = _directions(wheels, stamps, speeds, rolling, ahead)
    rolling, stopped, moving = directions != 0, known & (zero == n), known & (still == 0)
    return Readings(sign * speeds, sign * changes, rolling, stopped, moving, directions)


def _directions(
    wheels: WheelSpeeds, stamps: Array, speeds: Array, rolling: NDArray[np.bool_], ahead: Array
) -> Array:
    """Forwards 1, backwards -1, unknown 0, (k,): one for all from stop to stop, where alone a vehicle turns back."""
    found = np.zeros(len(stamps))
    if not rolling.any():
        return found
    slow = wheels.stamps[np.abs(wheels.speeds) < SLOW]
    _, way = np.unique(np.searchsorted(slow, stamps[rolling]), return_inverse=True)
    v, w = ahead[rolling], speeds[rolling]
    alike = np.bincount(way, v * w) / np.bincount(way, w * w)
    sure = np.abs(alike) > SURE * np.median(np.abs(v / w))
    found[rolling] = np.where(sure, np.sign(alike), 0.0)[way]
    return found
