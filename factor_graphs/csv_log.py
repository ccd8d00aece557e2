"""A log of two CSV files, `imu.csv` and `gnss.csv`, and if there is one a third, `wheels.csv`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from factor_graphs.errors import MeasurementError
from factor_graphs.geodesy import LocalFrame
from factor_graphs.measurements import GnssFixes, ImuSamples, WheelSpeeds, clean_wheels

IMU_COLUMNS = ("stamp_s", "ax", "ay", "az", "wx", "wy", "wz")
GNSS_COLUMNS = ("stamp_s", "lat_deg", "lon_deg", "alt_m", "std_e_m", "std_n_m", "std_u_m")
WHEEL_COLUMNS = ("stamp_s", "speed_mps")


def read_csv(folder: Path | str) -> tuple[ImuSamples, GnssFixes, LocalFrame]:
    """Read `imu.csv` and `gnss.csv` of a folder; the local frame has its origin at the first fix.

    IMU columns: stamp_s; ax, ay, az, specific force, m/s²; wx, wy, wz, rad/s; x forward, y left, z up. GNSS columns:
    stamp_s; lat_deg, lon_deg, alt_m on WGS 84; std_e_m, std_n_m, std_u_m. Other columns are ignored. Raises
    MeasurementError for a file that is missing, or holds no such table.
    """
    imu, gnss = _table(Path(folder) / "imu.csv", IMU_COLUMNS), _table(Path(folder) / "gnss.csv", GNSS_COLUMNS)
    frame = LocalFrame(*(float(value) for value in gnss[0, 1:4]))
    fixes = GnssFixes(gnss[:, 0], frame.to_map(*gnss[:, 1:4].T), gnss[:, 4:7])
    return ImuSamples(imu[:, 0], imu[:, 1:4], imu[:, 4:7]), fixes, frame


def read_wheels(folder: Path | str) -> WheelSpeeds | None:
    """Read `wheels.csv` of a folder, for `smooth(..., wheels=...)`; None where there is none.

    Columns: stamp_s; speed_mps, below zero in reverse if the sensor tells. Rows that `clean_wheels` drops are left out.
    Raises MeasurementError for a file that holds no such table.
    """
    path = Path(folder) / "wheels.csv"
    if not path.exists():
        return None
    rows = _table(path, WHEEL_COLUMNS)
    return clean_wheels(rows[:, 0], rows[:, 1])[0]


def _table(path: Path, columns: tuple[str, ...]) -> NDArray[np.float64]:
    """The named columns (n, len(columns)) of a CSV file, whatever their order."""
    try:
        with path.open(encoding="utf-8") as file:
            names = [name.strip() for name in file.readline().split(",")]
            places = [names.index(name) for name in columns]
            rows = np.loadtxt(file, delimiter=",", usecols=places, ndmin=2)
    except (OSError, ValueError) as error:
        raise MeasurementError(
            f"{path}: {error}; expected a table with columns {','.join(columns)}"
        ) from None
    if len(rows) == 0:
        raise MeasurementError(f"{path}: empty; expected rows of {','.join(columns)}")
    return rows
