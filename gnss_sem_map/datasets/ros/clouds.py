"""PointCloud2 and Livox's CustomMsg as sweeps, with the time of every point as the drivers of LiDARs write it.

| field | drivers | meaning |
|---|---|---|
| `time`, float | Velodyne | s after the stamp of the message |
| `t`, uint32 | Ouster | ns after the stamp |
| `offset_time`, uint32 | Livox | ns after the stamp |
| `timestamp`, float64 | Hesai, RoboSense: s; Livox: ns | Unix time |
| `time_stamp`, `time_offset`, `time_offset_ns`, uint32 | Nebula, Aeva | ns after the stamp |

Other fields, and their unit, may be named in rig.yaml. Else the size of the numbers tells Unix times, or those of the
clock of the stamps, and their unit, and the time from one sweep to the next the unit of others; where neither does,
whole numbers are ns, others s. A cloud without any such field, or with the same time in all points, is refused, unless
rig.yaml says that its points are compensated already.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.datasets.frames import MOST_POINTS, refuse_other_bytes, scale_intensity
from gnss_sem_map.datasets.ros.bag import Bag, Messages
from gnss_sem_map.datasets.ros.kinds import LIVOX, decode
from gnss_sem_map.datasets.ros.stamps import header_ns
from gnss_sem_map.datasets.stamps import LONGEST_SWEEP_S, are_returns, leave_out_of_sweep
from gnss_sem_map.errors import DataError
from gnss_sem_map.files.untrusted import refused
from gnss_sem_map.sensor_log import Points

Array = NDArray[np.float64]

TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""numpy's names of PointField's datatypes."""
TIME_FIELDS = (
    "time", "t", "offset_time", "timestamp", "time_stamp", "time_offset", "time_offset_ns", "timestamps", "ts", "stamp",
    "time_us", "time_ns", "t_us", "t_ns", "timestamp_us", "timestamp_ns", "offset_ns", "dt", "point_time", "rel_time",
)  # fmt: skip
"""Those that are known, in this order."""
INTENSITY_FIELDS = ("intensity", "reflectivity")
COMPENSATED = "compensated"
Unit = Literal["s", "ms", "us", "ns"]
UNITS: dict[Unit, int] = {"s": 1_000_000_000, "ms": 1_000_000, "us": 1000, "ns": 1}
"""Units of times, ns."""
UNIX_S = (1e9, 1e10)
"""Unix times of 2001 to 2286, which times after a stamp are not in any unit: sweeps take less than 1e9 ns."""
SWEEP = (0.1, 2.0)
"""A sweep takes so much of the time to the next one: whole circles, or a part of them, or two returns."""
USUAL_SWEEP_S = 0.1
LOOKED_AT = 5
"""Clouds of a topic that tell the unit of all."""


@dataclass(frozen=True)
class PointTimes:
    """Where a cloud tells the times of its points, and how."""

    field: str | None
    """None: none of them; the points are compensated."""
    unit: Unit = "s"
    is_absolute: bool = False
    """Of Unix time, or of the clock of the stamps."""


def fields_of(cloud: Any) -> list[str]:
    """Names of the fields of a cloud."""
    if hasattr(cloud, "points"):
        return list(LIVOX_POINT)
    return [str(field.name) for field in cloud.fields]


def time_field(names: list[str], said: str | None) -> str | None:
    """The field that holds the times of points: the one that is said, else a known one; None if there is none."""
    if said is not None:
        return said if said in names else None
    return next((name for name in TIME_FIELDS if name in names), None)


def no_times(where: str, names: list[str]) -> DataError:
    """The error that a cloud does not tell when its points were measured."""
    return refused(
        where,
        f"found fields {', '.join(names)[:200]}, and none with the time of each point; expected one of"
        f" {', '.join(TIME_FIELDS)}; in rig.yaml, `point_times:` is its name, or `{COMPENSATED}` if there is no motion"
        " in the clouds any more",
    )


def times_of(
    bag: Bag, messages: Messages, said: str | None, unit: Unit | None, interval_s: float | None
) -> tuple[PointTimes, bool]:
    """How the clouds of a topic tell the times of their points, and whether a unit that is not usual was found.

    `said` is the name of the field or COMPENSATED, `unit` its unit, by rig.yaml; `interval_s` between two clouds. The
    first clouds tell what these do not. Raises DataError where there is no such field.
    """
    if said == COMPENSATED or len(messages) == 0:
        return PointTimes(None), False
    names = fields_of(decode(bag, messages, 0))
    field = time_field(names, said)
    if field is None:
        raise no_times(messages.topic, names)
    told = np.array(list(_middles_and_spans(bag, messages, field))).reshape(-1, 4)
    middle, span, is_whole, _ = np.median(told, axis=0) if len(told) else np.zeros(4)
    if len(told) and not told[:, 1].any():
        raise refused(
            messages.topic,
            f"the field {field!r} is {middle:.9g} in all points of a cloud, expected the time of each"
            f" point; in rig.yaml, `point_times:` names another field, or is `{COMPENSATED}` if there is no motion in"
            " the clouds any more",
        )
    for one in UNITS if unit is None else (unit,):
        after = told[:, 0] * UNITS[one] * 1e-9 - told[:, 3]
        is_of_stamps = (
            np.median(np.abs(after)) < LONGEST_SWEEP_S < middle * UNITS[one] * 1e-9 if len(told) else False
        )
        if is_of_stamps or UNIX_S[0] < middle * UNITS[one] * 1e-9 < UNIX_S[1]:
            return PointTimes(field, one, True), False
    if unit is not None:
        return PointTimes(field, unit), False
    usual: Unit = "ns" if is_whole else "s"
    sweep_s = interval_s or USUAL_SWEEP_S
    fits = [one for one in UNITS if SWEEP[0] <= span * UNITS[one] * 1e-9 / sweep_s <= SWEEP[1]]
    found = fits[0] if fits else usual  # one at most: units differ more than what a sweep may take
    return PointTimes(field, found), found != usual


def _middles_and_spans(
    bag: Bag, messages: Messages, field: str
) -> Iterator[tuple[float, float, bool, float]]:
    """Of the times of the returns of some clouds, whether they are whole numbers, and the stamp of the cloud, s.

    Nothing of clouds with less than two.
    """
    for k in messages.some(LOOKED_AT):
        try:
            table = _table(bag, messages, k, (field,))
        except DataError:  # told where the cloud is read
            continue
        times = table[field][are_returns(_rows(table))].astype(np.float64)
        times = times[np.isfinite(times)]
        if len(times) > 1:
            stamp = header_ns(bag, messages, k) * 1e-9
            yield float(np.median(times)), float(np.ptp(times)), table.dtype[field].kind in "iu", stamp


def read_cloud(
    _file: Path,
    bag: Bag,
    messages: Messages,
    k: int,
    stamp: float,
    stamp_ns: int,
    times: PointTimes,
    intensity_max: float | None = None,
) -> Points:
    """A sweep, in a file of the bag.

    `intensity_max` is the number for an intensity of 1; None: 1, and of an unsigned field its largest number.
    `stamp` s of the log, `stamp_ns` the same as Unix ns. Raises DataError for a damaged cloud, and PointTimesError for
    times that are not of one sweep.
    """
    where = f"{messages.topic}: message {k}"
    table = _table(bag, messages, k, () if times.field is None else (times.field,))
    rows = _rows(table)
    scale_intensity(rows, intensity_max or _largest_intensity(table))
    refuse_other_bytes(rows, where)
    if times.field is None:
        return Points(rows[:, :3], rows[:, 3], None)
    after = _after(np.asarray(table[times.field]), times, stamp_ns)
    leave_out_of_sweep(rows, after, where)
    after += stamp
    return Points(rows[:, :3], rows[:, 3], after)


def _table(bag: Bag, messages: Messages, k: int, more: tuple[str, ...]) -> NDArray[Any]:
    """The points (n,) as records of the fields that are used, and of `more`, in the memory of the message."""
    where = f"{messages.topic}: message {k}"
    if messages.kind in LIVOX:
        return _livox_table(bag.read(messages, k), messages.is_ros1, where)
    cloud = decode(bag, messages, k)
    n, step = int(cloud.width) * int(cloud.height), int(cloud.point_step)
    wanted = {"x", "y", "z", *INTENSITY_FIELDS, *more}
    fields = [field for field in cloud.fields if field.name in wanted]
    names, offsets = [str(field.name) for field in fields], [int(field.offset) for field in fields]
    formats = [TYPES.get(int(field.datatype)) for field in fields]
    if not {"x", "y", "z", *more} <= set(names) or len(set(names)) < len(names) or None in formats:
        raise refused(
            where,
            f"found fields {', '.join(fields_of(cloud))[:200]}, expected each of {', '.join(('x', 'y', 'z', *more))}",
        )
    order = ">" if cloud.is_bigendian else "<"
    kinds = [np.dtype(f"{order}{kind}") for kind in formats]
    if any(offset + kind.itemsize > step for offset, kind in zip(offsets, kinds, strict=True)):
        raise refused(where, f"a field lies outside of the {step} bytes of a point")
    height, row, row_step = int(cloud.height), int(cloud.width) * step, int(cloud.row_step)
    data = np.asarray(cloud.data, np.uint8)
    # of one row, and of rows without gaps, some drivers write any row_step
    has_gaps = height > 1 and row_step > row and data.size != n * step
    if not 0 < n <= MOST_POINTS or data.size < (row_step * (height - 1) + row if has_gaps else n * step):
        raise refused(
            where,
            f"found {n} points of {step} bytes in {data.size} bytes (row_step {row_step}), expected 1 to"
            f" {MOST_POINTS}",
        )
    if has_gaps:
        data = np.ndarray((height, row), np.uint8, np.ascontiguousarray(data), 0, (row_step, 1)).ravel()
    dtype = np.dtype({"names": names, "formats": kinds, "offsets": offsets, "itemsize": step})
    return np.frombuffer(data, dtype, n)


LIVOX_POINT = {
    "offset_time": "u4", "x": "f4", "y": "f4", "z": "f4", "reflectivity": "u1", "tag": "u1", "line": "u1",
}  # fmt: skip
LIVOX_HEAD = "QIB3xI"
"""Time of the first point, number of points, LiDAR, reserved bytes, and the number of points again."""


def _livox_table(data: bytes, is_ros1: bool, where: str) -> NDArray[Any]:
    """The points (n,) of a CustomMsg: ROS 1 packs them, in CDR each begins at a multiple of four bytes."""
    order, n, start = "<" if is_ros1 or data[1:2] == b"\1" else ">", 0, 16
    dtype = np.dtype([(name, order + kind) for name, kind in LIVOX_POINT.items()])
    step = dtype.itemsize if is_ros1 else dtype.itemsize + 1
    with suppress(struct.error):
        start += struct.unpack_from(f"{order}I", data, start - 4)[0]  # behind the name of the frame
        start = start if is_ros1 else 4 + (start - 4 + 7) // 8 * 8
        *_, n = struct.unpack_from(order + LIVOX_HEAD, data, start)
        start += struct.calcsize(order + LIVOX_HEAD)
    if not 0 < n <= MOST_POINTS or len(data) < start + (n - 1) * step + dtype.itemsize:
        raise refused(where, f"found {n} points in {len(data)} bytes, expected 1 to {MOST_POINTS} points")
    return np.ndarray(n, dtype, data, start, step)


def _rows(table: NDArray[Any]) -> NDArray[np.float32]:
    """x, y, z in m and the intensity as the driver writes it (n, 4), together in memory."""
    wanted = ("x", "y", "z", "intensity")
    fields: dict[str, Any] = dict(table.dtype.fields or {})
    first = int(fields["x"][1])
    if all(fields.get(name, ())[:2] == (np.dtype("<f4"), first + 4 * i) for i, name in enumerate(wanted)):
        four = np.dtype(
            {"names": ["xyzi"], "formats": ["V16"], "offsets": [first], "itemsize": table.dtype.itemsize}
        )
        return table.view(four)["xyzi"].copy().view("<f4").reshape(-1, 4)  # 16 bytes at a time
    rows = np.zeros((len(table), 4), np.float32)
    for column, name in enumerate(wanted[:3]):
        rows[:, column] = table[name]
    found = _intensity_field(table)
    if found is not None:
        rows[:, 3] = table[found]
    return rows


def _intensity_field(table: NDArray[Any]) -> str | None:
    return next((name for name in INTENSITY_FIELDS if name in (table.dtype.names or ())), None)


def _largest_intensity(table: NDArray[Any]) -> float:
    """The number for an intensity of 1, by the type of the field: drivers that write floats differ."""
    found = _intensity_field(table)
    kind = None if found is None else table.dtype[found]
    return float(np.iinfo(kind).max) if kind is not None and kind.kind == "u" else 1.0


def _after(times: NDArray[Any], how: PointTimes, stamp: int) -> Array:
    """The times of the points, s after the stamp, Unix ns, of their message."""
    unit = UNITS[how.unit]
    if how.is_absolute and times.dtype.kind in "iu":  # the difference of floats would be coarse
        return np.asarray((times.astype(np.int64) - stamp // unit) * (unit * 1e-9), np.float64)
    after = times.astype(np.float64)
    if how.is_absolute:
        after -= stamp / unit
    return np.asarray(after * (unit * 1e-9), np.float64)
