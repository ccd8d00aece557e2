"""Noise of an IMU at rest: what was simulated is found within its statistical error, and what is not there is not."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from factor_graphs.allan_deviation import FLICKER, AxisNoise, noise_of, worst
from factor_graphs.at_rest import LEAST_SPAN_S, span_at_rest
from factor_graphs.errors import MeasurementError
from factor_graphs.measurements import ImuSamples

Array = NDArray[np.float64]

RATE = 50.0
DENSITY, WALK = {"gyroscope": 1.7e-4, "accelerometer": 2e-3}, {"gyroscope": 5e-6, "accelerometer": 5e-5}


def at_rest(seconds: float, seed: int = 0, walks: bool = True) -> ImuSamples:
    """White noise and a random walk of the bias, of known densities; z points up."""
    rng, n = np.random.default_rng(seed), round(seconds * RATE)
    values = {}
    for sensor in DENSITY:
        white = DENSITY[sensor] * np.sqrt(RATE) * rng.standard_normal((n, 3))
        steps = WALK[sensor] / np.sqrt(RATE) * rng.standard_normal((n, 3))
        values[sensor] = white + walks * np.cumsum(steps, axis=0)
    return ImuSamples(np.arange(n) / RATE, values["accelerometer"] + [0, 0, 9.81], values["gyroscope"])


def of(axes: list[AxisNoise], sensor: str) -> Array:
    return np.array([axis.numbers for axis in axes if axis.sensor == sensor])


@pytest.fixture(scope="module")
def hour() -> ImuSamples:
    return at_rest(3600)


@pytest.mark.parametrize("sensor", DENSITY)
def test_known_densities_are_found_within_the_statistical_error(hour: ImuSamples, sensor: str) -> None:
    """Of an hour the density has 0.5 %, the walk 16 %; the curve's lowest point is sqrt(2 N K / sqrt(3))."""
    density, walk = DENSITY[sensor], WALK[sensor]
    found = of(noise_of(hour), sensor)
    assert found[:, 0] == pytest.approx(density, rel=0.02)
    assert found[:, 2] == pytest.approx(walk, rel=0.5)
    assert found[:, 2].mean() == pytest.approx(walk, rel=0.3)
    lowest = np.sqrt(2 * density * walk / np.sqrt(3) / FLICKER)
    assert found[:, 1] == pytest.approx(lowest, rel=0.25)


def test_white_noise_is_what_numpy_says_and_nothing_else_is_told() -> None:
    white = at_rest(600, walks=False)
    axes = noise_of(white)
    plain = white.angular_rate.std(axis=0) / np.sqrt(RATE)
    assert of(axes, "gyroscope")[:, 0] == pytest.approx(plain, rel=0.03)
    for axis in axes:
        assert np.isnan(axis.numbers[1:]).all()
        assert axis.why[0] == ""
        assert all(why.startswith("needs ") and why.endswith(" s") for why in axis.why[1:])


def test_a_record_that_is_too_short_for_the_walk_says_how_long_it_would_take(hour: ImuSamples) -> None:
    """The walk is most of the variance beyond sqrt(3) N/K, 59 s; so a record of a thousand seconds shows it."""
    short = noise_of(hour[: round(300 * RATE)])
    assert np.isnan(of(short, "gyroscope")[:, 2]).all()
    needed = [float(axis.why[2].split()[-2]) for axis in short if axis.sensor == "gyroscope"]
    assert np.isfinite(of(noise_of(hour), "gyroscope")).all()
    assert min(needed) > 300


def test_a_shaken_unit_has_no_density(hour: ImuSamples) -> None:
    shaking = 0.2 * np.sin(2 * np.pi * 0.05 * hour.stamps)[:, None]
    shaken = ImuSamples(hour.stamps, hour.specific_force + shaking, hour.angular_rate)
    [told] = {axis.why[0] for axis in noise_of(shaken) if axis.sensor == "accelerometer"}
    assert "no part of the curve is of white noise" in told


def test_the_worst_axis_is_the_largest_number(hour: ImuSamples) -> None:
    louder = ImuSamples(hour.stamps, hour.specific_force, hour.angular_rate * [1, 3, 1])
    numbers, _ = worst(noise_of(louder), "gyroscope")
    assert numbers[0] == pytest.approx(3 * DENSITY["gyroscope"], rel=0.02)


def test_what_moves_is_cut_out(hour: ImuSamples) -> None:
    """Carried in, put down for ten minutes, carried away."""
    t = hour.stamps[: round(800 * RATE)]
    moves = ((t < 100) | (t > 700))[:, None]
    swing = moves * np.sin(2 * np.pi * t / np.array([[1.3], [2.1], [0.9]])).T
    carried = ImuSamples(t, hour.specific_force[: len(t)] + swing, hour.angular_rate[: len(t)] + 0.3 * swing)
    rest = span_at_rest(carried)
    assert rest.stamps[[0, -1]] == pytest.approx([100, 700], abs=1.5)
    assert of(noise_of(rest), "gyroscope")[:, 0] == pytest.approx(DENSITY["gyroscope"], rel=0.05)


def test_a_slow_imu_stands_as_well(hour: ImuSamples) -> None:
    """Ten samples a second, as of a KITTI drive: by chance some seconds scatter twice as much as others."""
    slow = span_at_rest(hour[::5])
    assert np.ptp(slow.stamps) == pytest.approx(3600, abs=5)
    assert len(span_at_rest(hour[: 5 * 601 : 5])) >= 600  # whose parts are of other sizes
    found = of(noise_of(slow), "gyroscope")[:, 0]
    assert found == pytest.approx(DENSITY["gyroscope"] * np.sqrt(5), rel=0.03)


def changed(hour: ImuSamples, seconds: float, **change: Array) -> ImuSamples:
    part = hour[: round(seconds * RATE)]
    values = {"stamps": part.stamps, "specific_force": part.specific_force, "angular_rate": part.angular_rate}
    return ImuSamples(**values | change)


def test_a_gap_ends_the_part_that_is_used(hour: ImuSamples) -> None:
    part = hour[: round(300 * RATE)]
    late = part.stamps + 5.0 * (part.stamps > 100)
    rest = span_at_rest(changed(hour, 300, stamps=late))
    assert rest.stamps[[0, -1]] == pytest.approx([105, 305], abs=1)


def test_what_is_no_record_at_rest_is_refused(hour: ImuSamples) -> None:
    part = hour[: round(200 * RATE)]
    t = part.stamps
    slow = np.sin(2 * np.pi * t / 90)[:, None]
    in_pairs = t + 0.018 * (np.arange(len(t)) % 2 == 0)
    for samples, said in (
        (
            hour[: round(40 * RATE)],
            f"at rest, without gaps, for 40 s at most of 40 s, expected {LEAST_SPAN_S:.0f} s",
        ),
        (
            changed(hour, 200, specific_force=part.specific_force + slow),
            "moves: its mean specific force changes by",
        ),
        (
            changed(hour, 200, angular_rate=part.angular_rate + 0.02 * slow),
            "moves: its mean angular rate changes by",
        ),
        (
            changed(hour, 200, specific_force=part.specific_force / 9.81),
            "specific force at rest is 1 m/s², expected",
        ),
        (changed(hour, 200, stamps=in_pairs), "sampling varies: steps of 2.00 to 38.00 ms"),
    ):
        with pytest.raises(MeasurementError, match=said) as refused:
            span_at_rest(samples)
        assert "\n" not in str(refused.value)


def test_a_coarse_gyroscope_is_at_rest_although_most_seconds_are_constant(hour: ImuSamples) -> None:
    coarse = np.round(hour.angular_rate / 0.008) * 0.008
    rest = span_at_rest(ImuSamples(hour.stamps, hour.specific_force, coarse))
    assert np.ptp(rest.stamps) == pytest.approx(3600, abs=1)


def test_an_axis_without_resolution_is_left_out_and_named(hour: ImuSamples) -> None:
    part = hour[: round(200 * RATE)]
    rates = part.angular_rate.copy()
    rates[:, 0], rates[:, 1] = 0.0, np.round(rates[:, 1] / 0.004) * 0.004
    x, y, z, *_ = noise_of(changed(hour, 200, angular_rate=rates))
    assert x.why[0] == "is 0 all the time"
    assert "0.004 apart, and scatters by less" in y.why[0]
    assert np.isnan([x.numbers, y.numbers]).all()
    assert z.numbers[0] == pytest.approx(DENSITY["gyroscope"], rel=0.05)
    with pytest.raises(MeasurementError, match="199 samples at rest, expected 200 or more"):
        noise_of(hour[:199])
    with pytest.raises(MeasurementError, match=r"gyroscope: wx is 0 all the time; wy is 0 .*; wz is 0"):
        noise_of(changed(hour, 200, angular_rate=np.zeros_like(rates)))
