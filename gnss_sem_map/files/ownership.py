"""Ownership of files: every result folder has a list of its files, and only listed files are ever removed.

The list holds the size of each file, and the content of small ones (those that people edit) as a checksum: what was
changed since is somebody's work, and no longer ours. Of intermediate results it holds the checksum of every file.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
from collections.abc import Callable, Container, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from gnss_sem_map.errors import DataError
from gnss_sem_map.files.atomic import replacing, write_whole

MARKER = ".gnss-sem-map.json"
"""Name of the list of files in every folder that we write."""
CONTENT_BYTES = 1 << 16
"""For files up to this size, the content is compared as well."""

Listed = Mapping[str, list[str]]
"""Path within the folder -> accepted states (size, checksum) of our file; folders end in '/'."""


def content_of(folder: Path) -> Iterator[str]:
    """All paths within a folder without its list; folders end in '/', links to folders do not.

    What another process removes meanwhile may be left out.
    """
    for place, folders, files in os.walk(folder):
        within = Path(place).relative_to(folder)
        for name in sorted(folders):
            yield (within / name).as_posix() + ("" if os.path.islink(Path(place, name)) else "/")
        for name in sorted(files):
            if (within / name).as_posix() != MARKER:
                yield (within / name).as_posix()


def write_list(folder: Path, all_content: bool = False) -> None:
    """Write the list of all files in a folder: they are ours. With `all_content`, large ones count with theirs, too."""
    _write_marker(folder, {name: [state_of(folder / name, all_content)] for name in content_of(folder)})


def read_list(folder: Path) -> Listed | None:
    """Read the list of our files in a folder; None when it has no list, or a damaged one."""
    try:
        files = json.loads((folder / MARKER).read_text("utf-8"))["files"]
        return {str(name): [str(state) for state in states] for name, states in files.items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None


def foreign(folder: Path, by_name: Callable[[str], bool] = lambda name: False) -> str | None:
    """A file in a folder that we did not write, or that was changed since; None when all files are ours.

    A folder without a list is ours when `by_name` accepts the path of everything in it.
    """
    listed = read_list(folder)
    for name in content_of(folder):
        if is_partial(name, listed or ()) and not os.path.islink(folder / name):
            continue
        if listed is None:
            ours = by_name(name) and not os.path.islink(folder / name)
        else:
            ours = name in listed and _is_as_listed(folder / name, listed[name])
        if not ours:
            return name
    return None


def is_whole(folder: Path) -> bool:
    """Whether all files that we wrote into a folder still exist, unchanged."""
    listed = read_list(folder)
    return listed is not None and all(_is_as_listed(folder / name, states) for name, states in listed.items())


def is_as_written(folder: Path, name: str) -> bool:
    """Whether a file of a result folder, which may be in one of several drives, is as we wrote it."""
    lists = ((inside, read_list(place) or {}) for place, inside in _with_lists(folder))
    return any(_is_as_listed(folder / name, listed.get(inside + name, [])) for inside, listed in lists)


def remove(folder: Path) -> None:
    """Remove our files from a folder, the list last, and then the folder; raises OSError.

    What is not ours stays, and so does the folder that holds it: then that is the error.
    """
    listed = read_list(folder) or {}
    remove_partials(folder)
    # the deepest first, so that folders are empty when their turn comes
    for name in sorted(listed, key=lambda name: name.count("/") - name.endswith("/"), reverse=True):
        path = folder / name
        if _is_as_listed(path, listed[name]):
            path.rmdir() if name.endswith("/") else path.unlink()
    left = next(content_of(folder), None)
    if left is None:
        (folder / MARKER).unlink(missing_ok=True)
    folder.rmdir()


def remove_partials(folder: Path) -> None:
    """Remove unfinished files of killed processes; raises OSError."""
    listed = read_list(folder) or ()
    for path in folder.rglob(".*.part") if folder.is_dir() else ():
        is_file = path.is_file() and not path.is_symlink()
        if is_file and is_partial(path.relative_to(folder).as_posix(), listed):
            path.unlink()


def amend(folder: Path, name: str, content: bytes) -> None:
    """Add or replace a file in a folder; it is listed first, so that it is ours at every moment.

    Raises DataError when a file lies there that we did not write, or the disk is full.
    """
    with _amending(folder, {name: _state_of_bytes(content)}):
        write_whole(folder / name, content)


def amend_all(folder: Path, source: Path) -> None:
    """Add or replace all files and folders that lie in `source`, as `amend` does."""
    names = sorted(content_of(source))
    with _amending(folder, {name: state_of(source / name) for name in names}):
        for name in names:
            if name.endswith("/"):
                (folder / name).mkdir(exist_ok=True)
            else:
                with (source / name).open("rb") as content, replacing(folder / name) as file:
                    shutil.copyfileobj(content, file)


@contextmanager
def _amending(folder: Path, states: Mapping[str, str]) -> Iterator[None]:
    """List files that are written next; raises DataError for what we did not write, and for OSErrors."""
    try:
        for place, inside in _with_lists(folder):
            listed = dict(read_list(place) or {})
            for name, state in states.items():
                known = listed.get(inside + name, [])
                if os.path.lexists(folder / name) and not _is_as_listed(folder / name, known):
                    raise DataError(
                        f"{folder / name}: was not written by us, or was changed since; move it away"
                    )
                listed[inside + name] = list(dict.fromkeys([*known, state]))[-3:]
            _write_marker(place, listed)
        yield
    except OSError as error:
        place = folder / next(iter(states)) if len(states) == 1 else folder
        raise DataError(
            f"{place}: cannot be written ({error.strerror}); free the disk or see to its rights"
        ) from None


def _with_lists(folder: Path) -> Iterator[tuple[Path, str]]:
    """The folders whose list holds the files of this one: itself, and a map of several drives around it.

    Each with what precedes the names of the files in its list.
    """
    if read_list(folder) is not None:
        yield folder, ""
    real = folder.resolve()
    for parent in real.parents:
        inside = f"{real.relative_to(parent).as_posix()}/"
        if inside in (read_list(parent) or {}):
            yield parent, inside


def is_partial(name: str, listed: Container[str] = ()) -> bool:
    """Whether a path is that of an unfinished list, page, or file that is listed, of a killed process."""
    found = re.fullmatch(r"(.*/)?\.([^/]+)\.\d+\.part", name)
    file = "" if found is None else (found[1] or "") + found[2]
    return file in (MARKER, "report.html", "metrics.json", "check.html") or file in listed


def state_of(path: Path, all_content: bool = False) -> str:
    """State of a file: its size, and the checksum of a small one; 'folder', or 'other' for what is neither.

    With `all_content`, also the checksum of a large one.
    """
    try:
        if path.is_symlink():
            return "other"
        if path.is_dir():
            return "folder"
        if not path.is_file():
            return "other"
        size = path.stat().st_size
        if size > CONTENT_BYTES and not all_content:
            return str(size)
        with path.open("rb") as file:
            return f"{size} {hashlib.file_digest(file, 'sha256').hexdigest()[:32]}"
    except OSError:
        return "other"


def _is_as_listed(path: Path, states: list[str]) -> bool:
    """Whether a file is in one of these states; the checksum of a large one is compared where they have it."""
    return any(state_of(path, " " in state) == state for state in states)


def _state_of_bytes(content: bytes) -> str:
    size = len(content)
    return str(size) if size > CONTENT_BYTES else f"{size} {hashlib.sha256(content).hexdigest()[:32]}"


def _write_marker(folder: Path, files: Listed) -> None:
    text = json.dumps({"written by": "gnss-sem-map", "files": files}, indent=0)
    write_whole(folder / MARKER, text.encode())
