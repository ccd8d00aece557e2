import warnings

import numpy as np
import pytest

from factor_graphs.errors import MeasurementError
from factor_graphs.geodesy import LocalFrame
from factor_graphs.measurements import GnssFixes, ImuNoise
from factor_graphs.simulation import random_drive, simulate_gnss, simulate_imu
from factor_graphs.smoothing import smooth
from factor_graphs.trajectory_plot import write_trajectory_plot

FRAME = LocalFrame(49.0, 8.4, 115.0)


def test_the_picture_is_written_whatever_the_fixes_are_and_says_nothing(tmp_path, caplog):
    from matplotlib.image import imread

    rng = np.random.default_rng(0)
    motion = random_drive(40.0, rng)
    imu = simulate_imu(motion, np.arange(0.0, 40.0, 0.01), FRAME, ImuNoise(), rng)
    fixes = simulate_gnss(motion, np.arange(0.5, 39.0), 1.0, rng=rng)
    positions = fixes.positions.copy()
    positions[7] += 30_000.0  # a rejected fix far away must not spoil the picture
    fixes = GnssFixes(np.append(fixes.stamps[:-1], 99.0), positions, fixes.stddevs)  # and one outside the IMU
    solution = smooth(imu, fixes, FRAME)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        write_trajectory_plot(solution, fixes, tmp_path / "trajectory.png")
    picture = imread(tmp_path / "trajectory.png")
    assert picture.shape[0] > 800
    assert picture.shape[1] > 1200
    track = picture[:, : picture.shape[1] // 2, :3]
    black = np.argwhere(track.sum(axis=2) < 0.3)
    assert np.ptp(black[:, 0]) > 200  # the track fills its half: it is no dot
    assert not caplog.records
    with pytest.raises(MeasurementError, match="38 fixes, but the solution is of 39"):
        write_trajectory_plot(solution, fixes[1:], tmp_path / "other.png")
    assert not (tmp_path / "other.png").exists()
