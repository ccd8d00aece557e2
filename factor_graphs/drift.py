"""How far fixes drift together, beside what they claim: their positions while the vehicle stands.

A receiver with RTK claims a centimetre. Multipath, and what is left of the ionosphere, shift its fixes by some more for
a minute; so they are no better together than one of them is, and the IMU, which drifts faster, does not show it. While
a vehicle stands, all fixes should be one. Half of the mean square of their differences over a time h (variogram) is
w² + s² (1 - exp(-h / T)) for white noise w and a shift s that lasts for T (first-order Gauss-Markov process).
"""

import numpy as np
from numpy.typing import NDArray

from factor_graphs.intervals import nearest
from factor_graphs.measurements import GnssFixes

Array = NDArray[np.float64]

# A shift is taken to last for this, s; differences over the second time show it beside those over the first.
LASTING_S, SHORT_S, LONG_S = 60.0, 1.0, 10.0
# Less than so much time between two fixes of one stop, s in all, shows nothing.
LEAST_S = 30.0


def shift_stddevs(fixes: GnssFixes, stops: NDArray[np.intp]) -> Array:
    """Standard deviation (3,) m of the shift of fixes; zero where the vehicle does not stand for long enough.

    `stops` (m,) is the number of the stop that each fix is of, -1 for none.
    """
    short, _ = _half_mean_squares(fixes, stops, SHORT_S)
    long, time = _half_mean_squares(fixes, stops, LONG_S)
    if time < LEAST_S:
        return np.zeros(3)
    grown = np.exp(-SHORT_S / LASTING_S) - np.exp(-LONG_S / LASTING_S)
    stddevs: Array = np.sqrt(np.maximum(long - short, 0.0) / grown)
    return stddevs


def _half_mean_squares(fixes: GnssFixes, stops: NDArray[np.intp], apart_s: float) -> tuple[Array, float]:
    """Of the differences of fixes of one stop so far apart (3,) m²; and how much time they cover, s."""
    later = nearest(fixes.stamps, fixes.stamps + apart_s)
    apart = fixes.stamps[later] - fixes.stamps
    pairs = (stops >= 0) & (stops == stops[later]) & (np.abs(apart - apart_s) < apart_s / 2)
    if not pairs.any():
        return np.zeros(3), 0.0
    differences = (fixes.positions[later] - fixes.positions)[pairs]
    usual = float(np.median(np.diff(fixes.stamps)))
    return np.mean(differences**2, axis=0) / 2, usual * float(pairs.sum())
