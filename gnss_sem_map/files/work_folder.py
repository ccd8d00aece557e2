"""Work folder: hidden beside the result; holds intermediate results, and the new result until it is complete.

.OUT.work/.gnss-sem-map.json     says that we made this folder
          drives/.NAME.work/     what was found on the way of one drive (`runs.drive_tasks`)
          drives/NAME/           the map of one drive
          removed.json           the drive that is taken out of a map of several (`runs.many_drives`)
          tiles/refined/         tiles of a map that is being made (`mapping.tile_tasks`)
          part/                  the new result while it is written
          old/                   the result before it, from when it is replaced until it is removed

Of one drive:

job.json                         what it is mapped from, and how (`runs.drive_job`)
checked.npz, located.npz, ...    what its tasks found, files of the memo (`files.memo`)
matches/N.npz, revisits/N.npz    of a section of its scans; of some pairs of places that are passed again
sweeps/                          sweeps that later stages need, thinned (`scans.thinned_sweeps`)
answers/                         class probabilities of the images (`segmentation.cached_segmenter`)
chunks.json, 0/, 1/              mapped chunks of scans (`mapping.checkpoints`)
edges/                           what the edges of ranges of chunks tell of motion (`mapping.edge_windows`)
.0.12.waiting/                   points of a chunk that may have moved (`mapping.waiting_points`), the images of the
                                 scans before it (`mapping.waiting_images`), and tables that wait (`mapping.chunks`)
"""

from __future__ import annotations

import errno
import os
import re
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gnss_sem_map.errors import DataError
from gnss_sem_map.files import ownership

CHUNKS, MATCHES, SWEEPS, REVISITS = "chunks.json", "matches", "sweeps", "revisits"
ANSWERS, DRIVES = "answers", "drives"
TILES, EDGES, PART, OLD = "tiles", "edges", "part", "old"
JOB, REMOVED = "job.json", "removed.json"
ATTEMPTS, AGAIN_S = 10, 0.2
"""So often a folder is removed in which something is still written, so long after one another."""
OF_CHUNKS = re.compile(
    r"\.[^/]+\.\d+\.part|chunks\.json|trajectory\.npz"
    r"|(\d+|\.\d+\.\d+\.part)/((record\.json|\w+\.npz|\w+/|\w+/-?\d+_-?\d+\.parquet)?|(\w+/)?\.[^/]+\.\d+\.part)"
    r"|\.\d+\.\d+\.waiting/((\d+|images)\.npy|\d+\.table)?|edges/(\d+\.npz|\.[^/]+\.\d+\.part)?"
)
OURS = re.compile(
    r"\.gnss-sem-map\.json|part/.*|old/.*|drives/.*|bound/.*|tiles/.*|answers/(about\.json|([\w-]+/)?(\d+\.npz|\.[^/]+\.\d+\.part)?)"
    r"|(matches|revisits)/((\d+|job)\.json|(\d+|trajectory)\.npz|\.[^/]+\.\d+\.part)?|job\.json|(checked|located|group|alone|placed|finished)\.npz"
    r"|removed\.json|\.removed\.json\.\d+\.part|sweeps/(about\.json|\d+\.\w+\.npz|\.[^/]+\.\d+\.part)?"
    rf"|{OF_CHUNKS.pattern}"
)
"""Pattern of all paths that we write into a work folder, or the version before this one did."""


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
    kept = ((MATCHES, "*.npz"), (ANSWERS, "**/*.npz"), (DRIVES, "*/run.json"))
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
    """Remove the maps of single drives, what they are made from, and tiles that were made from them; raises OSError."""
    _remove_ours(folder / DRIVES)
    _remove_ours(folder / "bound")  # of the version before
    _remove_ours(folder / TILES)


def remove_damaged_drives(folder: Path) -> None:
    """Remove the maps of single drives of which a file was changed or is gone; raises OSError."""
    for drive in (folder / DRIVES).glob("[!.]*/"):
        if not ownership.is_whole(drive):
            _remove_ours(drive)


def remove_matches(folder: Path) -> None:
    """Remove saved LiDAR odometry, its sweeps, and what was registered along it; raises OSError."""
    _remove_known(folder, folder / MATCHES)
    _remove_known(folder, folder / REVISITS)
    remove_sweeps(folder)


def remove_sweeps(folder: Path) -> None:
    """Remove saved sweeps; raises OSError."""
    _remove_known(folder, folder / SWEEPS)


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
    """Remove a folder that only we write into, in a folder of ours.

    Workers of a command that was killed just now may write there a moment longer.
    """
    for attempt in range(1, ATTEMPTS + 1):
        if not path.is_dir():
            return
        try:
            shutil.rmtree(path)
        except OSError as error:
            if error.errno != errno.ENOTEMPTY or attempt == ATTEMPTS:
                raise
            time.sleep(AGAIN_S)


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
