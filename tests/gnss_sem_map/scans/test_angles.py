from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gnss_sem_map.scans.angles import azimuths_deg

coordinates = st.floats(-200, 200, width=32)


def numpys(rows: np.ndarray) -> np.ndarray:
    return np.degrees(np.arctan2(rows[:, 1], rows[:, 0], dtype=np.float64))


@settings(deadline=None)  # the first example compiles
@given(st.lists(st.tuples(coordinates, coordinates), min_size=1, max_size=50))
def test_azimuths_are_those_of_numpy(xy: list[tuple[float, float]]) -> None:
    rows = np.zeros((len(xy), 4), np.float32)
    rows[:, :2] = np.add(xy, 0.0)  # no -0.0, which is behind in numpy
    np.testing.assert_allclose(np.abs(azimuths_deg(rows)), np.abs(numpys(rows)), rtol=0, atol=1e-11)
    is_off_axis = rows[:, 1] != 0
    np.testing.assert_array_equal(np.sign(azimuths_deg(rows))[is_off_axis], np.sign(rows[is_off_axis, 1]))


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_what_is_not_finite_spoils_no_other_azimuth(bad: float) -> None:
    rows = np.random.default_rng(0).normal(0, 30, (100, 4)).astype(np.float32)
    expected = numpys(rows)
    rows[10, 0] = bad
    np.testing.assert_allclose(np.delete(azimuths_deg(rows), 10), np.delete(expected, 10), rtol=0, atol=1e-11)
