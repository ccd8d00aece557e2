"""Charts have round ticks and put values where their axes say."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gnss_sem_map.export.charts import chart, ticks


@given(st.floats(-1e6, 1e6), st.floats(1e-3, 1e6))
def test_ticks_are_round_and_inside(low: float, length: float) -> None:
    found = ticks(low, low + length)
    assert 1 <= len(found) <= 7
    slack = 1e-6 * (length + abs(low))
    assert all(low - slack <= value <= low + length + slack for value in found)
    steps = np.diff(found)
    if len(steps):
        assert np.allclose(steps, steps[0])
        mantissa = steps[0] / 10.0 ** np.floor(np.log10(steps[0]) + 1e-9)
        assert min(abs(mantissa - each) for each in (1, 2, 5, 10)) < 1e-3


def test_a_value_at_a_tick_is_drawn_at_the_tick() -> None:
    drawn = chart("", "", "", [("line", "a", (0.0, 4.0), (10.0, 30.0))], (0, 10), (0, 40))
    (x0, y0), (x1, y1) = (map(float, point.split(",")) for point in drawn.lines[0].points.split())
    assert (x0, x1) == tuple(place for place, text in drawn.x_ticks if text in ("0", "4"))
    assert (y0, y1) == tuple(place for place, text in drawn.y_ticks if text in ("10", "30"))


def test_a_metre_is_as_long_on_both_axes_of_a_way() -> None:
    square = [("square", "a", (0.0, 1.0, 1.0), (0.0, 0.0, 1.0))]
    corners = chart("", "", "", square, is_equal=True).lines[0].points.split()
    (x0, y0), (x1, _), (_, y1) = (map(float, corner.split(",")) for corner in corners)
    assert x1 - x0 == pytest.approx(y0 - y1, abs=0.2)
