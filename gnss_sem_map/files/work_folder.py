"""Work folder: hidden beside the result; holds intermediate results, and the new result until it is complete.

.OUT.work/.gnss-sem-map.json     says that we made this folder
          chunks.json, 0/, 1/    mapped chunks of scans (`mapping.checkpoints`)
          edges/                 what the edges of ranges of chunks tell of motion (`mapping.edge_windows`)
          job.json, trajectory.npz   what other processes need to map chunks (`runs.drive_job`)
          matches/               LiDAR odometry of sections of the drive (`runs.match_tasks`)
          sweeps/                sweeps that later stages need, thinned (`scans.thinned_sweeps`)
          revisits/              places that are passed again, registered (`runs.revisit_tasks`)
          answers/               class probabilities of the images (`segmentation.cached_segmenter`)
          drives/NAME/           the maps of single drives (`runs.many_drives`)
          bound/NAME/            where these were driven, and how they are bound (`runs.bound_drives`)
          removed.json           the drive that is taken out of a map of several (`runs.many_drives`)
          tiles/refined/         tiles of a map that is being made (`mapping.tile_tasks`)
          .0.12.waiting/         points of a chunk that may have moved (`mapping.waiting_points`), the images of the
                                 scans before it (`mapping.waiting_images`), and tables that wait (`mapping.chunks`)
          part/                  the new result while it is written
          old/                   the result before it, from when it is replaced until it is removed
"""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gnss_sem_map.errors import DataError
from gnss_sem_map.files import ownership

CHUNKS, MATCHES, SWEEPS, REVISITS = "chunks.json", "matches", "sweeps", "revisits"
ANSWERS, DRIVES = "answers", "drives"
BOUND, TILES, EDGES, PART, OLD = "bound", "tiles", "edges", "part", "old"
JOB, TRAJECTORY, REMOVED = "job.json", "trajectory.npz", "removed.json"
OF_CHUNKS = re.compile(
    r"\.[^/]+\.\d+\.part|chunks\.json|job\.json|trajectory\.npz"
    r"|(\d+|\.\d+\.\d+\.part)/((record\.json|\w+\.npz|\w+/|\w+/-?\d+_-?\d+\.parquet)?|(\w+/)?\.[^/]+\.\d+\.part)"
    r"|\.\d+\.\d+\.waiting/((\d+|images)\.npy|\d+\.table)?|edges/(\d+\.npz|\.[^/]+\.\d+\.part)?"
)
OURS = re.compile(
    r"\.gnss-sem-map\.json|part/.*|old/.*|drives/.*|bound/.*|tiles/.*|answers/(about\.json|([\w-]+/)?(\d+\.npz|\.[^/]+\.\d+\.part)?)"
    r"|(matches|revisits)/((\d+|job)\.json|(\d+|trajectory)\.npz|\.[^/]+\.\d+\.part)?"
    r"|removed\.json|\.removed\.json\.\d+\.part|sweeps/(about\.json|\d+\.\w+\.npz|\.[^/]+\.\d+\.part)?"
    rf"|{OF_CHUNKS.pattern}"
)
"""Pattern of all paths that we write into a work folder."""


def make(folder: Path) -> None:
    """Make a work folder, unless it is there; raises DataError when something else is, or it cannot be written."""
    refuse_foreign(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if ownership.read_list(folder) is None:
            ownership.write_list(folder)
    except OSError as error:
        raise DataError(f"{folder}: cannot be written ({error.strerror}); choose another place") from None


@contextmanager
def writing_to(folder: Path) -> Iterator[None]:
    """Raise DataError, with the name of the folder and how to go on, when something cannot be written into it."""
    try:
        yield
    except OSError as error:
        raise DataError(
            f"{folder}: cannot be written ({error.strerror}); free the disk, then run it again"
        ) from None


def refuse_foreign(folder: Path) -> None:
    """Raise DataError when the folder is not a work folder, or holds a file that we did not write."""
    if not os.path.lexists(folder):
        return
    if folder.is_symlink() or not folder.is_dir():
        raise DataError(f"{folder}: is in the way, and no folder of ours; move it away")
    names, marker = list(ownership.content_of(folder)), folder / ownership.MARKER
    is_begun = not os.path.lexists(marker) and all(map(ownership.is_partial, names))
    if ownership.read_list(folder) is None and not is_begun:
        raise DataError(f"{folder}: exists and holds no interrupted run; remove it")
    strange = [name for name in names if not OURS.fullmatch(name)]
    if strange:
        raise DataError(
            f"{folder / min(strange)}: is in the folder of an interrupted run, and not ours; move it away"
        )


def holds_work(folder: Path) -> bool:
    """Whether there are intermediate results for --resume, also in the work folders of single drives."""
    done = any(path.name.isdecimal() for path in folder.glob("*")) and (folder / CHUNKS).is_file()
    kept = ((MATCHES, "*.npz"), (ANSWERS, "**/*.npz"), (DRIVES, "*/run.json"), (BOUND, f"*/{JOB}"))
    return (
        done
        or any(any((folder / place).glob(files)) for place, files in kept)
        or any(map(holds_work, (folder / DRIVES).glob(".*.work")))
    )


def clear(folder: Path) -> None:
    """Remove a work folder with all our files; other files stay. Raises OSError.

    First goes what says that it can be resumed, last what says that it is ours.
    """
    if not folder.is_dir() or folder.is_symlink():
        return
    remove_chunks(folder)
    remove_matches(folder)
    remove_answers(folder)
    remove_drives(folder)
    drop_results(folder)
    (folder / REMOVED).unlink(missing_ok=True)
    if {path.name for path in folder.iterdir()} <= {ownership.MARKER}:
        (folder / ownership.MARKER).unlink(missing_ok=True)
        folder.rmdir()


def remove_drives(folder: Path) -> None:
    """Remove the maps of single drives, how they are bound, and tiles that were made from them; raises OSError."""
    _remove_ours(folder / DRIVES)
    _remove_ours(folder / BOUND)
    _remove_ours(folder / TILES)


def remove_damaged_drives(folder: Path) -> None:
    """Remove the maps of single drives of which a file was changed or is gone; raises OSError."""
    for drive in (folder / DRIVES).glob("[!.]*/"):
        if not ownership.is_whole(drive):
            _remove_ours(drive)


def remove_matches(folder: Path) -> None:
    """Remove saved LiDAR odometry, its sweeps, and what was registered along it; raises OSError."""
    _remove_known(folder, folder / MATCHES)
    _remove_known(folder, folder / SWEEPS)
    _remove_known(folder, folder / REVISITS)


def remove_answers(folder: Path) -> None:
    """Remove cached probabilities; raises OSError."""
    _remove_known(folder, folder / ANSWERS)


def remove_chunks(folder: Path) -> None:
    """Remove mapped chunks, their index first, and tiles that were made from them; raises OSError."""
    (folder / CHUNKS).unlink(missing_ok=True)
    _remove_ours(folder / TILES)
    for path in sorted(folder.iterdir()):
        if OF_CHUNKS.fullmatch(path.name + "/" * _is_folder(path)):
            _remove_known(folder, path)


def drop_results(folder: Path) -> None:
    """Remove the results in a work folder: the new one, and our files of the old one. Raises OSError."""
    part, old = folder / PART, folder / OLD
    _remove_ours(part)
    if old.is_dir():
        ownership.remove(old)


def _remove_ours(path: Path) -> None:
    """Remove a folder that only we write into, in a folder of ours."""
    if path.is_dir():
        shutil.rmtree(path)


def _remove_known(work: Path, path: Path) -> None:
    if not _is_folder(path):
        path.unlink(missing_ok=True)
        return
    for inside in sorted(path.iterdir()):
        if OURS.fullmatch(inside.relative_to(work).as_posix() + "/" * _is_folder(inside)):
            _remove_known(work, inside)
    if not any(path.iterdir()):
        path.rmdir()


def _is_folder(path: Path) -> bool:
    return path.is_dir() and not path.is_symlink()
