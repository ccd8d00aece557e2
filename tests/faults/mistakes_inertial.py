"""Mistakes with IMU, GNSS and given poses, in KITTI raw drives, table logs and odometry sequences."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
from faults.layouts import twin
from faults.mistakes import Mistake
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]
Change = Callable[[Array], Array]

FORCE, RATE, PLACE, ATTITUDE, ACCURACY = (
    slice(11, 14),
    slice(17, 20),
    slice(0, 3),
    slice(3, 6),
    23,
)
"""Columns of an oxts row."""
FRD, BACKWARDS = np.diag([1.0, -1.0, -1.0]), np.diag([-1.0, -1.0, 1.0])


def _rotation(roll: float, pitch: float, yaw: float) -> Array:
    """From our axes to those of a unit that sits so."""
    return Rotation.from_euler("ZYX", [yaw, pitch, roll], degrees=True).as_matrix().T


Y_MIRRORED = np.diag([1.0, -1.0, 1.0])
# what the sensors report: (force matrix, rate matrix), words
IMU: dict[str, tuple[Array, Array, tuple[str, ...]]] = {
    "FRD": (FRD, FRD, ("frd",)),
    "gravity flipped": (-np.eye(3), np.eye(3), ("gravity",)),
    "x backwards, turned by 180": (BACKWARDS, BACKWARDS, ("x points backwards", "180")),
    "x of force and rate reversed alone": (np.diag([-1.0, 1, 1]), np.diag([-1.0, 1, 1]), ("x points backwards",)),
    "x of force reversed alone": (np.diag([-1.0, 1, 1]), np.eye(3), ("x points backwards",)),
    "y of force and rate reversed alone": (Y_MIRRORED, Y_MIRRORED, ("y points", "y of the force")),
    "gyroscope reversed": (np.eye(3), -np.eye(3), ("gyroscope turns the wrong way",)),
    "turned by +90": (_rotation(0, 0, 90), _rotation(0, 0, 90), ("90°",)),
    "turned by -90": (_rotation(0, 0, -90), _rotation(0, 0, -90), ("90°",)),
    "turned by 45": (_rotation(0, 0, 40), _rotation(0, 0, 40), ("askew",)),
    "upside down and turned": (FRD @ BACKWARDS, FRD @ BACKWARDS, ("upside down",)),
    "on its side": (_rotation(90, 0, 0), _rotation(90, 0, 0), ("on its side",)),
    "on its nose": (_rotation(0, 90, 0), _rotation(0, 90, 0), ("on its side",)),
    "tilted by 15": (_rotation(0, 15, 0), _rotation(0, 15, 0), ("askew",)),
    "rolled by 30": (_rotation(30, 0, 0), _rotation(30, 0, 0), ("askew",)),
    "force in g": (np.eye(3) / 9.80665, np.eye(3), ("force_unit: g",)),
    "force in mg": (np.eye(3) / 9.80665e-3, np.eye(3), ("force_unit: mg",)),
    "gyroscope in deg/s": (np.eye(3), np.degrees(np.eye(3)), ("deg/s",)),
    "force in g, FRD": (FRD / 9.80665, FRD, ("frd", "force_unit: g")),
    "FRD, gyroscope in deg/s": (FRD, np.degrees(FRD), ("frd",)),
}  # fmt: skip

RADIANS = ("radians",)


def _swapped(places: Array) -> Array:
    return places[:, [1, 0, 2]]


def _in_radians(places: Array) -> Array:
    return places * np.array([np.pi / 180, np.pi / 180, 1.0])


def _in_millimetres(places: Array) -> Array:
    return places * np.array([1.0, 1.0, 1000.0])


# what the receiver reports: places (n, 3) lat lon alt -> the same, wrong
PLACES: dict[str, tuple[Change, tuple[str, ...]]] = {
    "latitude and longitude swapped": (_swapped, ("swapped",)),
    "latitude and longitude in radians": (_in_radians, RADIANS),
    "altitude in mm": (_in_millimetres, ("altitude",)),
}

LATE_S = (0.5, 1.0, 2.0, -0.5, -1.0)
FROZEN_S = (10.0, 30.0)
LEVER_ARMS_M = {
    "2 m ahead": (2.0, 0.0, 0.0),
    "2 m behind": (-2.0, 0.0, 0.0),
    "2 m to the left": (0.0, 2.0, 0.0),
}


def _mistakes() -> Iterator[Mistake]:
    for name, (force, rate, says) in IMU.items():
        yield Mistake(name, "kitti-raw", partial(_oxts, change=partial(_imu_columns, force, rate)), says)
        yield Mistake(name, "table", partial(_imu_table, force, rate), says)
    for name, (change, says) in PLACES.items():
        yield Mistake(name, "kitti-raw", partial(_oxts, change=partial(_place_columns, change)), says)
        yield Mistake(name, "table", partial(_gnss_table, partial(_places_of_table, change)), says)
    for seconds in LATE_S:
        name = f"fixes {abs(seconds):g} s {'late' if seconds > 0 else 'early'}"
        says = ("gnss_time_offset_s",)
        yield Mistake(name, "kitti-raw", partial(_late_oxts, seconds), says)
        yield Mistake(name, "table", partial(_gnss_table, partial(_later, seconds)), says)
    for seconds in FROZEN_S:
        name, says = f"GNSS frozen for {seconds:g} s", ("frozen",)
        yield Mistake(name, "kitti-raw", partial(_frozen_oxts, seconds), says)
        yield Mistake(name, "table", partial(_gnss_table, partial(_frozen_table, seconds)), says)
    for factor, says in (
        (0.01, ("standard deviations",)),
        (-1.0, ("accuracy", "negative", "standard deviat")),
    ):
        name = f"standard deviations times {factor:g}"
        yield Mistake(name, "kitti-raw", partial(_oxts, change=partial(_accuracy_column, factor)), says)
        yield Mistake(name, "table", partial(_gnss_table, partial(_stddevs_of_table, factor)), says)
    for name, arm in LEVER_ARMS_M.items():
        yield Mistake(f"antenna {name}", "kitti-raw", partial(_antenna_oxts, arm), ("antenna",))
        yield Mistake(f"antenna {name}", "table", partial(_antenna_yaml, arm), ("antenna",))
    yield Mistake("antenna in mm", "table", partial(_antenna_yaml, (1200.0, 300.0, 900.0)), ("lever arm",))
    for name, change, says in POSES:
        yield Mistake(name, "odometry", partial(_poses, change), says)


# KITTI raw: every row of both folders


def _rows(drive: Path) -> tuple[list[Path], Array]:
    files = sorted((drive / "oxts" / "data").glob("*.txt"))
    return files, np.array([[float(word) for word in file.read_text().split()] for file in files])


def _write_rows(files: list[Path], rows: Array) -> None:
    for file, row in zip(files, rows, strict=True):
        words = [f"{value:.14g}" for value in row[:25]] + [f"{int(value)}" for value in row[25:]]
        file.write_text(" ".join(words) + "\n")


def _oxts(drive: Path, change: Change) -> None:
    for folder in (drive, twin(drive)):
        if (folder / "oxts" / "data").is_dir():
            files, rows = _rows(folder)
            _write_rows(files, change(rows))


def _imu_columns(force: Array, rate: Array, rows: Array) -> Array:
    rows = rows.copy()
    rows[:, FORCE], rows[:, RATE] = rows[:, FORCE] @ force.T, rows[:, RATE] @ rate.T
    return rows


def _place_columns(change: Change, rows: Array) -> Array:
    rows = rows.copy()
    rows[:, PLACE] = change(rows[:, PLACE])
    return rows


def _accuracy_column(factor: float, rows: Array) -> Array:
    rows = rows.copy()
    rows[:, ACCURACY] *= factor
    return rows


def _late_oxts(seconds: float, drive: Path) -> None:
    """Every row gets the place of a row before (or after) it; where there is none, the row goes."""
    files, rows = _rows(drive)
    count = round(seconds * 10)
    kept = rows.copy()
    kept[:, PLACE] = np.roll(rows[:, PLACE], count, axis=0)
    none = slice(0, count) if count > 0 else slice(len(rows) + count, None)
    for file in files[none]:
        file.unlink()
    stay = np.ones(len(files), dtype=bool)
    stay[none] = False
    _write_rows([file for file, keep in zip(files, stay, strict=True) if keep], kept[stay])


def _frozen(stamps: Array, places: Array, seconds: float) -> Array:
    """From a third of the drive on, as long as it lasts."""
    places = places.copy()
    start = stamps[0] + np.ptp(stamps) / 3
    inside = (stamps >= start) & (stamps <= start + seconds)
    places[inside] = places[inside][0]
    return places


def _frozen_oxts(seconds: float, drive: Path) -> None:
    files, rows = _rows(drive)
    rows[:, PLACE] = _frozen(np.arange(len(rows)) * 0.1, rows[:, PLACE], seconds)
    _write_rows(files, rows)


def _antenna_oxts(arm: tuple[float, float, float], drive: Path) -> None:
    """The reported place is that of an antenna elsewhere."""
    files, rows = _rows(drive)
    east, north, up = Rotation.from_euler("ZYX", rows[:, ATTITUDE][:, ::-1]).apply(arm).T
    metres_per_degree = 111_200.0
    rows[:, 0] += north / metres_per_degree
    rows[:, 1] += east / metres_per_degree / np.cos(np.radians(rows[:, 0]))
    rows[:, 2] += up
    _write_rows(files, rows)


# table logs


def _table(path: Path) -> tuple[str, Array]:
    header, *_ = path.read_text().splitlines()
    return header, np.loadtxt(path, delimiter=",", skiprows=1)


def _change_table(path: Path, change: Change) -> None:
    header, rows = _table(path)
    np.savetxt(path, change(rows), delimiter=",", fmt="%.14g", header=header, comments="")


def _imu_table(force: Array, rate: Array, drive: Path) -> None:
    _change_table(
        drive / "imu.csv",
        lambda rows: np.column_stack([rows[:, 0], rows[:, 1:4] @ force.T, rows[:, 4:7] @ rate.T]),
    )


def _gnss_table(change: Change, drive: Path) -> None:
    _change_table(drive / "gnss.csv", change)


def _places_of_table(change: Change, rows: Array) -> Array:
    return np.column_stack([rows[:, 0], change(rows[:, 1:4]), rows[:, 4:]])


def _later(seconds: float, rows: Array) -> Array:
    return rows + np.array([seconds, 0, 0, 0, 0, 0, 0])


def _frozen_table(seconds: float, rows: Array) -> Array:
    return np.column_stack([rows[:, 0], _frozen(rows[:, 0], rows[:, 1:4], seconds), rows[:, 4:]])


def _stddevs_of_table(factor: float, rows: Array) -> Array:
    return rows * np.array([1, 1, 1, 1, factor, factor, factor])


def _antenna_yaml(arm: tuple[float, float, float], drive: Path) -> None:
    about = json.loads((drive / "log.yaml").read_text())
    about["p_imu_antenna"] = (np.array(about["p_imu_antenna"]) + arm).tolist()
    (drive / "log.yaml").write_text(json.dumps(about))


# odometry sequences: poses (n, 3, 4)


def _poses(change: Change, sequence: Path) -> None:
    poses = np.loadtxt(sequence / "poses.txt").reshape(-1, 3, 4)
    np.savetxt(sequence / "poses.txt", change(poses).reshape(-1, 12), fmt="%.9e")


def _jumping(metres: float, poses: Array) -> Array:
    poses = poses.copy()
    poses[len(poses) // 2 :, 0, 3] += metres
    return poses


def _one_off(metres: float, poses: Array) -> Array:
    poses = poses.copy()
    poses[len(poses) // 2, 2, 3] += metres
    return poses


def _turning(degrees: float, poses: Array) -> Array:
    poses = poses.copy()
    turn = Rotation.from_euler("y", degrees, degrees=True).as_matrix()
    poses[len(poses) // 2, :, :3] = turn @ poses[len(poses) // 2, :, :3]
    return poses


def _larger(factor: float, poses: Array) -> Array:
    poses = poses.copy()
    poses[:, :, 3] *= factor
    return poses


POSES: tuple[tuple[str, Change, tuple[str, ...]], ...] = (
    ("poses jump by 1 km", partial(_jumping, 1000.0), ("jump",)),
    ("poses jump by 10 m", partial(_jumping, 10.0), ("jump",)),
    ("one pose is 1 km away", partial(_one_off, 1000.0), ("jump",)),
    ("one pose is turned by 90 degrees", partial(_turning, 90.0), ("rotations jump",)),
    ("poses in mm", partial(_larger, 1000.0), ("unit",)),
)

MISTAKES = list(_mistakes())
