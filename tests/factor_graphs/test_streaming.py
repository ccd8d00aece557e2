from dataclasses import replace

import gtsam
import numpy as np
import pytest

from factor_graphs.errors import MeasurementError
from factor_graphs.geodesy import LocalFrame
from factor_graphs.measurements import GnssFixes, ImuNoise, ImuSamples
from factor_graphs.smoothing import smooth
from factor_graphs.streaming import StreamingSmoother

FRAME = LocalFrame(49.0, 8.4, 115.0)
LEVER = np.array([0.5, 0.3, 1.0])
BEGIN_S = 30.0


def cut(imu: ImuSamples, first: float, last: float) -> ImuSamples:
    a, b = np.searchsorted(imu.stamps, [first, last])
    return imu[max(a - 1, 0) : b + 1]


def started(drive) -> StreamingSmoother:
    early = drive.fixes[drive.fixes.stamps < BEGIN_S]
    return StreamingSmoother(smooth(cut(drive.imu, 0.0, BEGIN_S), early, FRAME, None, LEVER), FRAME, LEVER)


def follow(online: StreamingSmoother, drive) -> tuple[np.ndarray, np.ndarray]:
    """Horizontal error and its stddev at every fix."""
    off, stddevs = [], []
    for i in np.flatnonzero(drive.fixes.stamps > online.state.stamp):
        fix = drive.fixes[i : i + 1]
        state = online.add(cut(drive.imu, online.state.stamp, fix.stamps[0]), fix)
        off.append(np.linalg.norm((state.T_map_imu - drive.motion.poses([state.stamp])[0])[:2, 3]))
        stddevs.append(np.sqrt(np.trace(online.pose_covariance()[3:5, 3:5])))
    return np.array(off), np.array(stddevs)


def test_it_follows_better_than_the_fixes_and_knows_how_well(simulate):
    drive = simulate(90, noise=ImuNoise())
    off, stddevs = follow(started(drive), drive)
    raw = np.sqrt(2.0)
    assert np.sqrt(np.mean(off**2)) < 0.8 * raw
    assert 0.5 < np.sqrt(np.mean(off**2)) / np.sqrt(np.mean(stddevs**2)) < 1.7


def test_it_survives_an_outage_of_a_minute(simulate):
    drive = simulate(91, seconds=150.0, noise=ImuNoise(), outages=[(50.0, 110.0)])
    online = started(drive)
    off, _ = follow(online, drive)
    assert online.restarts == 0
    assert np.sqrt(np.mean(off[-20:] ** 2)) < 1.5


def test_a_restart_is_no_surer_than_the_state_that_it_begins_from(simulate, monkeypatch):
    """The solver throws one fix after an outage of a minute, where the batch start was sure to decimetres."""
    drive = simulate(91, seconds=150.0, noise=ImuNoise(), outages=[(50.0, 110.0)])
    online = started(drive)
    before, after = drive.fixes.stamps <= 110.0 + 1.0, drive.fixes.stamps > 110.0 + 1.0
    follow(online, replace(drive, fixes=drive.fixes[before]))
    throws = [True]
    update = gtsam.IncrementalFixedLagSmoother.update

    def once(*arguments: object) -> object:
        if throws:
            throws.clear()
            raise RuntimeError("Indeterminant linear system detected while working near variable")
        return update(*arguments)

    monkeypatch.setattr(gtsam.IncrementalFixedLagSmoother, "update", once)
    off, stddevs = follow(online, replace(drive, fixes=drive.fixes[after][:1]))
    assert online.restarts == 1
    assert off[-1] < 3 * stddevs[-1]


def test_what_does_not_follow_on_the_last_state_is_refused(simulate):
    drive = simulate(93, seconds=40.0, noise=ImuNoise())
    online = started(drive)
    old = drive.fixes[3:4]
    with pytest.raises(MeasurementError, match="expected one fix after"):
        online.add(cut(drive.imu, online.state.stamp, online.state.stamp + 1), old)
    two = drive.fixes[-2:]
    with pytest.raises(MeasurementError, match="2 fixes"):
        online.add(cut(drive.imu, online.state.stamp, drive.imu.stamps[-1]), two)
    late = GnssFixes(np.array([1000.0]), np.zeros((1, 3)), np.ones((1, 3)))
    with pytest.raises(MeasurementError, match="the IMU from there to the fix"):
        online.add(cut(drive.imu, online.state.stamp, drive.imu.stamps[-1]), late)


@pytest.mark.parametrize("lag_s", [-1.0, np.nan])
def test_a_lag_that_is_no_time_is_refused_not_met_by_gtsam(simulate, lag_s: float):
    drive = simulate(93, seconds=40.0, noise=ImuNoise())
    early = drive.fixes[drive.fixes.stamps < BEGIN_S]
    start = smooth(cut(drive.imu, 0.0, BEGIN_S), early, FRAME, None, LEVER)
    with pytest.raises(MeasurementError, match=r"lag_s: found .*, expected a number of seconds from 0 on"):
        StreamingSmoother(start, FRAME, LEVER, lag_s=lag_s)
