"""Positions of NMEA sentences, written by pynmeagps, and of what stands between them."""

from __future__ import annotations

from collections.abc import Callable
from functools import reduce
from operator import xor
from pathlib import Path

import numpy as np
import pytest
from pynmeagps import GET, NMEAMessage
from receivers import (
    gga,
    gst,
    moment,
    motion,
    nmea,
    read,
    rmc,
)
from ros import START_NS

from gnss_sem_map.errors import DataError


@pytest.mark.parametrize("kind", ["RMC", "VTG"])
def test_speed_and_course_of_nmea(tmp_path: Path, kind: str) -> None:
    """10 knots are 5.144 m/s; 120 degrees are south of east. At rest there is no course, and none is needed."""
    ns = [START_NS + k * 10**9 for k in range(3)]
    given = [(10.0, 120.0), (0.02, ""), (3.0, "")]
    sentences = [
        gga(t) + motion(t, kind, knots, course) for t, (knots, course) in zip(ns, given, strict=True)
    ]
    found = read(nmea(tmp_path, rmc(ns[0] - 10**9), *sentences)).rows[:, 10:16]
    speed = 10 * 1852 / 3600
    np.testing.assert_allclose(
        found[0, :2], [speed * np.sin(np.pi / 1.5), speed * np.cos(np.pi / 1.5)], atol=1e-6
    )
    assert found[1, :2].tolist() == [0.0, 0.0]
    assert np.isnan(found[2]).all()
    assert np.isnan(found[:, 2]).all()


@pytest.mark.parametrize("kind", ["HDT", "THS"])
def test_headings_of_nmea(tmp_path: Path, kind: str) -> None:
    """Degrees from true north, of the fix before; THS says whether it is measured (A) or dead reckoning (E)."""
    fields = ({"headingT": 123.4, "headingTu": "T"}, {"headt": 123.4, "mi": "A"})[kind == "THS"]
    bad = ({"headingT": "", "headingTu": "T"}, {"headt": 123.4, "mi": "E"})[kind == "THS"]
    sentences = [NMEAMessage("GN", kind, GET, **one).serialize().decode() for one in (fields, bad)]
    times = [START_NS, START_NS + 10**9]
    text = [gga(t) + sentence for t, sentence in zip(times, sentences, strict=True)]
    found = read(nmea(tmp_path, rmc(START_NS - 10**9), *text)).rows[:, 16]
    assert found[0] == 123.4
    assert np.isnan(found[1])


def test_nmea_heights_are_above_the_ellipsoid(tmp_path: Path) -> None:
    path = nmea(tmp_path, rmc(START_NS), gga(START_NS), gga(START_NS + 10**9))
    found = read(path)
    np.testing.assert_allclose(found.rows[:, :4], [[0, 49, 8.4, 160.1], [1, 49, 8.4, 160.1]], atol=1e-7)


def test_nmea_in_utf_16_is_the_same(tmp_path: Path) -> None:
    path = nmea(tmp_path, rmc(START_NS), gga(START_NS), gga(START_NS + 10**9))
    plain = read(path).rows
    path.write_bytes(path.read_bytes().decode().encode("utf-16"))
    np.testing.assert_array_equal(read(path).rows, plain)


def test_nmea_accuracy_by_gst_else_by_quality_and_dilution(tmp_path: Path) -> None:
    sentences = [
        rmc(START_NS),
        gga(START_NS),
        gga(START_NS + 10**9, quality=1),
        gga(START_NS + 2 * 10**9),
        gst(START_NS + 2 * 10**9),
    ]
    stddevs = read(nmea(tmp_path, *sentences)).rows[:, 4:7]
    np.testing.assert_allclose(stddevs, [[0.02, 0.02, 0.03], [3.0, 3.0, 6.0], [0.12, 0.11, 0.2]])


def test_nmea_over_midnight(tmp_path: Path) -> None:
    midnight = (START_NS // (86_400 * 10**9) + 1) * 86_400 * 10**9
    times = [midnight + k * 10**9 for k in (-2, -1, 0, 1)]
    drive = (times[0], times[-1])
    dated = nmea(tmp_path, *[s for t in times for s in (rmc(t), gga(t))])
    late = read(dated, drive).rows[:, 0]
    np.testing.assert_allclose(np.diff(late), 1.0)
    first_gga = nmea(tmp_path, rmc(times[0]), *[s for t in times for s in (gga(t), rmc(t))])
    np.testing.assert_allclose(read(first_gga, drive).rows[:, 0], late)
    undated = nmea(tmp_path, *map(gga, times))
    np.testing.assert_allclose(read(undated, drive).rows[:, 0], late)


@pytest.mark.parametrize("ahead_s", [-43_200, 43_200, 46_800])
def test_nmea_without_dates_in_local_time_is_of_the_day_of_the_drive(tmp_path: Path, ahead_s: int) -> None:
    """New Zealand is 12 or 13 hours ahead, so the day there is another one in the morning."""
    for hour in range(24):
        start = START_NS + hour * 3600 * 10**9
        local = [start + (ahead_s + k) * 10**9 for k in range(60)]
        drive = (start, start + 60 * 10**9)
        found = read(nmea(tmp_path, *map(gga, local)), drive, utc_offset_s=ahead_s)
        np.testing.assert_array_equal(found.stamps_ns, start + np.arange(60) * 10**9)


def test_nmea_without_dates_may_begin_hours_before_the_drive_or_end_hours_after_it(tmp_path: Path) -> None:
    day = START_NS // (86_400 * 10**9) * 86_400 * 10**9
    times = [day + k * 60 * 10**9 for k in range(24 * 60)]
    path = nmea(tmp_path, *map(gga, times))
    for hour in (0, 14, 23):
        start = day + (hour * 3600 + 60) * 10**9
        assert read(path, (start, start + 60 * 10**9)).stamps_ns.tolist() == times


def test_nmea_that_is_no_fix_is_counted(tmp_path: Path) -> None:
    path = nmea(
        tmp_path, rmc(START_NS), gga(START_NS, quality=0), gga(START_NS, quality=6), gga(START_NS, sep=""),
        gga(START_NS + 10**9), gga(START_NS + 2 * 10**9).replace("49", "48"), "$GNGGA,broken\n", "noise\n",
    )  # fmt: skip
    found = read(path)
    assert len(found.rows) == 1
    told = {skip.reason.partition(": ")[2]: skip.frames for skip in found.skips}
    assert told["no fix (quality 0)"] == told["no fix (quality 6)"] == told["wrong checksum"] == 1
    assert any("height above a geoid of unknown height" in why for why in told)
    with pytest.raises(DataError, match="no GGA, GNS or RMC sentence with a fix"):
        read(nmea(tmp_path, "$GPGSV,1,1,00*79\n"))


def test_nmea_among_binary_messages(tmp_path: Path) -> None:
    """Of a receiver that sends both: a byte of a message may be a dollar sign, and no line end need be between."""
    ns = [START_NS + k * 10**9 for k in range(4)]
    before = [b"\xb5b\x01\x07$\x00\xff", b"$", b"\x24GN\x24", b""]
    parts = [raw + gga(t).encode().rstrip() for raw, t in zip(before, ns, strict=True)]
    path = tmp_path / "rover.nmea"
    path.write_bytes(rmc(START_NS).encode() + b"\xb5\x62\n".join(parts))
    assert read(path).stamps_ns.tolist() == ns


def test_nmea_without_checksums(tmp_path: Path) -> None:
    """A file that has none is read; one sentence without, among others, was cut."""
    sentences = [rmc(START_NS), *(gga(START_NS + k * 10**9) for k in range(3))]
    without = [one[: one.index("*")] + "\n" for one in sentences]
    assert len(read(nmea(tmp_path, *without)).stamps_ns) == 3
    found = read(nmea(tmp_path, *sentences[:3], without[3]))
    assert len(found.stamps_ns) == 2
    assert [skip.reason for skip in found.skips] == ["1 sentences: damaged"]


def test_nmea_dates_of_another_count_of_weeks_and_of_void_sentences(tmp_path: Path) -> None:
    early = START_NS - 1024 * 7 * 86400 * 10**9
    found = read(nmea(tmp_path, rmc(early), gga(early), gga(early + 10**9)))
    assert found.stamps_ns.tolist() == [START_NS, START_NS + 10**9]
    assert any("1024 weeks early" in skip.reason for skip in found.skips)
    void = rmc(early).replace(",A,", ",V,", 1)
    void = void[: void.index("*")] + "*" + f"{reduce(xor, void[1 : void.index('*')].encode()):02X}\n"
    found = read(nmea(tmp_path, rmc(START_NS), void, gga(START_NS), gga(START_NS + 10**9)))
    assert found.stamps_ns.tolist() == [START_NS, START_NS + 10**9]


def test_of_two_nmea_fixes_of_one_moment_the_better_is_kept(tmp_path: Path) -> None:
    path = nmea(tmp_path, rmc(START_NS), gga(START_NS, 1), gga(START_NS, 4), gga(START_NS + 10**9, 5))
    found = read(path)
    assert found.stamps_ns.tolist() == [START_NS, START_NS + 10**9]
    assert found.rows[:, 4].tolist() == [0.02, 0.3]
    assert [skip.frames for skip in found.skips] == [1]


def gns(ns: int, modes: str = "RRNN", sep: object = 48.5) -> str:
    return NMEAMessage(
        "GN", "GNS", GET, time=moment(ns).time(), lat=49.0, lon=8.4, NS="N", EW="E", posMode=modes, numSV=9, HDOP=1.5,
        alt=111.6, sep=sep,
    ).serialize().decode()  # fmt: skip


@pytest.mark.parametrize(("modes", "across"), [("RRNN", 0.02), ("FANN", 0.3), ("DD", 0.9), ("AN", 3.0)])
def test_positions_of_gns_by_the_best_of_their_modes(tmp_path: Path, modes: str, across: float) -> None:
    found = read(nmea(tmp_path, rmc(START_NS), gns(START_NS, modes), gns(START_NS + 10**9, "NN")))
    np.testing.assert_allclose(found.rows[:, :4], [[0, 49, 8.4, 160.1]], atol=1e-7)
    assert found.rows[0, 4] == pytest.approx(across)
    assert [skip.reason for skip in found.skips] == ["1 sentences: no fix (quality NN)"]


@pytest.mark.parametrize("before", ["", "$GPGSV,1,1,00*79\n"])
def test_with_rmc_alone_the_trajectory_is_flat_and_that_is_said(tmp_path: Path, before: str) -> None:
    found = read(nmea(tmp_path, before, *(rmc(START_NS + k * 10**9) for k in range(3))))
    np.testing.assert_allclose(found.rows[:, :4], [[k, 49, 8.4, 0] for k in range(3)], atol=1e-7)
    np.testing.assert_allclose(found.rows[:, 4:7], np.tile([2.0, 2.0, 100.0], (3, 1)))
    [skip] = found.skips
    assert skip.reason.startswith("3 fixes")
    assert "two dimensions" in skip.reason
    with_gga = read(nmea(tmp_path, before, rmc(START_NS), gga(START_NS)))
    assert with_gga.rows[0, 3] == pytest.approx(160.1)


@pytest.mark.parametrize("ending", [".txt", ".csv", ".log"])
def test_sentences_in_a_log_of_android(tmp_path: Path, ending: str) -> None:
    """GnssLogger has other records between, and the time of the phone behind."""
    path = tmp_path / f"gnss_log{ending}"
    phone = START_NS // 10**6
    lines = [
        "# Header Description:",
        "#",
        "# Raw,utcTimeMillis,TimeNanos",
        "Fix,gps,49.0,8.4,160.0,0.5,3.9,1",
    ]
    lines += [
        f"NMEA,{sentence.strip()},{phone + 1000 * k}"
        for k in range(3)
        for sentence in (rmc(START_NS + k * 10**9), gga(START_NS + k * 10**9))
    ]
    path.write_text("\n".join(lines) + "\n")
    np.testing.assert_allclose(read(path).rows[:, :4], [[k, 49, 8.4, 160.1] for k in range(3)], atol=1e-7)


@pytest.mark.parametrize(
    "change", [str.lower, lambda end: end.replace("*0", "*")], ids=["lower case", "one digit"]
)
def test_a_right_checksum_is_one_however_it_is_written(tmp_path: Path, change: Callable[[str], str]) -> None:
    found = [rmc(START_NS)]
    for k in range(40):
        body, _, end = gga(START_NS + k * 10**9).partition("*")
        found.append(body + change("*" + end))
    path = nmea(tmp_path, *found)
    assert len(read(path).rows) == 40


def test_the_name_of_a_base_station_does_no_harm(tmp_path: Path) -> None:
    body = gga(START_NS).partition("*")[0].rstrip(",") + ",1.0,TOWN"
    checksum = reduce(xor, body[1:].encode())
    path = nmea(tmp_path, rmc(START_NS), f"{body}*{checksum:02X}\n")
    np.testing.assert_allclose(read(path).rows[:, :4], [[0, 49, 8.4, 160.1]], atol=1e-7)


def test_heights_of_nmea_above_a_geoid_that_the_log_tells(tmp_path: Path) -> None:
    path = nmea(tmp_path, rmc(START_NS), gga(START_NS, sep=""), gga(START_NS + 10**9, sep=47.0))
    np.testing.assert_allclose(read(path, geoid=48.5).rows[:, 3], [160.1, 158.6], atol=1e-6)
    alone = nmea(tmp_path, rmc(START_NS), gga(START_NS, sep=""))
    with pytest.raises(DataError, match=r"heights are above the geoid.*set `geoid:`"):
        read(alone)
