"""Positions in exports of Inertial Explorer and POSPac, of CSRS-PPP, and in tables of one's own, by names."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from pyproj import Transformer
from receivers import DRIVE_NS, LEAP_NS, dms, moment, read
from ros import START_NS

from gnss_sem_map.datasets.gnss_files.time_systems import GPS_EPOCH_NS, WEEK_NS
from gnss_sem_map.errors import DataError

PLACES = np.array([[49.001, -8.4, 160.1], [49.002, -8.41, 160.2], [-0.5, -8.42, 160.3]])
STDDEVS = np.array([0.02, 0.01, 0.05])
NS = [START_NS + k * 10**9 for k in range(3)]
WEEK = (START_NS + LEAP_NS - GPS_EPOCH_NS) // WEEK_NS
SOW = [(ns + LEAP_NS - GPS_EPOCH_NS) % WEEK_NS / 1e9 for ns in NS]
Row = Callable[[int], str]


def e_n_u(form: str = ".3f") -> str:
    return "  ".join(f"{v:{form}}" for v in STDDEVS[[1, 0, 2]])


def degrees_minutes_seconds(k: int) -> str:
    return "   ".join(" ".join(dms(v)) for v in PLACES[k, :2])


EXPLORER = """Project:     loop
Program:     Inertial Explorer Version 8.90
Source:      GNSS Epochs(Combined)
Datum:       WGS84
Remote:      Antenna height 0.000 m

"""
APPLANIX = """*****************************************
 POS Export Utility
 POSPROC SBET file: sbet_1.out
 Target Datum: WGS84, output interval 1.0 s
*****************************************

"""
NAMES_OF_POSPAC = (
    "TIME, DISTANCE, EASTING, NORTHING, ELLIPSOID HEIGHT, LATITUDE, LONGITUDE, ROLL, PITCH, HEADING, EAST SD, NORTH SD,"
    " HEIGHT SD"
)
UNITS_OF_POSPAC = (
    "(time in Sec, distance in Meters, lat, long in Degrees, orientation angles and SD in Degrees)"
)
NAMES_OF_CSRS = (
    "DIR FRAME  STN   DAYofYEAR YEAR-MM-DD HR:MN:SS.SS NSV GDOP  RMSC(m)  RMSP(m) DLAT(m) DLON(m) DHGT(m) CLK(ns)"
    " TZD(m) SDLAT(95%) SDLON(95%) SDHGT(95%) SDCLK(95%) SDTZD(95%) LATDD LATMN  LATSS LONDD LONMN  LONSS  HGT(m)"
    " UTMZONE"
)


def explorer(names: str, units: str, row: Row, before: str = EXPLORER) -> str:
    """Right-aligned, names and units above their columns."""
    wide = [f"{name:>16}" for name in names.split("|")], [f"{unit:>16}" for unit in units.split("|")]
    rows = "".join(f" {row(k)}\n" for k in range(3))
    return before + "".join("".join(line) + "\n" for line in wide) + rows


def csrs(k: int) -> str:
    time = moment(NS[k] + LEAP_NS).strftime("%Y-%m-%d %H:%M:%S.%f")[:-4]
    sd = " ".join(f"{1.96 * v:.5f}" for v in STDDEVS[[1, 0, 2]])
    places = " ".join(" ".join(dms(v)) for v in PLACES[k, :2])
    return (
        f"FWD ITRF14 site 150.0000000 {time} 9 1.9 0.62 0.0045 0.1 0.2 0.3 -1.2 2.4 {sd} 0.1 0.01 {places}"
        f" {PLACES[k, 2]:.4f} 32"
    )


def table(header: str, row: Callable[[int], list[object]], by: str = ",") -> str:
    return header + "\n" + "".join(by.join(map(str, row(k))) + "\n" for k in range(3))


FILES: dict[str, str] = {
    "Inertial Explorer, degrees": explorer(
        "Week|GPSTime|Latitude|Longitude|H-Ell|SDNorth|SDEast|SDHeight|Q",
        "(weeks)|(sec)|(+/-deg)|(+/-deg)|(m)|(m)|(m)|(m)|",
        lambda k: f"{WEEK} {SOW[k]:.2f} {PLACES[k, 0]:.10f} {PLACES[k, 1]:.10f} {PLACES[k, 2]:.3f} {e_n_u()} 1",
    ),
    "Inertial Explorer, degrees and minutes": explorer(
        "UTCTime|Week|GPSTime|Latitude|Longitude|H-Ell|SDNorth|SDEast|SDHeight|Q",
        "(sec)|(weeks)|(sec)|(+/-D M S)|(+/-D M S)|(m)|(m)|(m)|(m)|",
        lambda k: f"{NS[k] / 1e9:.2f} {WEEK}.00000 {SOW[k]:.2f} {degrees_minutes_seconds(k)} {PLACES[k, 2]:.3f}"
        f" {e_n_u()} 1",
    ),
    "Inertial Explorer, feet, two heights, dates": explorer(
        "CorrTime|Date|Latitude|Longitude|H-MSL|H-Ell|SDNorth|SDEast|SDHeight",
        "(sec)|(MDY)|(+/-D M S)|(+/-D M S)|(ft)|(ft)|(ft)|(ft)|(ft)",
        lambda k: f"{SOW[k]:.2f} {moment(NS[k] + LEAP_NS).strftime('%m/%d/%Y')} {degrees_minutes_seconds(k)} 400"
        f" {PLACES[k, 2] / 0.3048:.5f} " + " ".join(f"{v / 0.3048:.6f}" for v in STDDEVS[[1, 0, 2]]),
    ),
    "Inertial Explorer, time of day in UTC, no date": explorer(
        "UTCTime|Latitude|Longitude|H-Ell|SDNorth|SDEast|SDHeight",
        "(HMS)|(+/-deg)|(+/-deg)|(m)|(m)|(m)|(m)",
        lambda k: f"{moment(NS[k]):%H:%M:%S.00} {PLACES[k, 0]:.10f} {PLACES[k, 1]:.10f} {PLACES[k, 2]:.3f} {e_n_u()}",
    ),
    "POSPac": APPLANIX + NAMES_OF_POSPAC + "\n" + UNITS_OF_POSPAC + "\n\n" + "".join(
        f"  {SOW[k]:.3f} 0.1 456789.1 5421234.2 {PLACES[k, 2]:.3f} {PLACES[k, 0]:.10f} {PLACES[k, 1]:.10f} 0 0 90"
        f" {STDDEVS[0]} {STDDEVS[1]} {STDDEVS[2]}\n" for k in range(3)
    ),
    "POSPac, degrees and minutes": APPLANIX + NAMES_OF_POSPAC + "\n" + "".join(
        f"  {SOW[k]:.3f} 0.1 456789.1 5421234.2 {PLACES[k, 2]:.3f} {degrees_minutes_seconds(k)} 0 0 90"
        f" {STDDEVS[0]} {STDDEVS[1]} {STDDEVS[2]}\n" for k in range(3)
    ),
    "CSRS-PPP": "HDR GRP CANADIAN GEODETIC SURVEY\nHDR EML nrcan@example\n" + NAMES_OF_CSRS + "\n" + "".join(
        csrs(k) + "\n" for k in range(3)
    ),
    "a CSV with ISO times and semicolons": table(
        "Time;Latitude;Longitude;Altitude;sdE;sdN;sdU",
        lambda k: [f"{moment(NS[k]).isoformat()}", *(str(v).replace(".", ",") for v in (*PLACES[k], *STDDEVS))], ";",
    ),
    "a CSV with date and time apart": table(
        "Date,Time,Lat,Lon,Alt,std_e,std_n,std_u",
        lambda k: [moment(NS[k]).strftime("%d.%m.%Y"), f"{moment(NS[k]):%H:%M:%S}", *PLACES[k], *STDDEVS],
    ),
    "a CSV with angles in words": table(
        "timestamp,latitude,longitude,height,std_e,std_n,std_u",
        lambda k: [NS[k] // 10**6, *(
            f"{abs(v):.9f}{'NS'[int(v < 0)] if i == 0 else 'EW'[int(v < 0)]}" for i, v in enumerate(PLACES[k, :2])
        ), PLACES[k, 2], *STDDEVS],
    ),
    "a CSV with hemispheres in columns of their own": table(
        "time,lat,N/S,lon,E/W,height,std_e,std_n,std_u",
        lambda k: [NS[k] / 1e9, abs(PLACES[k, 0]), "NS"[int(PLACES[k, 0] < 0)], abs(PLACES[k, 1]), "W", PLACES[k, 2],
                   *STDDEVS],
    ),
    "BESTPOSA of NovAtel": "[COM1]\n" + "".join(
        f"#BESTPOSA,COM1,0,90.5,FINESTEERING,{WEEK},{SOW[k]:.3f},02000040,cdba,32768;SOL_COMPUTED,NARROW_INT,"
        f"{PLACES[k, 0]:.11f},{PLACES[k, 1]:.11f},{PLACES[k, 2] - 48:.4f},48.0,WGS84,{STDDEVS[1]},{STDDEVS[0]},"
        f'{STDDEVS[2]},"0",1.0,0.0,12,12,12,12,0,06,00,00*1a2b3c4d\n' for k in range(3)
    ) + "#BESTPOSA,COM1,0,90.5,FINESTEERING,1,1.0,0,0,1;INSUFFICIENT_OBS,NONE,0,0,0,0,WGS84,0,0,0*0\n",
    "INSPVAXA of NovAtel": "".join(
        f"#INSPVAXA,COM1,0,90.5,FINESTEERING,{WEEK},{SOW[k]:.3f},02000040,cdba,32768;INS_SOLUTION_GOOD,INS_PSRSP,"
        f"{PLACES[k, 0]:.11f},{PLACES[k, 1]:.11f},{PLACES[k, 2] - 48:.4f},48.0,1,0,0,0.1,0.2,90,{STDDEVS[1]},"
        f"{STDDEVS[0]},{STDDEVS[2]},0.1,0.1,0.1,0.1,0.1,0.1,3,0*1a2b3c4d\n" for k in range(3)
    ),
    "u-center": table(
        "UTC,Lat,Lon,Alt (MSL),Alt (HAE),sd_east,sd_north,vAcc",
        lambda k: [f"{moment(NS[k]):%Y-%m-%d %H:%M:%S.000}", *PLACES[k, :2], 112.1, PLACES[k, 2], *STDDEVS],
    ),
    "a CSV of geocentric positions": table(
        "week,tow,X-ECEF,Y-ECEF,Z-ECEF,std_e,std_n,std_u",
        lambda k: [WEEK, SOW[k], *Transformer.from_crs(4979, 4978, always_xy=True).transform(
            PLACES[k, 1], PLACES[k, 0], PLACES[k, 2]
        ), *STDDEVS],
    ),
    "a CSV with the height of the geoid": table(
        "unix_time,lat,lon,orthometric_height,undulation,std_e,std_n,std_u",
        lambda k: [NS[k] / 1e9, *PLACES[k, :2], PLACES[k, 2] - 48.5, 48.5, *STDDEVS],
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize(("ending", "encoding"), [(".txt", "utf-8"), (".pos", "utf-8"), (".csv", "utf-16")])
def test_a_table_of_positions_by_its_names(tmp_path: Path, name: str, ending: str, encoding: str) -> None:
    path = tmp_path / f"export{ending}"
    path.write_bytes(FILES[name].encode(encoding))
    found = read(path)
    assert found.skips == []
    np.testing.assert_allclose(found.rows[:, 0], [0, 1, 2], atol=1e-6)
    np.testing.assert_allclose(found.rows[:, 1:3], PLACES[:, :2], atol=2e-9)
    np.testing.assert_allclose(found.rows[:, 3], PLACES[:, 2], atol=1e-4)
    np.testing.assert_allclose(found.rows[:, 4:7], np.tile(STDDEVS, (3, 1)), atol=1e-5)


def test_a_table_without_deviations_or_above_a_geoid_says_the_setting(tmp_path: Path) -> None:
    path = tmp_path / "export.txt"
    path.write_text(table("week,gpstime,lat,lon,H-MSL", lambda k: [WEEK, SOW[k], *PLACES[k]]))
    with pytest.raises(DataError, match=r"tells no accuracy; set `stddevs_m: \[east, north, up\]`"):
        read(path)
    with pytest.raises(DataError, match=r"heights are above the geoid.*set `geoid:`"):
        read(path, stddevs_m=(0.1, 0.1, 0.2))
    found = read(path, stddevs_m=(0.1, 0.1, 0.2), geoid=48.5)
    np.testing.assert_allclose(found.rows[:, 3], PLACES[:, 2] + 48.5)


@pytest.mark.parametrize(
    "inner", ["<ele>{:.4f}</ele><time>{}</time>", "<time>{1}</time>\n<ele>{0:.4f}</ele>"]
)
def test_tracks_of_gpx_need_what_they_do_not_tell(tmp_path: Path, inner: str) -> None:
    path = tmp_path / "track.gpx"
    points = "".join(
        f'<trkpt lat="{p[0]}" lon="{p[1]}">{inner.format(p[2] - 48.5, f"{moment(ns):%Y-%m-%dT%H:%M:%SZ}")}</trkpt>\n'
        for ns, p in zip(NS, PLACES, strict=True)
    )
    path.write_text(f'<?xml version="1.0"?>\n<gpx version="1.1"><trk><trkseg>{points}</trkseg></trk></gpx>')
    with pytest.raises(DataError, match="stddevs_m"):
        read(path)
    found = read(path, stddevs_m=(1, 1, 2), geoid=48.5)
    np.testing.assert_allclose(found.rows[:, :4], np.column_stack([[0, 1, 2], PLACES]), atol=1e-6)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"     3.04           OBSERVATION DATA    M (MIXED)           RINEX VERSION / TYPE\n", "rnx2rtkp"),
        (b"\xb5\x62\x02\x15\x10\x00" + bytes(40), "rnx2rtkp"),
        (b"\xd3\x00\x13" + bytes(40), "rnx2rtkp"),
        (b"PK\3\4" + bytes(40), "unpack it"),
        (b"$PUBX,00,202640.00,4900.06,N,00824.0,E,160.1,G3*6F\n", "write GGA"),
    ],
)
def test_what_holds_no_positions_is_named_with_the_way_to_them(
    tmp_path: Path, content: bytes, said: str
) -> None:
    path = tmp_path / "rover.bin"
    path.write_bytes(content)
    with pytest.raises(DataError, match=said):
        read(path)


def test_without_heights_the_trajectory_is_flat_and_that_is_said(tmp_path: Path) -> None:
    path = tmp_path / "export.csv"
    path.write_text(table("time,lat,lon,hAcc", lambda k: [NS[k] / 1e9, *PLACES[k, :2], 0.5]))
    found = read(path)
    np.testing.assert_array_equal(found.rows[:, 3:7], np.tile([0, 0.5, 0.5, 100.0], (3, 1)))
    assert [skip.what for skip in found.skips] == ["height"]


def test_many_rows_are_thinned_and_those_without_a_place_counted(tmp_path: Path) -> None:
    path = tmp_path / "export.csv"
    rows = [
        f"{START_NS / 1e9 + 0.005 * k:.3f},49.0,8.4,{'' if k == 20 else 160.0},0.1,0.1,0.1"
        for k in range(400)
    ]
    path.write_text("time,lat,lon,alt,std_e,std_n,std_u\n" + "\n".join(rows) + "\n")
    found = read(path)
    assert len(found.rows) == 19
    assert [skip.reason for skip in found.skips] == ["1 rows without a time or a place"]


def test_times_of_a_week_over_its_end(tmp_path: Path) -> None:
    end_ns = GPS_EPOCH_NS + (WEEK + 1) * WEEK_NS - LEAP_NS
    path = tmp_path / "export.csv"
    seconds = [604799.0, 0.0, 1.0]
    path.write_text(table("gpstime,lat,lon,alt", lambda k: [seconds[k], 49.0, 8.4, 160.0]))
    found = read(path, (end_ns - 10**9, end_ns + 10**9), stddevs_m=(1, 1, 1))
    assert found.stamps_ns.tolist() == [end_ns - 10**9, end_ns, end_ns + 10**9]
    with pytest.raises(DataError, match=r"tells neither date nor week.*add a column Week"):
        read(path, None, stddevs_m=(1, 1, 1))


@pytest.mark.parametrize("text", ["", "nothing here\n", "time,lat\n1,2\n", "time,lat,lon,alt\n"])
def test_what_is_no_table_of_positions_is_refused_with_what_is(tmp_path: Path, text: str) -> None:
    path = tmp_path / "export.txt"
    path.write_text(text)
    with pytest.raises(
        DataError, match="expected RTKLIB, NMEA, or columns of time, latitude, longitude and height"
    ):
        read(path, DRIVE_NS, stddevs_m=(1, 1, 1))
