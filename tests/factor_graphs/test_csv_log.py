"""A CSV log is read exactly, or repaired with a count of the rows, or refused in one line that names the file."""

import warnings

import numpy as np
import pytest

from factor_graphs.csv_log import GNSS_COLUMNS, IMU_COLUMNS, read_csv, read_wheels
from factor_graphs.errors import MeasurementError, RepairWarning
from factor_graphs.geodesy import LocalFrame

FRAME = LocalFrame(49.0, 8.4, 115.0)


def rows_of(path):
    header, *rows = path.read_text().splitlines()
    return header, [row.split(",") for row in rows]


def put(path, header, rows):
    path.write_text("\n".join([header, *(",".join(row) for row in rows)]) + "\n")


@pytest.fixture
def log(tmp_path):
    """40 IMU rows at 100 Hz and 12 fixes at 1 Hz along a line to the east."""
    rng = np.random.default_rng(0)
    imu = np.column_stack([np.arange(40) * 0.01, rng.standard_normal((40, 6))])
    stamps = np.arange(12.0)
    places = FRAME.to_geodetic(np.column_stack([10 * stamps, 0 * stamps, 0 * stamps]))
    gnss = np.column_stack([stamps, *places, np.full((12, 3), 1.5)])
    for name, columns, rows in (("imu", IMU_COLUMNS, imu), ("gnss", GNSS_COLUMNS, gnss)):
        put(tmp_path / f"{name}.csv", ",".join(columns), [[repr(float(v)) for v in row] for row in rows])
    return tmp_path


def changed(path, change):
    header, rows = rows_of(path)
    header, rows = change(header, rows)
    put(path, header, rows)


def cell(row, column, value):
    def change(header, rows):
        rows[row][column] = value
        return header, rows

    return change


def test_every_number_is_read_as_it_stands_and_nothing_is_said(log):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        imu, fixes, frame = read_csv(log)
    _, rows = rows_of(log / "imu.csv")
    read = np.column_stack([imu.stamps, imu.specific_force, imu.angular_rate])
    np.testing.assert_array_equal(read, np.array(rows, dtype=np.float64))
    assert frame.lat_deg == pytest.approx(FRAME.lat_deg, abs=1e-12)
    np.testing.assert_allclose(fixes.positions, np.outer(np.arange(12.0), [10.0, 0.0, 0.0]), atol=1e-6)
    np.testing.assert_array_equal(fixes.stddevs, np.full((12, 3), 1.5))


def test_the_order_of_columns_spaces_and_other_columns_do_not_matter(log):
    before, *_ = read_csv(log)

    def change(header, rows):
        header = ", ".join(["note", *reversed(header.split(","))])
        return "\ufeff" + header, [["why not", *(f" {v} " for v in reversed(row))] for row in rows]

    changed(log / "imu.csv", change)
    after, *_ = read_csv(log)
    for name in ("stamps", "specific_force", "angular_rate"):
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name))


@pytest.mark.parametrize(
    ("name", "row", "column", "value", "says"),
    [
        ("imu.csv", 3, 2, "nan", r"imu\.csv: IMU: 40 rows; 1 not finite, dropped"),
        ("imu.csv", 3, 2, "n/k", r"imu\.csv: IMU: 40 rows; 1 not finite, dropped"),
        ("imu.csv", 3, 0, "2026-11-23T15:26:52.1", r"imu\.csv: IMU: 40 rows; 1 not finite, dropped"),
        ("imu.csv", 3, 6, "1,2", r"imu\.csv: IMU: 40 rows; 1 not finite, dropped"),
        ("gnss.csv", 5, 1, "-", r"gnss\.csv: 1 rows dropped: no place on Earth, or 0, 0"),
        ("imu.csv", 3, 0, "", r"imu\.csv: IMU: 40 rows; 1 not finite, dropped"),
        ("imu.csv", 3, 1, "1e12", r"imu\.csv: IMU: 40 rows; 1 not finite, dropped"),
        ("imu.csv", 3, 0, "0.02", r"imu\.csv: IMU: 40 rows; 1 repeated, dropped"),
        ("imu.csv", 3, 0, "1.7e9", r"imu\.csv: IMU: 40 rows; 1 with a stamp far off all others, dropped"),
        ("gnss.csv", 0, 1, "", r"gnss\.csv: 1 rows dropped: no place on Earth, or 0, 0"),
        ("gnss.csv", 0, 1, "91", r"gnss\.csv: 1 rows dropped: no place on Earth"),
        ("gnss.csv", 5, 3, "", r"gnss\.csv: 1 rows dropped: a place without height"),
        ("gnss.csv", 5, 4, "0", r"gnss\.csv: 1 rows dropped: a standard deviation that is not above 0"),
        ("gnss.csv", 5, 1, "59", r"gnss\.csv: 1 rows dropped: too far from the fixes around"),
        ("gnss.csv", 5, 0, "nan", r"gnss\.csv: 1 rows dropped: no stamp"),
    ],
)
def test_a_bad_row_costs_that_row_only_and_is_counted(log, name, row, column, value, says):
    before = read_csv(log)
    changed(log / name, cell(row, column, value))
    with pytest.warns(RepairWarning, match=says) as caught:
        imu, fixes, _ = read_csv(log)
    assert len(caught) == 1
    assert caught[0].filename == __file__, "the warning points at the caller"
    lost = {"imu.csv": len(before[0]) - len(imu), "gnss.csv": len(before[1]) - len(fixes)}
    assert lost == {"imu.csv": 0, "gnss.csv": 0} | {name: 1}


@pytest.mark.parametrize("kept", ["0.39", "0.39,", "0.39,1.2,-"])
def test_a_last_line_that_was_cut_off_costs_that_row_only(log, kept):
    before, *_ = read_csv(log)
    lines = (log / "imu.csv").read_text().splitlines()
    (log / "imu.csv").write_text("\n".join([*lines[:-1], kept]))
    with pytest.warns(RepairWarning, match="40 rows; 1 not finite, dropped"):
        after, *_ = read_csv(log)
    np.testing.assert_array_equal(after.specific_force, before.specific_force[:-1])


def test_lines_of_another_kind_cost_these_rows_only(log):
    before, *_ = read_csv(log)
    lines = (log / "imu.csv").read_bytes().splitlines()
    lines[5], lines[20], lines[30] = b"garbage", b"\xff\xfe\x00" + lines[20], lines[30][:25]
    lines[40] += b",7"
    (log / "imu.csv").write_bytes(b"\n".join(lines))
    with pytest.warns(RepairWarning, match="40 rows; 4 not finite, dropped"):
        after, *_ = read_csv(log)
    kept = np.delete(np.arange(40), [4, 19, 29, 39])
    np.testing.assert_array_equal(after.stamps, before.stamps[kept])
    np.testing.assert_array_equal(after.specific_force, before.specific_force[kept])


def test_rows_out_of_order_are_sorted_and_counted(log):
    before, *_ = read_csv(log)

    def swap(header, rows):
        rows[10], rows[11] = rows[11], rows[10]
        return header, rows

    changed(log / "imu.csv", swap)
    with pytest.warns(RepairWarning, match="1 out of order, sorted"):
        after, *_ = read_csv(log)
    np.testing.assert_array_equal(after.stamps, before.stamps)
    np.testing.assert_array_equal(after.specific_force, before.specific_force)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda h, r: (h.replace("stamp_s", "when"), r), r"no column stamp_s in when,ax.*expected numbers"),
        (lambda h, r: (h.replace("wz", "wy"), r), "column wy is missing or repeated"),
        (lambda h, r: (h.replace("ax", "ax [furlong]"), r), r"column 'ax \[furlong\]' is in a unit that is not known"),
        (lambda h, r: (h, [[*c[:3], "n/k", *c[4:]] for c in r]), "Row #2.*invalid value 'n/k'.*expected numbers"),
        (lambda h, r: (h, [["23 Nov, 15:26", *c[1:]] for c in r]), "Row #2.*a stamp is a number of seconds"),
        (lambda h, r: (h, [*r[:19], *(c[:4] for c in r[19:])]), "Row #21: Expected 7 columns, got 4"),
        (lambda h, r: (h, [*r[:9], ['"', *r[9][1:]], *r[10:]]), "Row #11: Expected 7 columns, got 1"),
        (lambda h, r: (h, []), "no rows"),
        (lambda h, r: ("", []), "empty"),
        (lambda h, r: (h, [[f"{float(c[0]) * 1e3}", *c[1:]] for c in r]), "are these milliseconds"),
        (lambda h, r: (h, [[f"{float(c[0]) * 1e9}", *c[1:]] for c in r]), "are these nanoseconds"),
        (lambda h, r: (h, r[:1]), "1 left, expected at least 2"),
    ],
)  # fmt: skip
def test_what_has_no_obvious_repair_is_refused_in_one_line(log, change, says):
    changed(log / "imu.csv", change)
    with pytest.raises(MeasurementError, match=says) as caught:
        read_csv(log)
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith((f"{log / 'imu.csv'}: ", "IMU: "))


def test_fixes_in_milliseconds_and_a_file_without_any_fix_are_refused(log):
    changed(log / "gnss.csv", lambda h, r: (h, [[f"{float(c[0]) * 1e3}", *c[1:]] for c in r]))
    with pytest.raises(MeasurementError, match=r"gnss\.csv: .*are these milliseconds"):
        read_csv(log)
    changed(log / "gnss.csv", lambda h, r: (h, [[*c[:4], "0", "0", "0"] for c in r[:2]]))
    with pytest.raises(MeasurementError, match=r"gnss\.csv: no usable fix among 2 rows"):
        read_csv(log)


def test_a_missing_file_is_named(log):
    (log / "gnss.csv").unlink()
    with pytest.raises(MeasurementError, match=r"gnss\.csv: cannot be read \(No such file or directory\)"):
        read_csv(log)


def test_wheel_speeds_are_read_exactly_or_repaired_with_a_count_or_refused(log):
    assert read_wheels(log) is None
    (log / "wheels.csv").write_text("gear,speed_mps,stamp_s\n1,2.5,0.1\n1,-3,0.3\n")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        wheels = read_wheels(log)
    np.testing.assert_array_equal(wheels.stamps, [0.1, 0.3])
    np.testing.assert_array_equal(wheels.speeds, [2.5, -3.0])
    (log / "wheels.csv").write_text("gear,speed_mps,stamp_s\n1,2.5,0.1\n1,nan,0.2\n1,-3,0.3\n")
    with pytest.warns(RepairWarning, match=r"wheels.csv: wheels: 3 rows; 1 not finite, dropped"):
        np.testing.assert_array_equal(read_wheels(log).speeds, [2.5, -3.0])
    (log / "wheels.csv").write_text("when,speed_mps\n0,1\n")
    with pytest.raises(MeasurementError, match=r"wheels.csv: found no column stamp_s"):
        read_wheels(log)
