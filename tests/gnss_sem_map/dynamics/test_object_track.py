"""The track of a car of known size that something hides in part: where its middle is, and how well that is known."""

import numpy as np
import pytest

from gnss_sem_map.dynamics.object_track import track_of
from gnss_sem_map.dynamics.tracking import Segment

LENGTH_M, SPEED_M_S, STEP_S = 4.0, 5.0, 0.1
LIDAR = np.array([-0.1, -20.0])


def segment(scan, begin, end, truncated=False, is_covered=False, highest=1.5):
    """A side of a car along x, of which so much is seen."""
    x = np.linspace(begin, end, 20)
    outline = np.stack([x, np.zeros(20)], axis=1)
    return Segment(
        scan, scan * STEP_S, outline.mean(axis=0), 20, True, truncated, outline.copy, LIDAR, (0.3, highest),
        is_covered=is_covered,
    )  # fmt: skip


def test_of_a_car_that_comes_out_abeam_from_behind_something_the_hidden_part_is_unknown():
    """Of one that is hidden at x < 0, the LiDAR sees first the front, though the rear is the end that faces it."""
    middles = -1.7 + SPEED_M_S * STEP_S * np.arange(15)
    track = track_of(
        [
            segment(scan, max(middle - LENGTH_M / 2, 0.0), middle + LENGTH_M / 2)
            for scan, middle in enumerate(middles)
        ]
    )
    off, stddevs = track.positions[:, 0] - middles, np.sqrt(track.variances[:, 0])
    assert (abs(off) < 3 * stddevs).all()
    whole = middles > LENGTH_M / 2 + SPEED_M_S * STEP_S
    assert abs(off[whole]).max() < 0.1


def test_an_object_is_no_smaller_than_what_is_seen_of_it_where_it_is_cut_off():
    begins = SPEED_M_S * STEP_S * np.arange(20)
    is_cut = np.arange(20) >= 4
    seen = np.where(is_cut, LENGTH_M, 0.3)
    track = track_of(
        [
            segment(scan, begin, begin + length, bool(cut))
            for scan, (begin, length, cut) in enumerate(zip(begins, seen, is_cut, strict=True))
        ]
    )
    assert LENGTH_M < track.size_m[0] < LENGTH_M + 0.2


@pytest.mark.parametrize(
    "hidden", [{"is_covered": True}, {"highest": 0.9}], ids=["covered", "lower than people"]
)
def test_what_is_seen_through_a_gap_may_be_anywhere_along_a_lorry(hidden):
    """The visible part of a lorry stays in the gap while it passes."""
    middles = SPEED_M_S * STEP_S * np.arange(-5, 6)
    track = track_of([segment(scan, -0.6, 0.6, **hidden) for scan in range(len(middles))])
    assert (abs(track.positions[:, 0] - middles) < np.sqrt(track.variances[:, 0])).all()
    person = track_of([segment(scan, -0.6, 0.6) for scan in range(len(middles))])
    assert (person.variances[:, 0] < 0.2**2).all()
