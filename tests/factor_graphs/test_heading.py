"""The heading of what moves slowly, or not at all: found where the drive tells it, and unknown where it does not."""

import numpy as np
import pytest
from numpy.typing import NDArray

from factor_graphs import heading
from factor_graphs.accuracy import errors, pose_nees
from factor_graphs.chi_square import quantile
from factor_graphs.geodesy import LocalFrame
from factor_graphs.heading import with_heading
from factor_graphs.measurements import ImuNoise
from factor_graphs.problem import pose_problem
from factor_graphs.settings import SmootherSettings
from factor_graphs.simulation import Motion, follow
from factor_graphs.smoothing import heading_stddevs, smooth

FRAME, LEVER = LocalFrame(49.0, 8.4, 115.0), np.array([0.5, 0.3, 1.0])


def winding(speed: float, course_deg: float):
    """A vehicle that stands for 2 s, and then drives at `speed` m/s on a winding way, about in one direction."""

    def moves(seconds: float, rng: np.random.Generator) -> Motion:
        way = np.arange(speed * seconds + 40.0)
        course = np.radians(course_deg) + 0.6 * np.sin(way / 12)
        points: NDArray[np.float64] = np.column_stack(
            [np.cumsum(np.cos(course)), np.cumsum(np.sin(course)), 0.3 * np.sin(way / 9)]
        )
        return follow(points, [0.0, 2.0, 5.0, seconds], [0.0, 0.0, speed, speed], 0.2)

    return moves


@pytest.mark.parametrize("course_deg", [0.0, 120.0, 240.0])
def test_a_log_that_stands_does_not_know_where_it_looks(simulate, course_deg):
    drive = simulate(60, seconds=60.0, noise=ImuNoise(), moves=winding(0.0, course_deg))
    found = smooth(drive.imu, drive.fixes, FRAME, None, LEVER)
    assert np.degrees(heading_stddevs(found.keyframes).min()) > 90.0
    assert any("heading is unobservable" in note for note in found.notes)
    squares = pose_nees(found.keyframes, drive.motion.trajectory(found.keyframes.stamps))
    assert np.mean(squares.orientation < quantile(0.9, 3)) > 0.9
    assert np.mean(squares.horizontal < quantile(0.9, 2)) > 0.8


@pytest.mark.parametrize("course_deg", [0.0, 120.0, 240.0])
def test_the_heading_of_a_slow_vehicle_does_not_lean_to_that_of_the_guess(simulate, course_deg):
    drive = simulate(62, noise=ImuNoise(), moves=winding(1.4, course_deg))
    found = smooth(drive.imu, drive.fixes, FRAME, None, LEVER)
    off = errors(found.keyframes, drive.motion.trajectory(found.keyframes.stamps))
    assert off.heading_rms_deg < 3 * np.degrees(heading_stddevs(found.keyframes).max())
    assert np.degrees(heading_stddevs(found.keyframes).max()) < 15.0
    assert not any("heading" in note for note in found.notes)


@pytest.mark.parametrize(("speed", "in_doubt"), [(0.0, True), (1.4, False)])
def test_a_guess_without_a_solution_excludes_no_heading(simulate, monkeypatch, speed, in_doubt):
    """The optimiser crawls where every heading fits. What is known by the one solution that is found needs no other."""
    drive = simulate(62, noise=ImuNoise(), moves=winding(speed, 30.0))
    problem = pose_problem(drive.imu, drive.fixes, FRAME, SmootherSettings(), LEVER, None)
    found = [heading._solved(problem), None, None, None]
    monkeypatch.setattr(heading, "_solved", lambda _: found.pop(0))
    assert with_heading(problem).heading_in_doubt == in_doubt


def test_a_vehicle_that_drives_is_looked_at_once(simulate, mems):
    problem = pose_problem(mems.imu, mems.fixes, FRAME, SmootherSettings(), LEVER, None)
    assert with_heading(problem) is problem
