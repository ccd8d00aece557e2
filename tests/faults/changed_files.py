"""Files of a drive, changed as users change them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

Array = NDArray[np.float64]
Inject = Callable[[Path], None]


def _rows(path: Path) -> dict[str, str]:
    lines = path.read_text().splitlines()
    return dict(line.split(": ", 1) for line in lines if ": " in line)


def change_rows(path: Path, change: Callable[[dict[str, Array]], dict[str, Array]]) -> None:
    """Change the numbers of a calibration file of KITTI."""
    rows = _rows(path)
    numbers = {name: np.array(row.split(), np.float64) for name, row in rows.items() if name != "calib_time"}
    changed = change(numbers)
    rows |= {name: " ".join(f"{v:.12e}" for v in np.ravel(row)) for name, row in changed.items()}
    path.write_text("".join(f"{name}: {row}\n" for name, row in rows.items()))


def change_log(drive: Path, change: Callable[[dict[str, Any]], dict[str, Any]]) -> None:
    about = yaml.safe_load((drive / "log.yaml").read_text())
    (drive / "log.yaml").write_text(yaml.safe_dump(about | change(about)))


def change_scans(drive: Path, change: Callable[[NDArray[np.float32]], NDArray[Any]], columns: int) -> None:
    folder = next(
        f for f in (drive / "lidar", drive / "velodyne_points/data", drive / "velodyne") if f.is_dir()
    )
    for path in folder.glob("*.bin"):
        change(np.fromfile(path, "<f4").reshape(-1, columns)).astype("<f4").tofile(path)


def change_stamps(path: Path, by_s: float) -> None:
    """A stamp file of KITTI (date and time per line) or of a table log (number and stamp)."""
    if path.suffix == ".csv":
        header, *lines = path.read_text().splitlines()
        rows = [(line.split(",")[0], float(line.split(",")[1]) + by_s) for line in lines]
        path.write_text("\n".join([header, *(f"{number},{stamp:.9f}" for number, stamp in rows)]) + "\n")
        return
    lines = []
    for line in path.read_text().splitlines():
        if line.strip():
            stamp = np.datetime64(line.strip().replace(" ", "T"), "ns") + np.timedelta64(
                round(by_s * 1e9), "ns"
            )
            line = str(stamp).replace("T", " ")
        lines.append(line)
    path.write_text("\n".join(lines) + "\n")


def changed_Tr(change: Callable[[Array], Array]) -> Inject:
    """Another Tr in calib.txt of an odometry sequence."""

    def inject(sequence: Path) -> None:
        def rows(given: dict[str, Array]) -> dict[str, Array]:
            Tr = np.vstack([given["Tr"].reshape(3, 4), [0, 0, 0, 1]])
            return {"Tr": change(Tr)[:3]}

        change_rows(sequence / "calib.txt", rows)

    return inject
