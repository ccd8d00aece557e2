"""Positions of RTKLIB, in each of its forms."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pyproj import Transformer
from receivers import (
    LEAP_NS,
    dms,
    moment,
    pos,
    pos_row,
    read,
)
from ros import START_NS
from surfaces import write_geoid

from factor_graphs.geodesy import LocalFrame
from factor_graphs.receiver_rows import fixes_of, velocities_of
from gnss_sem_map.datasets.gnss_files.time_systems import GPS_EPOCH_NS, WEEK_NS
from gnss_sem_map.errors import DataError


def test_a_pos_file_in_gps_time(tmp_path: Path) -> None:
    path = pos(tmp_path, [pos_row(START_NS + LEAP_NS + k * 200_000_000, lat=49 + k * 1e-6) for k in range(3)])
    found = read(path)
    np.testing.assert_allclose(found.rows[:, 0], [0.0, 0.2, 0.4], atol=1e-9)
    np.testing.assert_allclose(found.rows[1, 1:4], [49.000001, 8.4, 160.1234])
    assert found.skips == []


@pytest.mark.parametrize("name", ["rover.csv", "gnss.txt"])
def test_a_pos_file_between_commas_under_another_ending(tmp_path: Path, name: str) -> None:
    path = pos(tmp_path, [pos_row(START_NS + LEAP_NS + k * 10**9, lat=49 + k * 1e-6) for k in range(3)])
    text = "\n".join(",".join(line.split()) for line in path.read_text().splitlines())
    (tmp_path / name).write_text(text.replace("%,", "% "))
    np.testing.assert_array_equal(read(tmp_path / name).rows, read(path).rows)


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


BASE = (49.0, -8.4, 150.0)
COLUMNS = {
    "deg": "latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)  sdne(m)  sdeu(m)  sdun(m)",
    "dms": "latitude(d'\") longitude(d'\")  height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)  sdne(m)  sdeu(m)  sdun(m)",
    "ecef": "x-ecef(m)      y-ecef(m)      z-ecef(m)   Q  ns   sdx(m)   sdy(m)   sdz(m)  sdxy(m)  sdyz(m)  sdzx(m)",
    "enu": "e-baseline(m)  n-baseline(m)  u-baseline(m)   Q  ns   sde(m)   sdn(m)   sdu(m)  sden(m)  sdnu(m)  sdue(m)",
}  # fmt: skip
VELOCITIES = {"ecef": "vx(m/s)    vy(m/s)    vz(m/s)      sdvx     sdvy     sdvz    sdvxy    sdvyz    sdvzx"}
PLACES = BASE + np.array([[1e-4, 2e-4, 3.0], [3e-4, -0.4e-4, 5.5], [-49.5, 1e-4, 9.0]])
"""Ahead, aside, and half a degree south of the equator."""
C_ENU = np.array([[1.0, 0.3, -0.2], [0.3, 4.0, 0.5], [-0.2, 0.5, 9.0]])
V_ENU = np.array([3.0, -2.0, 0.5])


def ecef_axes(lat_deg: float, lon_deg: float) -> np.ndarray:
    """East, north and up of a place as geocentric columns, by differences of pyproj."""
    to = Transformer.from_crs(4979, 4978, always_xy=True)
    here, step = np.array(to.transform(lon_deg, lat_deg, 0.0)), 1e-6
    axes = np.column_stack([
        np.array(to.transform(lon_deg + step, lat_deg, 0.0)) - here,
        np.array(to.transform(lon_deg, lat_deg + step, 0.0)) - here,
        np.array(to.transform(lon_deg, lat_deg, 0.1)) - here,
    ])  # fmt: skip
    return np.asarray(axes / np.linalg.norm(axes, axis=0))


def solution(form: str, separator: str = " ", clock: str = "GPST") -> tuple[list[str], str]:
    """The same fixes in any form, with covariances and velocities, and their header."""
    rows = []
    for k, (lat, lon, alt) in enumerate(PLACES):
        axes, place = (
            np.array([[0, 1, 0], [1, 0, 0], [0, 0, 1.0]]),
            [f"{lat:.9f}", f"{lon:.9f}", f"{alt:.4f}"],
        )
        if form == "dms":
            place = [*dms(lat), *dms(lon), f"{alt:.4f}"]
        elif form == "ecef":
            axes = ecef_axes(lat, lon)
            place = [
                f"{v:.4f}" for v in Transformer.from_crs(4979, 4978, always_xy=True).transform(lon, lat, alt)
            ]
        elif form == "enu":
            axes, place = np.eye(3), [f"{v:.5f}" for v in LocalFrame(*BASE).to_map(lat, lon, alt)]
        C, v = axes @ C_ENU @ axes.T, axes @ V_ENU
        roots = [C[0, 1], C[1, 2], C[2, 0]]
        errors = [*np.sqrt(np.diag(C)), *(np.sign(c) * np.sqrt(abs(c)) for c in roots)]
        numbers = [f"{value:.6f}" for value in (*errors, 0.1, 1.5, *v, *errors)]
        time = moment(START_NS + LEAP_NS + k * 10**9).strftime("%Y/%m/%d %H:%M:%S.%f")[:-3]
        rows.append(separator.join([time, *place, "1", "9", *numbers]))
    names = [clock, *COLUMNS[form].split(), "age(s)", "ratio"]
    more = VELOCITIES.get(form, "vn(m/s) ve(m/s) vu(m/s) sdvn sdve sdvu sdvne sdveu sdvun")
    return rows, f"% ref pos   : {BASE[0]} {BASE[1]} {BASE[2]}\n%  " + separator.join([*names, *more.split()])


@pytest.mark.parametrize("form", COLUMNS)
@pytest.mark.parametrize("separator", [" ", ";", ",", "\t", " ; "])
@pytest.mark.parametrize("ending", [".pos", ".LLH", ".txt"])
def test_every_form_of_a_solution_says_the_same(
    tmp_path: Path, form: str, separator: str, ending: str
) -> None:
    path = pos(tmp_path, *solution(form, separator))
    found = read(path.rename(path.with_suffix(ending)))
    assert found.skips == []
    np.testing.assert_allclose(found.rows[:, 0], [0, 1, 2], atol=1e-9)
    np.testing.assert_allclose(found.rows[:, 1:3], PLACES[:, :2], atol=2e-9)
    np.testing.assert_allclose(found.rows[:, 3], PLACES[:, 2], atol=2e-3)
    sigma = np.sqrt(np.diag(C_ENU))
    np.testing.assert_allclose(found.rows[:, 4:7], np.tile(sigma, (3, 1)), rtol=1e-4)
    correlations = [C_ENU[i, j] / (sigma[i] * sigma[j]) for i, j in ((0, 1), (0, 2), (1, 2))]
    np.testing.assert_allclose(found.rows[:, 7:10], np.tile(correlations, (3, 1)), atol=1e-4)
    np.testing.assert_allclose(found.rows[:, 10:13], np.tile(V_ENU, (3, 1)), atol=1e-4)


@pytest.mark.parametrize("base", ["49.0  -8.4  150.0", "49 00 00.00000  -8 24 00.00000  150.0000", "ecef"])
def test_baselines_begin_at_the_base_in_any_form(tmp_path: Path, base: str) -> None:
    if base == "ecef":
        lat, lon, alt = BASE
        base = " ".join(
            f"{v:.4f}" for v in Transformer.from_crs(4979, 4978, always_xy=True).transform(lon, lat, alt)
        )
    rows, header = solution("enu")
    header = f"% ref pos   : {base}\n" + header.partition("\n")[2]
    np.testing.assert_allclose(read(pos(tmp_path, rows, header)).rows[:, 1:3], PLACES[:, :2], atol=2e-9)


def test_baselines_without_their_base_are_refused_with_the_option(tmp_path: Path) -> None:
    rows, header = solution("enu")
    with pytest.raises(DataError, match=r"no `ref pos` in its header.*out-solformat=llh"):
        read(pos(tmp_path, rows, header.partition("\n")[2]))


def test_a_solution_in_the_time_of_japan(tmp_path: Path) -> None:
    path = pos(
        tmp_path, [pos_row(START_NS + 9 * 3600 * 10**9)], "%  JST  latitude(deg) longitude(deg) height(m) Q"
    )
    assert read(path).rows[0, 0] == pytest.approx(0.0, abs=1e-6)


def test_a_solution_without_a_header_is_one_of_degrees_and_gps_time(tmp_path: Path) -> None:
    path = pos(tmp_path, [])
    path.write_text(pos_row(START_NS + LEAP_NS) + "\n")
    np.testing.assert_allclose(read(path).rows[0, :4], [0.0, 49.0, 8.4, 160.1234], atol=1e-6)


@pytest.mark.parametrize("geoid", [48.5, "grid.tif"])
def test_heights_above_the_geoid_need_it(tmp_path: Path, geoid: object) -> None:
    header = "% (lat/lon/height=WGS84/geodetic)\n%  GPST  latitude(deg) longitude(deg) height(m) Q"
    path = pos(tmp_path, [pos_row(START_NS + LEAP_NS)], header)
    with pytest.raises(DataError, match=r"heights are above the geoid.*set `geoid:`"):
        read(path)
    if geoid == "grid.tif":
        write_geoid(tmp_path / "grid.tif", 49.0, 8.4, 48.5)
    assert read(path, geoid=geoid).rows[0, 3] == pytest.approx(160.1234 + 48.5, abs=1e-3)


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
