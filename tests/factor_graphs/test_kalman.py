import numpy as np
import pytest

from factor_graphs.accuracy import anees_band, errors
from factor_graphs.geodesy import LocalFrame
from factor_graphs.kalman import kalman_smooth
from factor_graphs.measurements import GnssFixes, ImuNoise
from factor_graphs.settings import SmootherSettings
from factor_graphs.smoothing import smooth

FRAME = LocalFrame(49.0, 8.4, 115.0)
LEVER = np.array([0.5, 0.3, 1.0])


def test_without_noise_the_filter_follows_the_truth(simulate):
    drive = simulate(70, seconds=60.0)
    k = kalman_smooth(drive.imu, drive.fixes, FRAME, None, LEVER)
    assert errors(k.smoothed, drive.motion.trajectory(k.smoothed.stamps)).ate_m < 0.1


def test_smoothing_beats_filtering_and_the_graph_beats_both(simulate):
    figures = {"filter": [], "rts": [], "graph": []}
    for seed in range(3):
        drive = simulate(71 + seed, noise=ImuNoise(), outages=[(50.0, 70.0)])
        k = kalman_smooth(drive.imu, drive.fixes, FRAME, None, LEVER)
        settings = SmootherSettings(standing_stddev_mps=None, vehicle_constraint="off")
        graph = smooth(drive.imu, drive.fixes, FRAME, settings, LEVER).keyframes
        truth = drive.motion.trajectory(graph.stamps)
        for name, t in (("filter", k.filtered), ("rts", k.smoothed), ("graph", graph)):
            figures[name].append(errors(t, truth).horizontal_rms_m)
    means = {name: np.mean(values) for name, values in figures.items()}
    assert means["rts"] < 0.7 * means["filter"]
    assert means["graph"] <= 1.02 * means["rts"]


@pytest.mark.slow
def test_its_innovations_are_as_large_as_it_expects(simulate):
    nis = np.concatenate([_settled_nis(simulate(80 + seed, noise=ImuNoise())) for seed in range(3)])
    low, high = anees_band(3, len(nis), confidence=0.9999)
    assert low < nis.mean() < high


def _settled_nis(drive):
    k = kalman_smooth(drive.imu, drive.fixes, FRAME, None, LEVER)
    return k.nis[30:]


def test_a_wild_fix_is_gated_and_a_lost_filter_comes_back(simulate):
    drive = simulate(85, noise=ImuNoise())
    positions = drive.fixes.positions.copy()
    positions[60] += [30.0, 0.0, 0.0]
    positions[80:] += [40.0, 40.0, 0.0]  # the world has moved: the filter must follow, not die
    k = kalman_smooth(
        drive.imu, GnssFixes(drive.fixes.stamps, positions, drive.fixes.stddevs), FRAME, None, LEVER
    )
    assert k.gated[60]
    assert k.gated[80:86].all()
    assert k.gated[86:].sum() <= 2
    assert (
        np.linalg.norm(
            k.filtered.positions[-5:, :2] - drive.motion.poses(k.filtered.stamps[-5:])[:, :2, 3] - 40.0,
            axis=1,
        ).max()
        < 5
    )
