"""Positions in files of receivers: RTKLIB, NMEA, SBET; their clocks and their accuracy."""

from __future__ import annotations

import datetime
import json
from functools import reduce
from operator import xor
from pathlib import Path

import numpy as np
import pytest
import ros
from pynmeagps import GET, NMEAMessage
from ros import START_NS

from factor_graphs.geodesy import LocalFrame
from factor_graphs.receiver_rows import fixes_of, velocities_of
from gnss_sem_map.datasets import open_drive
from gnss_sem_map.datasets.gnss_files import FileFixes, GnssFile, read_gnss_file
from gnss_sem_map.datasets.gnss_files.time_systems import GPS_EPOCH_NS, WEEK_NS, gps_minus_utc_s
from gnss_sem_map.errors import DataError
from gnss_sem_map.sensor_log import SensorLog

LEAP_NS = 18 * 10**9
DRIVE_NS = (START_NS, START_NS + 60 * 10**9)


def read(path: Path, drive_ns: tuple[int, int] | None = DRIVE_NS, **about: object) -> FileFixes:
    return read_gnss_file(GnssFile(path=path.name, **about), path.parent, START_NS, drive_ns)  # type: ignore[arg-type]


def moment(ns: int) -> datetime.datetime:
    return datetime.datetime.fromtimestamp(ns // 10**9, datetime.UTC).replace(microsecond=ns % 10**9 // 1000)


# ---- time systems


def test_leap_seconds_at_known_moments() -> None:
    """2012: 15, then 16 from July on; 2017: 18; 1980: none (IERS Bulletin C)."""
    days = ["1980-02-01", "2012-06-30", "2012-07-02", "2016-12-31T23:59:00", "2017-01-02", "2026-06-01"]
    ns = np.array(days, "datetime64[ns]").astype(np.int64)
    assert gps_minus_utc_s(ns).tolist() == [0, 15, 16, 17, 18, 18]


# ---- RTKLIB


def pos(folder: Path, rows: list[str], header: str | None = None) -> Path:
    columns = (
        "%  GPST                  latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)"
    )
    (folder / "rover.pos").write_text(
        "% program : RTKPOST\n" + (header or columns) + "\n" + "\n".join(rows) + "\n"
    )
    return folder / "rover.pos"


def pos_row(ns: int, quality: int = 1, deviations: str = "0.0040 0.0030 0.0090", lat: float = 49.0) -> str:
    time = moment(ns).strftime("%Y/%m/%d %H:%M:%S.%f")[:-3]
    return f"{time}   {lat:.9f}    8.400000000   160.1234   {quality}   9   {deviations}   0 0 0 0.10 1.5"


def test_a_pos_file_in_gps_time(tmp_path: Path) -> None:
    path = pos(tmp_path, [pos_row(START_NS + LEAP_NS + k * 200_000_000, lat=49 + k * 1e-6) for k in range(3)])
    found = read(path)
    np.testing.assert_allclose(found.rows[:, 0], [0.0, 0.2, 0.4], atol=1e-9)
    np.testing.assert_allclose(found.rows[1, 1:4], [49.000001, 8.4, 160.1234])
    assert found.skips == []


def test_no_row_is_better_than_its_quality(tmp_path: Path) -> None:
    path = pos(
        tmp_path, [pos_row(START_NS + LEAP_NS + q * 10**9, q, "0.0040 0.9000 0.0090") for q in (1, 2, 5)]
    )
    stddevs = read(path).rows[:, 4:7]
    assert stddevs.tolist() == [[0.9, 0.01, 0.02], [0.9, 0.3, 0.5], [2.0, 2.0, 4.0]]


def test_a_quality_may_be_written_with_decimals(tmp_path: Path) -> None:
    """As tables of numbers are written: 1.0000000."""
    row = pos_row(START_NS + LEAP_NS).replace("   1   9", "   1.0000000   9.0000000")
    assert read(pos(tmp_path, [row])).rows[0, 4:7].tolist() == [0.01, 0.01, 0.02]


def test_a_pos_file_by_week_or_in_utc(tmp_path: Path) -> None:
    week, rest = divmod(START_NS + LEAP_NS - GPS_EPOCH_NS, WEEK_NS)
    by_week = pos(tmp_path, [f"{week} {rest / 1e9:.3f} 49.0 8.4 160.0 1 9 0.01 0.01 0.02"])
    assert read(by_week).rows[0, 0] == pytest.approx(0.0, abs=1e-6)
    in_utc = pos(tmp_path, [pos_row(START_NS)], "%  UTC   latitude(deg) longitude(deg) height(m) Q")
    assert read(in_utc).rows[0, 0] == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize(
    ("header", "said"),
    [
        ("%  GPST  x-ecef(m)  y-ecef(m)  z-ecef(m)  Q", "out-solformat=llh"),
        ("%  GPST  latitude(d'\") longitude(d'\") height(m) Q", "out-degform=deg"),
        (
            "% (lat/lon/height=WGS84/geodetic)\n%  GPST  latitude(deg) longitude(deg) height(m) Q",
            "above the geoid",
        ),
        ("%  JST  latitude(deg) longitude(deg) height(m) Q", "out-timesys=gpst"),
    ],
)
def test_other_forms_of_pos_are_refused_with_the_option(tmp_path: Path, header: str, said: str) -> None:
    with pytest.raises(DataError, match=said):
        read(pos(tmp_path, [pos_row(START_NS)], header))


VELOCITY_COLUMNS = (
    "%  GPST  latitude(deg) longitude(deg) height(m) Q ns sdn(m) sde(m) sdu(m) sdne(m) sdeu(m) sdun(m) age(s) ratio"
    " vn(m/s) ve(m/s) vu(m/s) sdvn sdve sdvu sdvne sdveu sdvun"
)


def test_covariances_and_velocities_of_a_pos_file(tmp_path: Path) -> None:
    """sdne is the root of the covariance with its sign: -0.5^2 of 1 m and 0.5 m is a correlation of -0.5."""
    row = pos_row(START_NS + LEAP_NS, 1, "1.0 0.5 2.0 -0.5 0.6 0.0 0.0 3.1 1.5 -2.0 0.1 0.05 0.06 0.09 0 0 0")
    found = read(pos(tmp_path, [row], VELOCITY_COLUMNS))
    np.testing.assert_allclose(found.rows[0, 7:10], [-0.5, 0.36, 0.0])
    np.testing.assert_allclose(found.rows[0, 10:16], [-2.0, 1.5, 0.1, 0.06, 0.05, 0.09])
    without = read(pos(tmp_path, [row]))  # the header does not tell that there are velocities
    np.testing.assert_allclose(without.rows[0, 7:10], [-0.5, 0.36, 0.0])
    assert np.isnan(without.rows[0, 10:]).all()


def test_velocities_of_a_real_walk(real_data: Path) -> None:
    """They are those of its positions: summed up they lead to the same place within their noise."""
    rows = read(real_data / "gnss_imu_walk" / "gnss_1730_sf.pos", None).rows
    frame = LocalFrame(*rows[0, 1:4].tolist())
    velocities, _ = velocities_of(rows, frame)
    fixes, _, _ = fixes_of(rows, frame)
    assert velocities is not None
    v, dt = velocities.velocities, np.diff(fixes.stamps)
    way = np.sum((v[1:] + v[:-1]) / 2 * dt[:, None], axis=0)
    assert np.linalg.norm(way - (fixes.positions[-1] - fixes.positions[0])) < 0.02 * np.abs(v * 0.25).sum()


def test_lines_of_no_solution_are_counted(tmp_path: Path) -> None:
    rows = [pos_row(START_NS + LEAP_NS), pos_row(START_NS + LEAP_NS, quality=0), "2026/05/28 cut off"]
    [skip] = read(pos(tmp_path, rows)).skips
    assert (skip.what, skip.frames) == ("fix", 2)
    with pytest.raises(DataError, match="found no solution among 1 lines"):
        read(pos(tmp_path, ["nothing"]))


@pytest.mark.parametrize("time", ["99999999999 0.000", "99999/01/01 00:00:00.000", "1500/01/01 00:00:00.000"])
def test_lines_of_impossible_years_are_counted(tmp_path: Path, time: str) -> None:
    wrong = f"{time} 49.0 8.4 160.0 1 9 0.01 0.01 0.02"
    found = read(pos(tmp_path, [pos_row(START_NS + LEAP_NS), wrong]))
    assert found.stamps_ns.tolist() == [START_NS]
    assert [skip.frames for skip in found.skips] == [1]


# ---- NMEA, written by pynmeagps


def gga(ns: int, quality: int = 4, sep: object = 48.5, hdop: float = 1.5) -> str:
    return NMEAMessage(
        "GN", "GGA", GET, time=moment(ns).time(), lat=49.0, lon=8.4, NS="N", EW="E", quality=quality, numSV=9,
        HDOP=hdop, alt=111.6, altUnit="M", sep=sep, sepUnit="M",
    ).serialize().decode()  # fmt: skip


def rmc(ns: int) -> str:
    now = moment(ns)
    return NMEAMessage(
        "GN", "RMC", GET, time=now.time(), status="A", lat=49.0, lon=8.4, NS="N", EW="E", spd=1.0, date=now.date()
    ).serialize().decode()  # fmt: skip


def motion(ns: int, kind: str, knots: float, course: float | str) -> str:
    time = moment(ns)
    if kind == "VTG":
        return NMEAMessage(
            "GN", "VTG", GET, cogt=course, cogtUnit="T", sogn=knots, sognUnit="N", sogk=0.0, sogkUnit="K"
        ).serialize().decode()  # fmt: skip
    return NMEAMessage(
        "GN", "RMC", GET, time=time.time(), status="A", lat=49.0, lon=8.4, NS="N", EW="E", spd=knots, cog=course,
        date=time.date(),
    ).serialize().decode()  # fmt: skip


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


def gst(ns: int) -> str:
    return NMEAMessage(
        "GN", "GST", GET, time=moment(ns).time(), rangeRms=1.0, stdLat=0.11, stdLong=0.12, stdAlt=0.2
    ).serialize().decode()  # fmt: skip


def nmea(folder: Path, *sentences: str) -> Path:
    (folder / "rover.nmea").write_text("".join(sentences))
    return folder / "rover.nmea"


def test_nmea_heights_are_above_the_ellipsoid(tmp_path: Path) -> None:
    path = nmea(tmp_path, rmc(START_NS), gga(START_NS), gga(START_NS + 10**9))
    found = read(path)
    np.testing.assert_allclose(found.rows[:, :4], [[0, 49, 8.4, 160.1], [1, 49, 8.4, 160.1]], atol=1e-7)


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
    assert any("height above the ellipsoid is unknown" in why for why in told)
    with pytest.raises(DataError, match="no GGA sentence with a fix"):
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


# ---- SBET


def sbet(folder: Path, seconds: np.ndarray, name: str = "out.sbet") -> Path:
    rows = np.zeros((len(seconds), 17))
    rows[:, 0], rows[:, 1], rows[:, 2], rows[:, 3] = seconds, np.radians(49.0), np.radians(8.4), 160.0
    rows.astype("<f8").tofile(folder / name)
    return folder / name


def week_seconds(ns: int) -> float:
    return (ns - GPS_EPOCH_NS) % WEEK_NS / 1e9


def test_an_sbet_finds_its_week_and_is_thinned(tmp_path: Path) -> None:
    path = sbet(tmp_path, week_seconds(START_NS + LEAP_NS) + np.arange(0, 2, 0.005))
    found = read(path, stddevs_m=(0.02, 0.02, 0.05))
    np.testing.assert_allclose(found.rows[:, 0], np.arange(20) * 0.1, atol=6e-3)
    np.testing.assert_allclose(found.rows[0, 1:7], [49.0, 8.4, 160.0, 0.02, 0.02, 0.05])


def test_an_sbet_needs_its_accuracy(tmp_path: Path) -> None:
    seconds = week_seconds(START_NS + LEAP_NS) + np.arange(0, 2, 0.005)
    path = sbet(tmp_path, seconds)
    with pytest.raises(DataError, match="does not tell its accuracy; set `accuracy:` to its smrmsg file"):
        read(path)
    errors = np.zeros((3, 10))
    errors[:, 0], errors[:, 1:4] = seconds[[0, 200, 399]], [0.1, 0.2, 0.3]
    errors.tofile(tmp_path / "smrmsg.out")
    np.testing.assert_allclose(read(path, accuracy="smrmsg.out").rows[:, 4:7], [[0.2, 0.1, 0.3]] * 20)


def test_other_bytes_are_no_sbet(tmp_path: Path) -> None:
    path = sbet(tmp_path, np.arange(0, 2, 0.01))
    path.write_bytes(path.read_bytes()[:-3])
    with pytest.raises(DataError, match="expected rows of 17 doubles; is it truncated"):
        read(path, stddevs_m=(1, 1, 1))
    np.random.default_rng(0).normal(0, 1e9, (10, 17)).tofile(path)
    with pytest.raises(DataError, match="no rising time of a week"):
        read(path, stddevs_m=(1, 1, 1))


# ---- clocks and logs


def test_local_time_is_said_or_found(tmp_path: Path) -> None:
    rows = [pos_row(START_NS + LEAP_NS + (7200 + k) * 10**9) for k in range(60)]
    path = pos(tmp_path, rows)
    with pytest.raises(
        DataError, match=r"no fix lies within the drive.*is it local time\? set utc_offset_s: 7200"
    ):
        read(path)
    assert read(path, utc_offset_s=7200).rows[0, 0] == pytest.approx(0.0, abs=1e-6)


def test_the_time_system_may_be_said(tmp_path: Path) -> None:
    path = pos(tmp_path, [pos_row(START_NS)])
    assert read(path, time="utc").rows[0, 0] == pytest.approx(0.0, abs=1e-6)
    before = (START_NS - 60 * 10**9, START_NS)
    assert read(path, before).rows[0, 0] == pytest.approx(-18.0, abs=1e-6)


def test_a_file_of_another_day_is_refused(tmp_path: Path) -> None:
    path = pos(tmp_path, [pos_row(START_NS + 40 * 86_400 * 10**9)])
    with pytest.raises(DataError, match="is it the file of this drive"):
        read(path)


def test_no_file_out_of_the_folder(tmp_path: Path) -> None:
    for name in ("../rover.pos", "/etc/hosts"):
        with pytest.raises(DataError, match="expected a path within this folder"):
            read_gnss_file(GnssFile(path=name), tmp_path, None, None)


def positions_of(log: SensorLog) -> np.ndarray:
    assert log.gnss is not None
    return log.gnss.positions


def test_a_table_log_may_have_its_positions_in_a_file(tmp_path: Path) -> None:
    stamps = np.arange(0, 20, 0.01)
    rows = "".join(f"{t:.2f},0.1,0,9.81,0,0,0.01\n" for t in stamps)
    (tmp_path / "imu.csv").write_text("stamp_s,ax,ay,az,wx,wy,wz\n" + rows)
    pos(tmp_path, [pos_row(START_NS + LEAP_NS + k * 10**9, lat=49 + 1e-5 * k) for k in range(20)])
    (tmp_path / "log.yaml").write_text(json.dumps({"epoch_ns": START_NS, "gnss_file": {"path": "rover.pos"}}))
    log = open_drive(tmp_path)
    assert len(positions_of(log)) == 20
    assert log.gnss is not None
    np.testing.assert_allclose(log.gnss.stamps, np.arange(20.0), atol=1e-6)
    (tmp_path / "gnss.csv").write_text("stamp_s\n")
    with pytest.raises(DataError, match=r"gnss_file in log\.yaml as well"):
        open_drive(tmp_path)


def test_a_bag_may_have_its_positions_in_a_file(tmp_path: Path) -> None:
    bag = ros.write(tmp_path / "drive", ros.drive(), keep=lambda one: one[0] != "/fix")
    pos(bag, [pos_row(START_NS + LEAP_NS + k * 500_000_000, lat=49 + 1e-5 * k) for k in range(4)])
    (bag / "rig.yaml").write_text(json.dumps({"gnss": {"file": {"path": "rover.pos"}}}))
    log = open_drive(bag)
    assert len(positions_of(log)) == 4
    assert log.epoch_ns == pytest.approx(START_NS, abs=1000)
    assert log.scans[0].stamp == pytest.approx(0.0, abs=1e-6)
