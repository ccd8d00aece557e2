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
    filled = np.zeros(len(stamps), dtype=bool)
    if len(stamps) > FEWEST:
        filled[1:-1] = _on_lines(values, np.diff(stamps)) | _on_lines(values, np.ones(len(stamps) - 1))
    return filled


def _on_lines(values: Array, steps: Array) -> NDArray[np.bool_]:
    """Of every sample but the first and the last, whether all channels go on there as they came."""
    found = np.ones(len(values) - 2, dtype=bool)
    for channel in values.T:
        slopes = np.diff(channel) / steps
        bends = np.abs(np.diff(slopes))
        found &= (bends <= STRAIGHT * np.median(bends)) & (slopes[1:] != 0) & (slopes[:-1] != 0)
        found = binary_opening(found, np.ones(FEWEST, dtype=bool))
        if not found.any():  # nearly always after the first channel
            break
    return found
