"""Files of receivers as their makers write them, for tests of what reads them."""

from __future__ import annotations

import datetime
from pathlib import Path

import numpy as np
from pynmeagps import GET, NMEAMessage
from ros import START_NS

from gnss_sem_map.datasets.gnss_files import FileFixes, GnssFile, read_gnss_file
from gnss_sem_map.datasets.gnss_files.time_systems import GPS_EPOCH_NS, WEEK_NS

LEAP_NS = 18 * 10**9
DRIVE_NS = (START_NS, START_NS + 60 * 10**9)


def read(path: Path, drive_ns: tuple[int, int] | None = DRIVE_NS, **about: object) -> FileFixes:
    about_it = GnssFile.model_validate({"path": path.name, **about})
    return read_gnss_file(about_it, path.parent, START_NS, drive_ns)


def moment(ns: int) -> datetime.datetime:
    return datetime.datetime.fromtimestamp(ns // 10**9, datetime.UTC).replace(microsecond=ns % 10**9 // 1000)


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


def gst(ns: int) -> str:
    return NMEAMessage(
        "GN", "GST", GET, time=moment(ns).time(), rangeRms=1.0, stdLat=0.11, stdLong=0.12, stdAlt=0.2
    ).serialize().decode()  # fmt: skip


def nmea(folder: Path, *sentences: str) -> Path:
    (folder / "rover.nmea").write_text("".join(sentences))
    return folder / "rover.nmea"


def sbet(folder: Path, seconds: np.ndarray, name: str = "out.sbet") -> Path:
    rows = np.zeros((len(seconds), 17))
    rows[:, 0], rows[:, 1], rows[:, 2], rows[:, 3] = seconds, np.radians(49.0), np.radians(8.4), 160.0
    rows.astype("<f8").tofile(folder / name)
    return folder / name


def week_seconds(ns: int) -> float:
    return (ns - GPS_EPOCH_NS) % WEEK_NS / 1e9


def dms(degrees: float) -> list[str]:
    """As RTKLIB's deg2dms, which has the sign with the degrees, and prints -0."""
    size = abs(degrees)
    minutes = (size - int(size)) * 60
    sign = "-" if degrees < 0 else ""
    return [f"{sign}{int(size)}", f"{int(minutes):02d}", f"{(minutes - int(minutes)) * 60:010.7f}"]
