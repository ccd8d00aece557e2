"""A table says the same however it is written: the numbers are those of the plain one."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from factor_graphs import csv_log
from factor_graphs.csv_log import GNSS_COLUMNS, IMU_COLUMNS, parse_numbers
from factor_graphs.errors import MeasurementError
from factor_graphs.tables import ACROSS, NAMES, UNITS, layout_of

EPOCH_NS = 1_777_000_000_000_000_000
ROWS = np.column_stack([np.arange(5) * 0.01, np.random.default_rng(0).normal(size=(5, 6)).round(6)])
Change = Callable[[list[str], list[list[str]]], str]


def plain() -> tuple[list[str], list[list[str]]]:
    return list(IMU_COLUMNS), [[f"{v:.6f}" for v in row] for row in ROWS]


def joined(header: list[str], rows: list[list[str]], by: str = ",") -> str:
    return "".join(by.join(row) + "\n" for row in [header, *rows])


def commas(row: list[str]) -> list[str]:
    return [cell.replace(".", ",") for cell in row]


def scaled(rows: list[list[str]], columns: slice, by: float) -> list[list[str]]:
    table = np.array(rows, np.float64)
    table[:, columns] *= by
    return [[f"{v:.12g}" for v in row] for row in table]


def dated(rows: list[list[str]], form: Callable[[np.datetime64], str]) -> list[list[str]]:
    def text(seconds: str) -> str:
        return form(np.datetime64(EPOCH_NS + round(float(seconds) * 1e9), "ns"))

    return [[text(row[0]), *row[1:]] for row in rows]


def day_first(moment: np.datetime64, by: str) -> str:
    day, clock = str(moment).split("T")
    return f"{by.join(day.split('-')[::-1])} {clock}"


def in_gps_time(rows: list[list[str]]) -> list[list[str]]:
    return dated(rows, lambda t: str(t + np.timedelta64(18, "s")))


def american(moment: np.datetime64) -> str:
    day, clock = str(moment).split("T")
    year, month, number = day.split("-")
    hour = int(clock[:2])
    return f"{month}/{number}/{year} {(hour - 1) % 12 + 1}{clock[2:]} {'AM' if hour < 12 else 'PM'}"


SAME: dict[str, Change] = {
    "plain": joined,
    "semicolons": lambda h, r: joined(h, r, ";"),
    "semicolons and decimal commas": lambda h, r: joined(h, [commas(row) for row in r], ";"),
    "tabs and decimal commas": lambda h, r: joined(h, [commas(row) for row in r], "\t"),
    "spaces": lambda h, r: "".join("  ".join(f"{c:>12}" for c in row) + "\n" for row in [h, *r]),
    "names by commas, numbers by spaces": lambda h, r: ", ".join(h) + "\n" + joined(r[0], r[1:], " "),
    "a separator at the end": lambda h, r: ",".join(h) + "\n" + "".join(",".join(row) + ",\n" for row in r),
    "quotes": lambda h, r: joined([f'"{n}"' for n in h], [[f'"{c}"' for c in row] for row in r]),
    "capital names": lambda h, r: joined([n.upper() for n in h], r),
    "comment lines": lambda h, r: "# logger 7\n% of a car\n" + joined(h, [*r[:2], ["# pause"], *r[2:]]),
    "a preamble": lambda h, r: "Logger 7\nSerial: 12, height 3\n\n" + joined(h, r),
    "names in a comment": lambda h, r: "# " + joined(h, r),
    "rostopic echo -p": lambda h, r: joined(
        ["%time", "field.header.seq", "field.header.stamp"]
        + [f"field.{w}.{x}" for w in ("linear_acceleration", "angular_velocity") for x in "xyz"],
        [["9", "1", *row] for row in r],
    ).replace("field.header.stamp", "field.header.stamp [s]"),
    "other names": lambda h, r: joined(
        ["Time", *(f"acc_{x}" for x in "xyz"), *(f"Gyro {x}" for x in "XYZ")], r
    ),
    "units in brackets": lambda h, r: joined(
        ["time [s]", *(f"a{x} (m/s^2)" for x in "xyz"), *(f"w{x} [rad/s]" for x in "xyz")], r
    ),
    "g and degrees in brackets": lambda h, r: joined(
        ["t (s)", *(f"acc_{x} [g]" for x in "xyz"), *(f"gyro_{x} [°/s]" for x in "xyz")],
        scaled(scaled(r, slice(1, 4), 1 / 9.80665), slice(4, 7), 180 / np.pi),
    ),
    "units at the end of names": lambda h, r: joined(
        ["time_ms", *(f"accel_{x}_mg" for x in "xyz"), *(f"gyro_{x}_deg_s" for x in "xyz")],
        scaled(scaled(scaled(r, slice(0, 1), 1e3), slice(1, 4), 1e3 / 9.80665), slice(4, 7), 180 / np.pi),
    ),
    "a line of units": lambda h, r: joined(h, [["s", *["m/s²"] * 3, *["rad/s"] * 3], *r]),
    "a line of other units": lambda h, r: joined(
        h[:1] + [f"acc{x}" for x in "xyz"] + [f"gyr{x}" for x in "xyz"],
        [
            ["(s)", *["(g)"] * 3, *["(deg/s)"] * 3],
            *scaled(scaled(r, slice(1, 4), 1 / 9.80665), slice(4, 7), 180 / np.pi),
        ],
    ),
    "ISO times": lambda h, r: joined(h, dated(r, lambda t: f"{t}Z")),
    "ISO times without a zone": lambda h, r: joined(h, dated(r, lambda t: str(t).replace("T", " "))),
    "ISO times with a zone": lambda h, r: joined(
        h, dated(r, lambda t: f"{t + np.timedelta64(2, 'h')}+02:00")
    ),
    "ISO times west of Greenwich": lambda h, r: joined(
        h, dated(r, lambda t: f"{str(t - np.timedelta64(210, 'm')).replace('-', '/')}-0330")
    ),
    "EuRoC": lambda h, r: joined(
        [
            "#timestamp [ns]",
            *(f"a_RS_S_{x} [m s^-2]" for x in "xyz"),
            *(f"w_RS_S_{x} [rad s^-1]" for x in "xyz"),
        ],
        scaled(r, slice(0, 1), 1e9),
    ),
    "paths of topics": lambda h, r: joined(
        ["__time", *(f"/imu/data/linear_acceleration/{x}" for x in "xyz")]
        + [f"/imu.angular_velocity.{x}" for x in "xyz"],
        r,
    ),
    "the sensor before the names": lambda h, r: joined(
        ["imu_time", *(f"imu.acc.{x}" for x in "xyz"), *(f"imu_gyro_{x}" for x in "xyz")], r
    ),
    "seconds and nanoseconds": lambda h, r: joined(
        ["header.stamp.sec", "header.stamp.nanosec", *h[1:]],
        [[row[0].partition(".")[0], row[0].partition(".")[2] + "000", *row[1:]] for row in r],
    ),
    "milliseconds without a unit": lambda h, r: joined(["timestamp", *h[1:]], scaled(r, slice(0, 1), 1e3)),
    "microseconds without a unit": lambda h, r: joined(["timestamp", *h[1:]], scaled(r, slice(0, 1), 1e6)),
    "dates of Germany": lambda h, r: joined(h, dated(r, lambda t: day_first(t, "."))),
    "dates with names of months": lambda h, r: joined(
        h, dated(r, lambda t: day_first(t, "-").replace("-04-", "-Apr-"))
    ),
    "dates of America, by the half of the day": lambda h, r: joined(h, dated(r, american)),
    "date and time apart": lambda h, r: joined(
        ["Date", "Time", *h[1:]], [[*row[0].split("T"), *row[1:]] for row in dated(r, str)]
    ),
    "dates of GPS time by their name": lambda h, r: joined(["GPST", *h[1:]], in_gps_time(r)),
    "dates of GPS time by their unit": lambda h, r: joined(["time [GPST]", *h[1:]], in_gps_time(r)),
    "dates of GPS time by a line above": lambda h, r: "# time system: GPST\n" + joined(h, in_gps_time(r)),
    "dates under GPS that are UTC": lambda h, r: joined(["gps_time", *h[1:]], dated(r, lambda t: f"{t}Z")),
    "ISO times and decimal commas": lambda h, r: joined(
        h, [commas(row) for row in dated(r, lambda t: str(t)[:-3])], ";"
    ),
}


def text_of(change: Change) -> str:
    return change(*plain())


@pytest.mark.parametrize("name", SAME)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "cp1252"])
def test_a_table_says_the_same_however_it_is_written(name: str, encoding: str) -> None:
    content = text_of(SAME[name]).encode(encoding)
    for ends in (content, text_of(SAME[name]).replace("\n", "\r\n").encode(encoding)):
        found = parse_numbers(ends, IMU_COLUMNS, "imu.csv", 0.5, epoch_ns=EPOCH_NS)
        np.testing.assert_allclose(found[np.isfinite(found).all(axis=1)], ROWS, rtol=1e-9, atol=2e-7)


@pytest.mark.parametrize("unit", [1e3, 1e6, 1e9])
def test_unix_time_in_another_unit_is_seconds(unit: float) -> None:
    stamps = EPOCH_NS / 1e9 + np.arange(4) * 0.25
    content = joined(["timestamp", "speed"], [[f"{round(t * unit)}", "1"] for t in stamps]).encode()
    found = parse_numbers(content, ("stamp_s", "speed_mps"), "wheels.csv", 5.0)
    np.testing.assert_allclose(found[:, 0], stamps, rtol=0, atol=1e-3)


@pytest.mark.parametrize(
    ("header", "by"), [("speed [km/h]", 3.6), ("speed_kmh", 3.6), ("Velocity (knots)", 3600 / 1852)]
)
def test_speeds_have_their_unit(header: str, by: float) -> None:
    content = f"time;{header}\n0;{10 * by}\n1;{20 * by}\n".encode()
    found = parse_numbers(content, ("stamp_s", "speed_mps"), "wheels.csv", 5.0)
    np.testing.assert_allclose(found, [[0, 10], [1, 20]])


@pytest.mark.parametrize(
    "header",
    [
        "Time,Latitude,Longitude,Altitude,sdE,sdN,sdU",
        "time (s),lat (deg),lng [°],height [m],std_e [m],std_n [m],std_u [m]",
        "t,LAT,LON,H-Ell,SDEast,SDNorth,SDHeight",
        "gps_time,gps.latitude,gps.longitude,Alt (HAE),sd_east,sd_north,vertical_accuracy",
        "%time,field.latitude,field.longitude,field.altitude,field.position_covariance0,field.position_covariance4,"
        "field.position_covariance8",
        "seconds;latitude_rad;longitude_rad;alt_mm;std_east_cm;std_north_cm;std_up_cm",
    ],
)
def test_positions_have_the_names_of_others(header: str) -> None:
    row = np.array([1.0, 49.0, 8.4, 160.25, 0.01, 0.02, 0.03])
    given = row / [1, 180 / np.pi, 180 / np.pi, 1e-3, 1e-2, 1e-2, 1e-2] if "rad" in header else row
    given = np.append(given[:4], given[4:] ** 2) if "covariance" in header else given
    by = ";" if ";" in header else ","
    content = header.replace("seconds", "time_s") + "\n" + by.join(f"{v:.15g}" for v in given) + "\n"
    np.testing.assert_allclose(parse_numbers(content.encode(), GNSS_COLUMNS, "gnss.csv", 100.0), row[None])


@pytest.mark.parametrize("name", ["hAcc", "horizontal_accuracy"])
def test_one_horizontal_accuracy_is_that_of_east_and_north(name: str) -> None:
    content = f"time,lat,lon,height,{name},vAcc\n1,49,8.4,160,0.5,0.8\n".encode()
    found = parse_numbers(content, GNSS_COLUMNS, "gnss.csv", 100.0)
    np.testing.assert_array_equal(found, [[1, 49, 8.4, 160, 0.5, 0.5, 0.8]])


def test_times_of_day_go_on_over_midnight() -> None:
    content = joined(
        ["time", "speed"], [["23:59:59.5", "1"], ["23:59:59.75", "1"], ["00:00:00", "1"]]
    ).encode()
    found = parse_numbers(content, ("stamp_s", "speed_mps"), "wheels.csv", 5.0)
    np.testing.assert_allclose(found[:, 0] - found[0, 0], [0, 0.25, 0.5])


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"0.00,0.1,0,9.8,0,0,0\n0.01,0.1,0,9.8,0,0,0\n", "no line of names; write one"),
        (b"PK\3\4\x14\0\6\0" + bytes(300), "is no text .*save it as CSV"),
        (
            joined(["time", *IMU_COLUMNS[1:]], [[str(k), *"123456"] for k in range(9)]).encode(),
            "are these milli",
        ),
        (b"Zeit,ax,ay,az,wx,wy,wz\n0,0,0,0,0,0,0\n", "no column stamp_s .*name it so .*time"),
    ],
)
def test_what_is_no_table_with_names_is_told_the_way_out(content: bytes, said: str) -> None:
    with pytest.raises(MeasurementError, match=f"imu.csv: .*{said}"):
        parse_numbers(content, IMU_COLUMNS, "imu.csv", 0.5)


@pytest.mark.parametrize(("scale", "unit"), [(1e3, "milliseconds"), (1e6, "microseconds"), (1.0, "")])
def test_a_unit_that_steps_show_is_told(scale: float, unit: str) -> None:
    content, told = (
        joined(["time", "speed"], [[f"{k * 0.25 * scale}", "1"] for k in range(9)]).encode(),
        list[str](),
    )
    found = parse_numbers(content, ("stamp_s", "speed_mps"), "wheels.csv", 5.0, told=told)
    np.testing.assert_allclose(found[:, 0], np.arange(9) * 0.25)
    assert [f"taken as {unit}" in text for text in told] == [True] * bool(unit)


def test_a_date_that_no_calendar_has_is_a_row_without_a_stamp() -> None:
    content = joined(
        ["time", "speed"], [["2026-02-30T00:00:00Z", "1"], ["2026-02-28T00:00:00Z", "2"]]
    ).encode()
    found = parse_numbers(content, ("stamp_s", "speed_mps"), "wheels.csv", 5.0)
    assert np.isnan(found[0, 0])
    assert found[1, 0] == np.datetime64("2026-02-28", "s").astype(float)


@pytest.mark.parametrize(
    ("header", "said"),
    [
        ("time,lat,latitude_deg_wgs84", None),
        ("time,lat,lat", "column lat_deg is missing or repeated in time,lat,lat"),
        ("time,lat [hPa],lon", "column 'lat \\[hPa\\]' is in a unit that is not known; expected one of deg"),
    ],
)
def test_two_columns_of_one_name_or_an_unknown_unit_are_refused(header: str, said: str | None) -> None:
    layout = layout_of(f"{header}\n1,2,3\n".encode(), ("stamp_s", "lat_deg"))
    if said is None:
        assert layout.column("lat_deg") is not None
    else:
        with pytest.raises(MeasurementError, match=said):
            layout.column("lat_deg")


def test_no_name_is_that_of_two_columns_of_one_table() -> None:
    for table in (IMU_COLUMNS, GNSS_COLUMNS, csv_log.WHEEL_COLUMNS):
        words = [word for name in table for word in NAMES[name] if word not in ACROSS.split()]
        assert len(words) == len(set(words))
    assert all(word == word.lower() for units in UNITS.values() for word in units)


def test_a_file_on_disk_with_semicolons_is_read(tmp_path: Path) -> None:
    (tmp_path / "wheels.csv").write_text("Zeit [s];Geschwindigkeit\n", "utf-8")
    with pytest.raises(MeasurementError, match="no column stamp_s"):
        csv_log.read_wheels(tmp_path)
    (tmp_path / "wheels.csv").write_text("\ufefftime [s];speed [km/h]\n0,0;3,6\n0,1;7,2\n", "utf-8")
    speeds = csv_log.read_wheels(tmp_path)
    assert speeds is not None
    np.testing.assert_allclose(speeds.speeds, [1.0, 2.0])
