"""Map many KITTI raw drives, one after the other, and print one line for each.

    python examples/batch_kitti.py KITTI_RAW --labels PROBABILITIES -o MAPS

KITTI_RAW holds the date folders (`2011_09_26/2011_09_26_drive_0005_sync`); PROBABILITIES holds one folder of class
probabilities per drive, named like the drive. A drive that fails is reported, and the others go on.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from factor_graphs.errors import FactorGraphError
from gnss_sem_map import run
from gnss_sem_map.errors import SemMapError


def map_drive(drive: Path, probabilities: Path, out: Path) -> str:
    """Map one drive into `out`; returns what there is to say about it."""
    done = run(drive, out, f"labels:{probabilities}")
    about, driven = done.about, done.trajectory.end - done.trajectory.start
    return f"{about['counts']['scans']} scans, {about['map']['voxels']} voxels, {driven:.0f} s driven"


def main() -> int:
    """Map every drive below a folder; returns how many failed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("kitti_raw", type=Path)
    parser.add_argument("--labels", type=Path, required=True)
    parser.add_argument("-o", "--out", type=Path, required=True)
    arguments = parser.parse_args()
    drives = sorted(arguments.kitti_raw.glob("*/*_sync"))
    if not drives:
        parser.error(f"{arguments.kitti_raw}: no <date>/<date>_drive_<nnnn>_sync in it")
    failed = 0
    for drive in drives:
        try:
            done = map_drive(drive, arguments.labels / drive.name, arguments.out / drive.name)
        except (SemMapError, FactorGraphError) as error:
            failed, done = failed + 1, f"failed: {error}"
        print(f"{drive.name}: {done}", flush=True)
    return failed


if __name__ == "__main__":
    sys.exit(main())
