"""Gaps of an IMU that somebody filled with straight lines: what is between their ends was not measured.

Tools that resample a log do so in silence, and its stamps do not tell. A turn that falls into such a gap is lost: in
the log that ships with GTSAM three of eight gaps of 1.6 s hide 7 to 12° of heading each.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_opening

Array = NDArray[np.float64]

# Of the usual bend between three samples; noise is in every channel, and bends all of them less once in 1e14 samples.
STRAIGHT = 0.01
# So many samples in a row, at least: twice as many in a second, as some tools make, stay.
FEWEST = 5


def filled_in(stamps: Array, values: Array) -> NDArray[np.bool_]:
    """Which samples (n,) lie on a straight line between others, in every channel: no sensor with noise gives them.

    `stamps` (n,) s, increasing; `values` (n, c). Lines are straight in time or from row to row. What stays the same
    is no line: a sensor at rest may say one number again and again.
    """
    straight = np.zeros(len(stamps), dtype=bool)
    if len(stamps) > FEWEST:
        inside = _are_straight(values, np.diff(stamps)) | _are_straight(values, np.ones(len(stamps) - 1))
        straight[1:-1] = binary_opening(inside, np.ones(FEWEST, dtype=bool))
    return straight


def _are_straight(values: Array, steps: Array) -> NDArray[np.bool_]:
    """Of every sample but the first and the last, whether all channels go on as they came."""
    slopes = np.diff(values, axis=0) / steps[:, None]
    bends = np.abs(np.diff(slopes, axis=0))
    changes = (slopes[1:] != 0).all(axis=1) & (slopes[:-1] != 0).all(axis=1)
    return np.asarray(changes & (bends <= STRAIGHT * np.median(bends, axis=0)).all(axis=1))
