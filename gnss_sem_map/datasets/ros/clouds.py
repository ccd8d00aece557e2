"""PointCloud2 messages as sweeps, with the time of every point as the drivers of LiDARs write it.

| field | drivers | meaning |
|---|---|---|
| `time`, float | Velodyne | s after the stamp of the message |
| `t`, uint32 | Ouster | ns after the stamp |
| `offset_time`, uint32 | Livox | ns after the stamp |
| `timestamp`, float64 | Hesai, RoboSense: s; Livox: ns | Unix time |

Other fields may be named in rig.yaml. Relative and absolute times, and their unit, are told apart by the type of the
field and by the size of the numbers; a cloud without any such field is refused, unless rig.yaml says that its points
are compensated already.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.datasets.frames import MOST_POINTS, refuse_other_bytes, scale_intensity
from gnss_sem_map.datasets.point_times import are_returns, leave_out_of_sweep
from gnss_sem_map.datasets.ros.bag import Bag, Messages
from gnss_sem_map.datasets.ros.decoding import decode
from gnss_sem_map.errors import DataError
from gnss_sem_map.sensor_log import Points

Array = NDArray[np.float64]

KIND = "sensor_msgs/msg/PointCloud2"
TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""numpy's names of PointField's datatypes."""
TIME_FIELDS = ("time", "t", "offset_time", "timestamp")
"""Those that are known, in this order."""
INTENSITY_FIELDS = ("intensity", "reflectivity")
COMPENSATED = "compensated"
ABSOLUTE_S, ABSOLUTE_NS = 1e8, 1e17
"""Larger times are Unix times, in s and in ns: sweeps take at most 1e9 ns, and 1973 is not in any bag."""
EVERY = 64
"""Points between those whose times tell the kind of all."""


def fields_of(cloud: Any) -> list[str]:
    """Names of the fields of a cloud."""
    return [str(field.name) for field in cloud.fields]


def time_field(names: list[str], said: str | None) -> str | None:
    """The field that holds the times of points: the one that is said, else a known one; None if there is none."""
    if said is not None:
        return said if said in names else None
    return next((name for name in TIME_FIELDS if name in names), None)


def no_times(where: str, names: list[str]) -> DataError:
    """The error that a cloud does not tell when its points were measured."""
    return DataError(
        f"{where}: found fields {', '.join(names)[:200]}, and none with the time of each point; expected one of"
        f" {', '.join(TIME_FIELDS)}; in rig.yaml, `point_times:` is its name, or `{COMPENSATED}` if there is no motion"
        " in the clouds any more"
    )


def read_cloud(
    bag: Bag,
    messages: Messages,
    k: int,
    stamp: float,
    stamp_ns: int,
    times: str | None,
    intensity_max: float | None = None,
) -> Points:
    """A sweep; `times` is the field of the points' times, COMPENSATED, or None for a known field.

    `intensity_max` is the number for an intensity of 1; None: 1, and of an unsigned field its largest number.
    `stamp` s of the log, `stamp_ns` the same as Unix ns. Raises DataError for a damaged cloud, and PointTimesError for
    times that are not of one sweep.
    """
    cloud, where = decode(bag, messages, k), f"{messages.topic}: message {k}"
    table = _table(cloud, where)
    rows = _rows(table)
    scale_intensity(rows, intensity_max or _largest_intensity(table))
    refuse_other_bytes(rows, where)
    if times == COMPENSATED:
        return Points(rows[:, :3], rows[:, 3], None)
    field = time_field(list(table.dtype.names or ()), times)
    if field is None:
        raise no_times(where, list(table.dtype.names or ()))
    of_points = np.asarray(table[field])
    after = _after(of_points, of_points[are_returns(rows)], stamp_ns)
    leave_out_of_sweep(rows, after, where)
    after += stamp
    return Points(rows[:, :3], rows[:, 3], after)


def _table(cloud: Any, where: str) -> NDArray[Any]:
    """The points (n,) as records of the cloud's fields, in the memory of the message."""
    n, step = int(cloud.width) * int(cloud.height), int(cloud.point_step)
    names = fields_of(cloud)
    formats = [TYPES.get(int(field.datatype)) for field in cloud.fields]
    offsets = [int(field.offset) for field in cloud.fields]
    if not {"x", "y", "z"} <= set(names) or len(set(names)) < len(names) or None in formats:
        raise DataError(
            f"{where}: found fields {', '.join(names)[:200]}, expected x, y, z and others, each once"
        )
    order = ">" if cloud.is_bigendian else "<"
    kinds = [np.dtype(f"{order}{kind}") for kind in formats]
    if any(offset + kind.itemsize > step for offset, kind in zip(offsets, kinds, strict=True)):
        raise DataError(f"{where}: a field lies outside of the {step} bytes of a point")
    data = np.asarray(cloud.data, np.uint8)
    if (
        n == 0
        or n > MOST_POINTS
        or data.size < n * step
        or int(cloud.row_step) not in (0, int(cloud.width) * step)
    ):
        raise DataError(
            f"{where}: found {n} points of {step} bytes in {data.size} bytes (row_step {cloud.row_step}), expected 1 to"
            f" {MOST_POINTS} points without gaps between rows"
        )
    dtype = np.dtype({"names": names, "formats": kinds, "offsets": offsets, "itemsize": step})
    return np.frombuffer(data, dtype, n)


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


def _after(times: NDArray[Any], of_returns: NDArray[Any], stamp: int) -> Array:
    """The times of the points, s after the stamp, Unix ns, of their message; those of its returns tell their kind."""
    told = of_returns[::EVERY].astype(np.float64)
    told = told[np.isfinite(told)]
    middle = float(np.median(told)) if len(told) else 0.0
    if times.dtype.kind in "iu":  # ns, and where 64 bits hold them perhaps of Unix time
        if times.dtype.itemsize == 8 and middle > ABSOLUTE_NS:
            times = times.astype(np.int64) - stamp
        return np.asarray(times * 1e-9, np.float64)
    after = times.astype(np.float64)
    if middle > ABSOLUTE_NS:
        return (after - float(stamp)) * 1e-9
    if middle > ABSOLUTE_S:
        return after - stamp * 1e-9
    return after
