"""Files of receivers that are tables in another dress, GPX and logs of NovAtel; and those that hold no positions."""

from __future__ import annotations

import re

from factor_graphs.tables import as_utf8

_OF_POSITIONS = "solution type lat lon msl separation datum sd_lat sd_lon sd_hgt"
LOGS = {
    "BESTPOSA": _OF_POSITIONS,
    "BESTGNSSPOSA": _OF_POSITIONS,
    "INSPVAXA": "status type lat lon msl separation vn ve vu roll pitch azimuth sd_lat sd_lon sd_hgt",
    "INSPVAA": "week2 sow2 lat lon alt",
}
"""Logs of NovAtel in ASCII, the best one first: what stands behind their semicolons (OEM7 Commands and Logs)."""
BEFORE = "log port sequence idle clock week sow receiver reserved version"
NO_SOLUTIONS = re.compile(
    rb"INSUFFICIENT_OBS|NO_CONVERGENCE|COV_TRACE|COLD_START|INS_INACTIVE|INS_ALIGNING|,NONE,"
)
POINT = re.compile(r"<(?:trkpt|wpt|rtept)\b([^>]*)>(.*?)</(?:trkpt|wpt|rtept)>", re.DOTALL)
HEAD_BYTES = 4096

_OBSERVATIONS = (
    "{} holds observations, not positions; solve them (RTKLIB: convbin, rnx2rtkp) and give the .pos"
)
_SENTENCES = "has none of the sentences GGA, GNS and RMC; let the receiver write GGA and RMC"
OTHERS = tuple(
    (re.compile(sign, re.DOTALL), why)
    for sign, why in {
        rb"\s*\d\.\d\d.{10,}RINEX VERSION": _OBSERVATIONS.format("RINEX"),
        rb"\xb5\x62": _OBSERVATIONS.format("this log of u-blox"),
        rb"\xd3[\x00-\x03]": _OBSERVATIONS.format("RTCM"),
        rb"\$@": _OBSERVATIONS.format("SBF"),
        rb"\xaa\x44[\x12\x13]": "is a binary log of NovAtel; write it as ASCII (BESTPOSA), or export positions",
        rb"PK\x03\x04|\x1f\x8b|BZh|7z\xbc\xaf|\x28\xb5\x2f\xfd": "is compressed; unpack it",
        rb"%=SNX": "is SINEX, which has no track; give RTKLIB, NMEA or a table",
        rb".*<kml": "is KML, which has no times; export GPX, NMEA or a table",
        rb"\$(?:POS|SAT|VELACC|CLK),": "is the .stat of RTKLIB; give the .pos beside it",
        rb"(?:[^\n]*\n)?\$(?:PUBX|PTNL|PASHR|G[A-Z](?:GLL|GSV|GSA|VTG))": _SENTENCES,
    }.items()
)
"""By how they begin: files that are often given in place of positions, and what to do."""


def no_positions(content: bytes) -> str:
    """What a file is that holds no positions, and what to do; empty where nothing is known of it."""
    head = content[:HEAD_BYTES]
    return next((why for sign, why in OTHERS if sign.match(head)), "")


def as_table(content: bytes) -> bytes:
    """GPX, or a log of NovAtel, as a table with named columns; other content as it is."""
    content = as_utf8(content)
    if b"<gpx" in content[:HEAD_BYTES]:
        text = content.decode("utf-8", "replace")
        return "\n".join(["time,lat,lon,msl", *map(_row_of_point, POINT.finditer(text))]).encode()
    for log, names in LOGS.items():
        rows = re.findall(rb"#(%b,[^\r\n*]*)" % log.encode(), content)
        if rows:
            kept = [row.replace(b";", b",") for row in rows if not NO_SOLUTIONS.search(row)]
            return b"\n".join([",".join(f"{BEFORE} {names}".split()).encode(), *kept])
    return content


def _row_of_point(found: re.Match[str]) -> str:
    """Time, latitude, longitude and height above the geoid of a point of a track; empty for what it lacks."""
    angles = [re.search(rf"\b{name}\s*=\s*[\"']([^\"']*)", found[1]) for name in ("lat", "lon")]
    inner = [re.search(rf"<{name}>([^<]*)<", found[2]) for name in ("time", "ele")]
    time, lat, lon, height = ("" if one is None else one[1].strip() for one in (inner[0], *angles, inner[1]))
    return f"{time},{lat},{lon},{height}"
